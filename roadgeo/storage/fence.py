"""A fence around this process and those that it starts: it opens the files that it was given, and no others.

A stranger's file may name other files in ways that nobody knows but the library that reads it. Inside the fence the
system refuses to open them, whatever asks for it. It is Linux's Landlock (version 5.13 and later), which needs no
privilege and cannot be taken down again: https://docs.kernel.org/userspace-api/landlock.html

Readable are Python, installed packages, the system's libraries and data, and the given files, each with the files that
share its stem. Results are made where nothing is read: in a folder within theirs, which is the process's own, and
renamed from there (`storage.files`). Temporary files lie in a folder of this process, too. Landlock fences the thread
that asks for it, and the threads and processes that it starts: earlier threads stay outside.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import struct
import sys
import sysconfig
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from roadgeo.errors import OutputError
from roadgeo.storage.files import make_folder, make_temporary_folder, stage
from roadgeo.storage.folders import cache_dir, is_private, private_temporary_dir, user_dir, writable

__all__ = ["Fence", "abi_version", "current", "is_inside", "is_started_inside", "remedy"]

#: Numbers of the system calls, the same on all machines that Python has wheels for; of prctl's option.
_CREATE, _ADD, _RESTRICT, _NO_NEW_PRIVILEGES = 444, 445, 446, 38
_VERSION, _BENEATH = 1, 1  # flag that asks for the ABI; type of a rule

#: Rights, by their bits.
_EXECUTE, _WRITE, _READ, _LIST, _REMOVE_FOLDER, _REMOVE, _TRUNCATE = 1, 2, 4, 8, 16, 32, 1 << 14
_MAKE = 0b1011110 << 6  # rights to make files of all kinds but devices
_REFER = 1 << 13  # a file may change its folder
_OF_FILES = _EXECUTE | _WRITE | _READ | _TRUNCATE
_ALL = (1 << 15) - 1
_KNOWN = {1: (1 << 13) - 1, 2: (1 << 14) - 1}  # rights that an ABI knows; later ones know all
_NETWORK_ABI, _CONNECTIONS = 4, 0b11  # bind and connect, of TCP

_RUN, _LOOK, _USE = _READ | _LIST | _EXECUTE, _READ | _LIST, _READ | _WRITE
_RESULTS = _LIST | _MAKE | _REMOVE | _REMOVE_FOLDER | _REFER
_OWN = _RESULTS | _USE | _TRUNCATE

#: The system's own. From /etc and /proc, only files that libraries need: the rest describes users and their programs.
_SYSTEM = (
    *("/usr", "/lib", "/lib32", "/lib64", "/bin", "/sbin", "/opt", "/nix/store", "/gnu/store", "/sys"),
    *("/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/version", "/proc/filesystems", "/proc/sys"),
    *(f"/proc/self/{name}" for name in ("cgroup", "maps", "mountinfo", "mounts", "stat", "statm", "status")),
)
_ETC = (
    *("alternatives", "ca-certificates", "fonts", "gai.conf", "host.conf", "hosts", "ld.so.cache", "ld.so.conf"),
    *("ld.so.conf.d", "ld.so.preload", "locale.alias", "localtime", "mime.types", "nsswitch.conf", "os-release", "pki"),
    *("protocols", "resolv.conf", "services", "ssl", "timezone"),
)
_DEVICES = ("null", "zero", "full", "random", "urandom")
#: Variables that name data of libraries.
_DATA = (
    *("PROJ_DATA", "PROJ_LIB", "GDAL_DATA", "GDAL_DRIVER_PATH", "LD_LIBRARY_PATH"),
    *("SSL_CERT_FILE", "SSL_CERT_DIR", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE"),
)

#: How systems word that they did not open a file.
_REFUSED = re.compile(r"Permission denied|Operation not permitted")


@dataclass(frozen=True)
class Fence:
    """The files that a process may open; it travels to other processes.

    Attributes
    ----------
    read : tuple of str
        Files, with those that share their stem, and folders with all that is in them.
    results : tuple of str
        Folders that get results; the files there are not read.
    write : tuple of str
        Folders, or files, that are written and read.
    network : bool
        Whether connections may be made, where the system can forbid them.
    temporary : str
        Where its folder for temporary files is made; "": where the system has them.
    """

    read: tuple[str, ...] = ()
    results: tuple[str, ...] = ()
    write: tuple[str, ...] = ()
    network: bool = False
    temporary: str = ""

    def enter(self) -> bool:
        """Put this thread, and all that it starts from now on, inside; return whether this system can do that.

        Raises
        ------
        OutputError
            There is no temporary folder that can be written.
        """
        abi = abi_version()
        if not abi:
            return False
        self._prepare()
        ruleset = _make_ruleset(abi, self.network)
        try:
            for path, rights in self._rules(abi):
                _allow(ruleset, path, rights & _KNOWN.get(abi, _ALL))
            _restrict(ruleset)
        finally:
            os.close(ruleset)
        _entered.append(self)
        os.environ[_INSIDE] = "1"
        return True

    def _prepare(self) -> None:
        """Make the folders that are to be written, temporary ones too; settle what libraries look up elsewhere."""
        with contextlib.suppress(RuntimeError):
            os.environ.setdefault("HOME", str(Path.home()))  # else the system's list of users is read
        # Arrow's usual pool reserves 1 GB at once: all that the reading of a small file may take (`storage.memory`).
        os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
        for folder in (path for path in self.write if not Path(path).is_file()):
            with contextlib.suppress(OutputError):  # whoever writes there will report it
                make_folder(folder)
        self._staged()
        kept = cache_dir()
        if not (writable(kept) and is_private(kept)):
            os.environ["ROADGEO_CACHE"] = str(private_temporary_dir())
        os.environ.setdefault("MPLCONFIGDIR", str(cache_dir() / "matplotlib"))  # osmnx brings it, and it keeps fonts
        _make_temporary_folder(self.temporary or tempfile.gettempdir())

    def _staged(self) -> list[str]:
        """Return the folders in which results are made; they are made where there are none."""
        folders = []
        for folder in self.results:
            with contextlib.suppress(OutputError):  # as above
                folders.append(str(stage(Path(folder))))
        return folders

    def _rules(self, abi: int) -> Iterator[tuple[str, int]]:
        """Yield paths, and the rights to them."""
        yield from ((path, _RUN) for path in (*_SYSTEM, *_of_python()))
        yield from ((f"/etc/{name}", _LOOK) for name in _ETC)
        yield from ((f"/dev/{name}", _USE) for name in _DEVICES)
        yield from ((path, _LOOK) for path in _of_libraries())
        yield from _with_siblings(self.read)
        # In the first version no file may change its folder: results are copied there.
        yield from ((path, _RESULTS | (_WRITE if abi == 1 else 0)) for path in self.results)
        yield from ((os.path.dirname(os.path.abspath(path)), _REMOVE_FOLDER) for path in self.results)  # noqa: PTH100, PTH120
        own = (*self.write, *self._staged(), str(cache_dir()), os.environ.get("NUMBA_CACHE_DIR", ""))
        yield from ((path, _OWN) for path in (*own, tempfile.gettempdir()))
        yield str(Path(tempfile.gettempdir()).parent), _REMOVE_FOLDER
        yield "/proc", _LIST  # programs that are started close what is open there


#: Variable by which a process knows that the one that started it was inside, and so it is.
_INSIDE = "ROADGEO_FENCED"
#: Fences that this process entered, or one of its threads.
_entered: list[Fence] = []


def current() -> Fence | None:
    """Return the fence that was entered last, for processes that are to be inside, too."""
    return _entered[-1] if _entered else None


def is_started_inside() -> bool:
    """Whether whoever started this process was inside a fence, and so all of it is."""
    return is_inside() and not _entered


def is_inside() -> bool:
    """Whether this process is inside a fence, its own or its parent's."""
    return _INSIDE in os.environ


def remedy(reason: str) -> str:
    """Return how to have a file read that, by an error, was not opened; "" for other errors, and outside."""
    if not (is_inside() and _REFUSED.search(reason)):
        return ""
    return "; only files that were named are opened: to have others read that they name, --allow their folder"


@cache
def abi_version() -> int:
    """Return the version of Landlock that the system has; 0 without it."""
    if sys.platform != "linux":
        return 0
    with contextlib.suppress(OSError):
        return _call(_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(_VERSION))
    return 0


# --- what belongs to the system ---------------------------------------------------------------------------------------


def _of_python() -> set[str]:
    """Return the folders of the interpreter and of packages: not the current one, where anything may lie."""
    here = Path(__file__).resolve().parents[1]
    folders = {sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values(), str(here)}
    paths = {os.path.realpath(path) for path in (*folders, *filter(None, sys.path))}
    return paths - {os.path.realpath(Path.cwd())}


def _of_libraries() -> list[str]:
    """Return where variables, and PROJ, have data of libraries."""
    named = [path for name in _DATA for path in os.environ.get(name, "").split(os.pathsep) if path]
    return [*named, str(user_dir("Application Support", "XDG_DATA_HOME", ".local/share") / "proj")]


def _with_siblings(paths: Iterable[str]) -> Iterator[tuple[str, int]]:
    """Yield what may be read: folders whole; files with those beside them that share their stem, and a look around.

    Pipes beside them hold whoever opens them, and links lead elsewhere.
    """
    stems: dict[str, set[str]] = defaultdict(set)
    for path in map(os.path.abspath, paths):
        if os.path.isdir(path):  # noqa: PTH112 - as below, names may hold what Path refuses
            yield path, _LOOK
        elif os.path.isfile(path):  # noqa: PTH113
            folder, name = os.path.split(path)
            stems[folder].add(os.path.splitext(name)[0].casefold())  # noqa: PTH122
            yield path, _READ
    for folder, wanted in stems.items():
        yield folder, _LIST
        with contextlib.suppress(OSError), os.scandir(folder) as entries:
            files = (each for each in entries if each.is_file(follow_symlinks=False))
            yield from ((each.path, _READ) for each in files if _stems(each.name.casefold()) & wanted)


def _stems(name: str) -> set[str]:
    """Return a name, and it without one, two or more of its endings: "a.png.aux.xml", "a.png.aux", "a.png", "a"."""
    return {name, *(name[: dot.start()] for dot in re.finditer(r"\.", name))}


def _make_temporary_folder(where: str) -> None:
    """Make a folder for temporary files, of this process and of the ones that it starts."""
    folder = str(make_temporary_folder(Path(where)))
    from multiprocessing.util import Finalize

    # Later than those that other modules make, and then remove, within it; not by processes that are forked off.
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=-200)
    os.environ["TMPDIR"] = tempfile.tempdir = folder


# --- Landlock ---------------------------------------------------------------------------------------------------------


def _call(number: int, *arguments: Any) -> int:
    """Make a system call, which Python has no function for."""
    library = ctypes.CDLL(None, use_errno=True)
    library.syscall.restype = ctypes.c_long
    result = int(library.syscall(ctypes.c_long(number), *arguments))
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def _make_ruleset(abi: int, network: bool) -> int:
    """Return the descriptor of a set of rules, by which nothing is allowed yet."""
    handled = struct.pack("=Q", _KNOWN.get(abi, _ALL))
    if abi >= _NETWORK_ABI:
        handled += struct.pack("=Q", 0 if network else _CONNECTIONS)
    return _call(_CREATE, handled, ctypes.c_size_t(len(handled)), ctypes.c_uint32(0))


def _allow(ruleset: int, path: str, rights: int) -> None:
    """Allow something with a file, or with all in a folder; nothing where there is no such path."""
    try:
        beneath = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except (OSError, ValueError):
        return
    try:
        with contextlib.suppress(OSError):  # a file that Landlock does not know, as of a pipe
            rights = rights if os.path.isdir(path) else rights & _OF_FILES  # noqa: PTH112
            rule = struct.pack("=Qi", rights, beneath)
            _call(_ADD, ctypes.c_int(ruleset), ctypes.c_int(_BENEATH), rule, ctypes.c_uint32(0))
    finally:
        os.close(beneath)


def _restrict(ruleset: int) -> None:
    """Put this thread under the rules; programs that it starts gain no privileges, which Landlock asks for."""
    library = ctypes.CDLL(None, use_errno=True)
    if library.prctl(_NO_NEW_PRIVILEGES, *map(ctypes.c_ulong, (1, 0, 0, 0))):
        raise OSError(ctypes.get_errno(), "no new privileges")
    _call(_RESTRICT, ctypes.c_int(ruleset), ctypes.c_uint32(0))
