"""Folders of the user that roadgeo keeps things in."""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import tempfile
from pathlib import Path

__all__ = ["cache_dir", "is_private", "private_temporary_dir", "user_dir", "writable"]

#: Names of a temporary folder to try before making one that no other process will find.
_NAMES = 16


def cache_dir() -> Path:
    """Folder of files that can be made again: fetched answers, machine code (`ROADGEO_CACHE` overrides).

    It need not exist yet.

    Raises
    ------
    RuntimeError
        The user has no home.
    """
    given = os.environ.get("ROADGEO_CACHE")
    if given:
        return Path(given).expanduser()
    own = user_dir("Caches", "XDG_CACHE_HOME", ".cache") / "roadgeo"
    return own / "cache" if sys.platform == "win32" else own


def user_dir(on_mac: str, variable: str, usual: str) -> Path:
    """Folder of the user's files of one kind: in Windows' local data, macOS's Library, or by XDG's variable."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / on_mac
    return Path(os.environ.get(variable) or Path.home() / usual)


def private_temporary_dir() -> Path:
    """Make or find a temporary folder that only this user may write to: its files may be executed.

    Raises
    ------
    OSError
        There is no temporary folder that can be written.
    """
    if not hasattr(os, "getuid"):  # Windows: the temporary folder is the user's own
        return Path(tempfile.gettempdir()) / "roadgeo"
    for n in range(_NAMES):  # someone else may have taken the name
        path = Path(tempfile.gettempdir()) / (f"roadgeo-{os.getuid()}" + (f"-{n}" if n else ""))
        with contextlib.suppress(FileExistsError):
            path.mkdir(mode=0o700)
        if is_private(path):
            return path
    return Path(tempfile.mkdtemp(prefix="roadgeo-"))


def is_private(folder: Path) -> bool:
    """Whether a folder is this user's, and only they may write to it: its files may be executed.

    Its parent is theirs or the system's: its owner may put another folder in the place of this one. A group may write
    there, but not everybody, unless only owners may rename what lies there.
    """
    if not hasattr(os, "getuid"):  # Windows: the folders of a user are their own
        return folder.is_dir()
    try:
        status, around = folder.lstat(), folder.parent.stat()
    except OSError:
        return False
    mine = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022
    safe = around.st_uid in (0, os.getuid())
    return mine and safe and (not around.st_mode & 0o002 or bool(around.st_mode & stat.S_ISVTX))


def writable(folder: Path) -> bool:
    """Make a folder unless it is there, for this user alone; return whether files can be written to it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # permission bits do not show read-only file systems
            return True
    except OSError:
        return False
