"""Folders of the user that roadgeo keeps things in."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

__all__ = ["cache_dir", "private_temporary_dir", "writable"]


def cache_dir() -> Path:
    """Folder of what can be made again: fetched answers, machine code (`ROADGEO_CACHE` overrides).

    It need not exist yet.

    Raises
    ------
    RuntimeError
        The user has no home.
    """
    given = os.environ.get("ROADGEO_CACHE")
    if given:
        return Path(given).expanduser()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "roadgeo" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "roadgeo"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "roadgeo"


def private_temporary_dir() -> Path:
    """Make or find a temporary folder that only this user may write to: what lies in it may be executed.

    Raises
    ------
    OSError
        There is no temporary folder that can be written.
    """
    if not hasattr(os, "getuid"):  # Windows: the temporary folder is the user's own
        return Path(tempfile.gettempdir()) / "roadgeo"
    path = Path(tempfile.gettempdir()) / f"roadgeo-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        return Path(tempfile.mkdtemp(prefix="roadgeo-"))  # someone else took the name
    return path


def writable(folder: Path) -> bool:
    """Make a folder unless it is there; return whether files can be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # permission bits say nothing of read-only file systems
            return True
    except OSError:
        return False
