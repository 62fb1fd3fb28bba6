"""Files that appear whole or not at all: written in a staging folder beside the target, synced, then renamed over it.

Readers that hold the previous file open keep reading it; a writer killed at any moment leaves the previous file as it
was, and at worst a staging folder that the next writer in the same place removes. The folder has a random name, is made
anew and is the user's alone, and a link at the target is replaced. Who may rename that folder, in a place that is
shared, leads a writer elsewhere only where there is no fence (`storage.fence`).
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import re
import shutil
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from roadgeo.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: there an open file cannot be deleted, which serves as the lock
    fcntl = None  # type: ignore[assignment]

__all__ = [
    "make_folder", "make_temporary_folder", "remove_leftovers", "remove_own", "replacing", "stage", "sync_file",
    "write_bytes", "write_text", "writing",
]  # fmt: skip

_PREFIX, _SUFFIX, _LOCK = ".roadgeo-", ".tmp", "lock"
_NAME = r"\.roadgeo-[0-9a-f]{12}\.tmp"
_STAGED = rf"{_NAME}[/\\\\]"
#: Variable that gives processes that we start the name under which staging folders lie together (see `stage`).
_STAGE = "ROADGEO_STAGE"

#: Staging folders of this process, not of one that it was forked from.
_own: set[Path] = set()
#: Locks of those that stay until it ends, and folders that were made for them, which go where nothing was written.
_held: list[BinaryIO] = []
_made: list[Path] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_own.clear)
    os.register_at_fork(after_in_child=_made.clear)

_REMEDIES = {
    errno.ENOSPC: "free some space or choose another disk",
    errno.EDQUOT: "free some space or choose another disk",
    errno.EFBIG: "raise the file size limit or choose another disk",
    errno.EACCES: "choose a folder you may write to",
    errno.EPERM: "choose a folder you may write to",
    errno.EROFS: "choose a folder you may write to",
    errno.ENOENT: "create the folder first",
    errno.ENOTDIR: "choose a folder, not a file",
    errno.EEXIST: "choose a folder, not a file",
    errno.EISDIR: "choose a file name, not a folder",
}


@contextlib.contextmanager
def writing(target: str | os.PathLike[str]) -> Iterator[None]:
    """Turn an `OSError` of the block into an `OutputError` that names `target`, the cause and the remedy."""
    try:
        yield
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "check the disk and the permissions")
        cause = error.strerror or str(error)
        raise OutputError(f"cannot write {os.fspath(target)}: {cause.lower()}; {remedy}") from error


def make_folder(folder: str | os.PathLike[str]) -> None:
    """Make a folder for results, unless it is there, and see that files can be put into it.

    Raises
    ------
    OutputError
        They cannot.
    """
    with writing(folder):
        Path(folder).mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, "permission denied")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], sync: bool = True, *, may_exist: bool = True) -> Iterator[Path]:
    """Yield a file of the same name in a staging folder; on success it takes the place of `path`.

    With `sync` the content is on the disk first: after a power cut the name stands for the old content or the new, not
    for an empty file. Leftovers of writers that died are removed once for each folder, for many files may be written to
    it.

    Parameters
    ----------
    path : path
        The file to be written. Its folder must exist.
    may_exist : bool
        False: it is an error where there is a file by then.

    Raises
    ------
    OutputError
        The disk is full, the folder is missing or not writable.
    """
    target = Path(path)
    try:
        with writing(target):
            _remove_leftovers_once(target.parent.absolute())
            with _locked_folder(target.parent) as folder:
                staged = folder / target.name
                yield staged
                if sync:
                    sync_file(staged)
                if may_exist:
                    _rename(staged, target)
                else:
                    _rename_to_new(staged, target)
                if sync:
                    _sync_folder(target.parent)
    except OutputError as error:
        raise OutputError(re.sub(_STAGED, "", str(error))) from error


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a whole file in one step (see `replacing`)."""
    with replacing(path) as staged:
        staged.write_bytes(content)


def write_text(path: str | os.PathLike[str], content: str) -> None:
    """Write a whole UTF-8 text file with line feeds in one step (see `replacing`)."""
    write_bytes(path, content.encode())


def _rename(staged: Path, target: Path) -> None:
    """Rename a file; inside the fence of a Linux before 5.19, where none may leave its folder, a copy of it."""
    try:
        staged.replace(target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        copy = target.with_name(_random_name())
        try:
            shutil.copyfile(staged, copy)
            copy.replace(target)
        finally:
            copy.unlink(missing_ok=True)


def _rename_to_new(staged: Path, target: Path) -> None:
    """Rename a file to a name that must be free; a hard link tests that and takes it in one step."""
    try:
        os.link(staged, target)
    except FileExistsError:
        raise
    except OSError:  # no hard links on this disk: look first, and hope that nobody comes between
        if target.exists():
            raise
        _rename(staged, target)


def sync_file(path: Path) -> None:
    """Wait until a file's content is on the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Make a rename in `folder` survive a power cut, where the platform can."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def _locked_folder(parent: Path) -> Iterator[Path]:
    """Create a staging folder and lock it, so that other writers see that it is in use; remove it in the end."""
    within = parent / os.environ.get(_STAGE, "-")
    folder, lock = _make_folder(within if within.is_dir() else parent)
    try:
        yield folder
    finally:
        lock.close()
        if folder in _own:
            shutil.rmtree(folder, ignore_errors=True)
            _own.discard(folder)


def stage(parent: Path) -> Path:
    """Make the folder within which this process, and those that it starts, make the files of a folder.

    It is the same whenever it is asked for, and goes when the process ends.

    Raises
    ------
    OutputError
        It cannot be made.
    """
    folder = parent / os.environ.setdefault(_STAGE, _random_name())
    if not folder.is_dir():
        if not parent.exists():
            _made.append(parent.absolute())
        make_folder(parent)
        remove_leftovers(parent)
        with writing(parent):
            _held.append(_make_folder(parent, folder.name)[1])
    return folder


def make_temporary_folder(parent: Path) -> Path:
    """Make a folder for temporary files of this process; where it is killed, the next one removes it.

    Raises
    ------
    OutputError
        It cannot be made.
    """
    remove_leftovers(parent)
    with writing(parent):
        folder, lock = _make_folder(parent)
    _held.append(lock)
    return folder


@atexit.register
def remove_own() -> None:
    """Remove the staging folders of a process that ends: an interrupt may have come while one was made or removed."""
    while _own:
        shutil.rmtree(_own.pop(), ignore_errors=True)
    while _made:
        with contextlib.suppress(OSError):  # it is used
            _made.pop().rmdir()


def _random_name() -> str:
    return f"{_PREFIX}{os.urandom(6).hex()}{_SUFFIX}"


def _make_folder(parent: Path, name: str = "") -> tuple[Path, BinaryIO]:
    while True:
        folder = parent / (name or _random_name())
        _own.add(folder)
        folder.mkdir(mode=0o700)
        try:
            lock = (folder / _LOCK).open("xb")
        except FileNotFoundError:  # another writer took the empty folder for a leftover
            continue
        if fcntl is not None:
            fcntl.flock(lock, fcntl.LOCK_EX)
        if (folder / _LOCK).exists():
            return folder, lock
        lock.close()


def remove_leftovers(parent: Path) -> None:
    """Remove this user's staging folders of dead writers: their lock is free."""
    for folder in parent.glob(f"{_PREFIX}*{_SUFFIX}"):
        if not re.fullmatch(_NAME, folder.name) or not _is_own(folder):
            continue
        with contextlib.suppress(OSError):  # in use, or being removed by somebody else
            if not (folder / _LOCK).exists():
                folder.rmdir()  # only ever empty: the lock is the first file and the last
                continue
            if fcntl is None:
                (folder / _LOCK).unlink()
                shutil.rmtree(folder, ignore_errors=True)
                continue
            with open(folder / _LOCK, "rb+", opener=_follow_no_link) as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)


def _is_own(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        return os.name != "posix" or folder.lstat().st_uid == os.getuid()
    return False


_remove_leftovers_once = lru_cache(maxsize=64)(remove_leftovers)


def _follow_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0))
