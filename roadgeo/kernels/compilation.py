"""Kernels: Python functions that run as machine code.

A kernel's types are its annotations, arrays with their number of dimensions (`kernels.arrays`). So all kernels of a
module are compiled at once, by numba, and their machine code is one file in the user's cache folder. Later processes
load that file and call into it: numba, which takes longer to import and to load its own cache than a mask takes to be
located, is then not imported at all.

Kernels without such annotations are parts of others, or are left to numba whole.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import hashlib
import importlib
import importlib.util
import logging
import os
import platform
import re
import struct
import subprocess  # nosec B404
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TextIO, TypeVar, cast

import numpy as np

from roadgeo._version import __version__
from roadgeo.kernels.arrays import ArrayKind, Kind, TupleKind, kind_of, leaves
from roadgeo.storage.folders import cache_dir, is_private, private_temporary_dir, writable

__all__ = [
    "Kernel",
    "compiled",
    "entries",
    "kernel",
    "kernel_folder",
    "load",
    "modules_of_maps",
    "modules_of_the_search",
]

_Function = TypeVar("_Function", bound=Callable[..., Any])
#: Called with the number of kernels that are compiled, and of all.
Progress = Callable[[int, int], None]

_LOG = logging.getLogger(__name__)

#: The newest numba whose private parts `machine_code` was tested with; later versions of numba run the kernels whole.
_NEWEST_NUMBA = (0, 68)

#: Options for kernels that match, a tenth quicker: no check for division by zero, divisions may become products, and a
#: product with a sum may become a single instruction. Kernels that draw a map compute as they are written: the map must
#: be the same on every machine.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "arcp", "nsz"}}

_lock = threading.RLock()


def kernel(*, writes: tuple[str, ...] = (), **options: Any) -> Callable[[_Function], _Function]:
    """Make a function a kernel; `options` go to numba's `njit`.

    A kernel that is called from Python names the arguments whose arrays it `writes` to. Numba refuses to compile a
    kernel that writes to other arrays. A call refuses read-only arrays, which may lie in a file, for these arguments.

    Functions in inner loops take the arrays that they need, not NamedTuples of many: a call counts references to all
    members, and growth took 1.7 times as long. Stages that are called once are inlined (`forceinline`): a kernel in
    parts is then as quick as in one piece.
    """

    def decorate(function: _Function) -> _Function:
        return cast("_Function", Kernel(function, options, writes))

    return decorate


class Kernel:
    """A function that is called as machine code, from Python and from other kernels.

    Attributes
    ----------
    function : callable
        What it does, in Python.
    arguments : tuple of Kind or None
        None: it has no full annotations.
    result : Kind
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any], writes: tuple[str, ...] = ()) -> None:
        functools.update_wrapper(self, function)
        self.name, self.module = function.__name__, function.__module__
        usual = _OPTIONS if self.module.rpartition(".")[2] in _MATCHING else {}
        self.function, self.options = function, {**usual, **options}
        self.arguments, self.result = _kinds(function, writes)
        self._run: Callable[..., Any] | None = None

    def __call__(self, *args: Any) -> Any:
        """Call the machine code, which is loaded or compiled before the first call."""
        return (self._run or self._prepare())(*args)

    @cached_property
    def part(self) -> Any:
        """Functions that numba compiles into other kernels."""
        import numba

        _teach_numba()
        njit: Any = numba.njit
        return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **self.options)(self.function)

    @cached_property
    def by_numba(self) -> Any:
        """The kernel as numba itself would keep and call it."""
        import numba

        _teach_numba()
        # The setting is read when a function is decorated; it is put back, for it is everyone's.
        config: Any = numba.config
        kept = config.CACHE_DIR
        config.CACHE_DIR = os.environ.get("NUMBA_CACHE_DIR") or str(kernel_folder())
        try:
            return numba.njit(cache=True, **self.options)(self.function)
        finally:
            config.CACHE_DIR = kept

    def _prepare(self) -> Callable[..., Any]:
        if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}:
            self._run = self.function
        elif self.arguments is None or self.module in _left_to_numba:
            self._run = self.by_numba
        else:
            load([self.module])
            if self._run is None:
                self._run = self.by_numba
        return self._run

    def bind(self, code: Any, release: Callable[[int], None]) -> None:
        """Run `code`, a function of two pointers, from now on."""
        self._run = _Call(self, code, release)


@lru_cache(maxsize=1)
def _teach_numba() -> None:
    """Let kernels call kernels."""
    from numba import types
    from numba.extending import typeof_impl

    typeof_impl.register(Kernel)(lambda value, _: types.Dispatcher(value.part))


class _Call:
    """Calls machine code: arguments packed into one buffer, results unpacked from another, 8 bytes for each number.

    Arrays of other types, or not contiguous, are left to numba.
    """

    def __init__(self, kernel: Kernel, code: Any, release: Callable[[int], None]) -> None:
        self.code, self.release, self.kernel = code, release, kernel
        self.name, self.arguments, self.result = kernel.name, kernel.arguments or (), kernel.result
        given = ("d" if leaf is float else "q" for leaf in leaves(*self.arguments))
        returned = (
            f"QQ{leaf.ndim}q" if isinstance(leaf, ArrayKind) else ("d" if leaf is float else "q")
            for leaf in leaves(kernel.result)
        )
        self.pack = struct.Struct("=" + "".join(given)).pack
        self.answer = struct.Struct("=" + "".join(returned))
        self.room = ctypes.c_char * max(self.answer.size, 8)

    def __call__(self, *args: Any) -> Any:
        slots: list[Any] = []
        if not _fill(slots, args, self.arguments, self.name):
            return self.kernel.by_numba(*args)
        room = self.room()
        if self.code(self.pack(*slots), room):
            raise ArithmeticError(f"kernel {self.name} failed: a division by zero, or no memory left")
        return self._value(self.result, iter(self.answer.unpack_from(room))) if self.answer.size else None

    def _value(self, kind: Kind, slots: Iterator[Any]) -> Any:
        if isinstance(kind, TupleKind):
            return tuple(self._value(member, slots) for member in kind.members)
        if isinstance(kind, ArrayKind):
            owner, data = next(slots), next(slots)
            array = np.empty([next(slots) for _ in range(kind.ndim)], kind.dtype)
            ctypes.memmove(array.ctypes.data, data, array.nbytes)
            self.release(owner)
            return array
        return bool(next(slots)) if kind is bool else next(slots)


def _fill(slots: list[Any], values: Sequence[Any], kinds: tuple[Kind, ...], name: str) -> bool:
    """Add the machine words of the values; return False at an array of another type, or one that is not contiguous."""
    for value, kind in zip(values, kinds, strict=True):
        if type(kind) is ArrayKind:
            if value.dtype != kind.dtype or value.ndim != kind.ndim or not value.flags.c_contiguous:
                return False
            if kind.written and not value.flags.writeable:
                raise ValueError(f"kernel {name} writes to an array that is read-only")
            slots.append(id(value))
        elif type(kind) is TupleKind:
            if not _fill(slots, value, kind.members, name):
                return False
        else:
            slots.append(value)
    return True


def _kinds(function: Callable[..., Any], writes: tuple[str, ...]) -> tuple[tuple[Kind, ...] | None, Kind]:
    """Read the kinds of a function's arguments and of its result from its annotations."""
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    try:
        arguments = tuple(kind_of(function.__annotations__[name], name in writes) for name in names)
        result = kind_of(function.__annotations__["return"], True)
    except (KeyError, TypeError):
        return None, None
    # With numbers alone, or a private name, it is a part of others.
    known = any(isinstance(kind, ArrayKind | TupleKind) for kind in arguments) and not function.__name__.startswith("_")
    return (arguments, result) if known else (None, None)


# --- machine code kept ------------------------------------------------------------------------------------------------

#: Modules whose kernels every search needs: two groups that take equally long, and share few kernels, each compiled by
#: a process of its own in this order. What a map needs stands first. The kernels of the paper's method are compiled on
#: its first use.
_DRAWING = ("simplification", "parallel_roads", "intersections", "buckets", "triple_codes")
_LOCATING = ("point_matching", "adjustment", "growth", "road_raster", "road_rings", "road_votes", "road_growth")
_GROUPS = ((*_DRAWING, "thinning", "tracing", "triples"), ("roads", *_LOCATING))
#: The kernels that a map needs: the first thing that a newcomer makes.
_MAPS = (*_DRAWING, "roads")
#: Those that match what was drawn.
_MATCHING = ("roads", "triples", *_LOCATING)
_left_to_numba: set[str] = set()
_kept_alive: list[Any] = []


def modules_of_the_search() -> list[str]:
    """Names of the modules whose kernels every search needs."""
    return [f"roadgeo.kernels.{name}" for group in _GROUPS for name in group]


def modules_of_maps() -> list[str]:
    """Names of the search's modules whose kernels a map needs."""
    return [f"roadgeo.kernels.{name}" for name in _MAPS]


def entries(module: str) -> list[Kernel]:
    """Kernels of a module that can be called from Python."""
    values = vars(importlib.import_module(module)).values()
    return [v for v in values if isinstance(v, Kernel) and v.module == module and v.arguments is not None]


class _Engine(NamedTuple):
    """llvmlite and its description of this machine."""

    llvm: Any
    machine: Any
    name: str


@lru_cache(maxsize=1)
def _engine() -> _Engine:
    import llvmlite
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    # As numba does: code is compiled for this machine only.
    reloc = "static" if target.name.startswith("x86") else "default"
    machine = target.create_target_machine(cpu, features, 3, reloc, "jitdefault", jit=True)
    return _Engine(llvm, machine, f"{llvmlite.__version__} {cpu} {features}")


@lru_cache(maxsize=1)
def kernel_folder() -> Path:
    """Return the folder of the kernels' machine code, a temporary one where the user's cache folder cannot be written.

    Its name depends on everything that the code depends on. Its files are executed, so nobody else may write to it.
    """
    python = f"{platform.python_version()}{getattr(sys, 'abiflags', '')} {sys.implementation.cache_tag}"
    known = (__version__, _engine().name, platform.machine(), python, np.__version__, _numba_version())
    digest = hashlib.sha256(" ".join(known).encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    name = f"kernels-{__version__}-{digest.hexdigest()[:16]}"
    try:
        folder = cache_dir() / name
    except RuntimeError:  # no home
        return private_temporary_dir() / name
    return folder if writable(folder) and is_private(folder) else private_temporary_dir() / name


def _numba_version() -> str:
    """Return numba's version, out of its file: to import it, or to ask the package's metadata, takes too long."""
    spec = importlib.util.find_spec("numba")
    with contextlib.suppress(OSError):
        source = Path(getattr(spec, "origin", None) or "").with_name("_version.py").read_text("utf-8")
        if found := re.search(r'"version": "([^"]+)"', source):
            return found[1]
    from importlib.metadata import version

    return version("numba")


def compiled(modules: Sequence[str] | None = None) -> bool:
    """Whether the machine code of all these modules (of the search) is there."""
    return all(_file(module).exists() for module in modules or modules_of_the_search())


def load(modules: Sequence[str] | None = None, progress: Progress | None = None) -> None:
    """Load the machine code of modules (by default the search's); compile it first where the folder lacks it."""
    with _lock:
        wanted = [m for m in modules or modules_of_the_search() if m not in _left_to_numba]
        missing = [m for m in wanted if not _load(m)]
        if missing:
            with _without_collection():
                _compile_together(missing, progress or (lambda _done, _total: None))


@contextlib.contextmanager
def _without_collection() -> Iterator[None]:
    """Keep all objects meanwhile: a compiler spends a tenth of its time on the search for cycles."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def _compile_together(modules: Sequence[str], progress: Progress) -> None:
    """Compile several modules, each group of them by a process of its own; the rest, and what fails there, by this one.

    The machine code of a module depends on what its process compiled before. So the groups are the same on every
    machine, and fit for two processors.
    """
    kernels = {module: len(entries(module)) for module in modules}
    done = dict.fromkeys(modules, 0)

    def report(module: str, n: int) -> None:
        done[module] = n
        progress(sum(done.values()), sum(kernels.values()))

    def share(group: Sequence[str]) -> None:
        with contextlib.suppress(OSError), _start_helper() as helper:
            for module in group:
                if _ask(helper, module):
                    done[module] = kernels[module]

    wanted = [[m for m in map("roadgeo.kernels.{}".format, group) if m in kernels] for group in _GROUPS]
    # Within another program, as QGIS, that is what `sys.executable` may name.
    may_start = len(modules) > 1 and Path(sys.executable or "").stem.lower().startswith("python")
    threads = [threading.Thread(target=share, args=(group,), daemon=True) for group in wanted if group and may_start]
    for thread in threads:
        thread.start()
    for thread in threads:
        while thread.is_alive():
            progress(sum(done.values()), sum(kernels.values()))
            thread.join(0.2)
    for module in modules:
        if not _load(module):
            _compile(module, functools.partial(report, module))
    if threads:
        progress(sum(kernels.values()), sum(kernels.values()))


#: Starts a process that compiles the modules whose names it reads, line by line, and answers when each is done. It
#: ends when nobody asks it any more.
_HELP = """
import sys
sys.path[:] = sys.argv[1:]
from roadgeo.kernels.compilation import load
for line in sys.stdin:
    load([line.strip()])
    print("done", flush=True)
"""


def _start_helper() -> subprocess.Popen[str]:
    return subprocess.Popen(  # noqa: S603 # nosec B603
        [sys.executable, "-I", "-c", _HELP, *sys.path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def _ask(helper: subprocess.Popen[str], module: str) -> bool:
    """Let another process compile a module; return whether it did."""
    write, read = cast("tuple[TextIO, TextIO]", (helper.stdin, helper.stdout))
    print(module, file=write, flush=True)
    return bool(read.readline())


def _file(module: str) -> Path:
    return kernel_folder() / f"{module.rsplit('.', 1)[-1]}.o"


def _compile(module: str, progress: Callable[[int], None]) -> None:
    """Compile a module's kernels and keep their code; numba compiles those that this machine cannot keep."""
    try:
        _require_known_numba()
        from roadgeo.kernels.machine_code import compile_kernels

        code = compile_kernels(entries(module), _engine().llvm, _engine().machine, progress)
        _bind(module, code)
    except Exception as error:  # of private parts of numba, which other versions may have otherwise, or not at all
        why = next(iter(str(error).splitlines()), "")
        kind = type(error).__name__
        _LOG.warning("kernels of %s take longer to load, for numba keeps them: %s: %s", module, kind, why)
        _left_to_numba.add(module)
        return
    path = _file(module)
    temporary = path.with_suffix(f".{os.getpid()}.{threading.get_ident()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(hashlib.sha256(code).digest() + code)
        temporary.replace(path)  # several processes may do so at once: each file is whole
    except OSError:
        temporary.unlink(missing_ok=True)  # the disk is full: the next process compiles again


def _require_known_numba() -> None:
    """Raise `ImportError` where numba is newer than the versions that were tried."""
    found = _numba_version()
    if tuple(map(int, re.findall(r"\d+", found)[:2])) > _NEWEST_NUMBA:
        raise ImportError(f"numba {found} is newer than {'.'.join(map(str, _NEWEST_NUMBA))}")


def _load(module: str) -> bool:
    """Load a module's machine code; return False where it is missing or damaged."""
    if all(k._run is not None for k in entries(module)):
        return True
    try:
        content = _file(module).read_bytes()
    except OSError:
        return False
    if hashlib.sha256(content[32:]).digest() != content[:32]:
        return False
    _bind(module, content[32:])
    return True


def _bind(module: str, code: bytes) -> None:
    """Let a module's kernels run machine code."""
    llvm, machine, _ = _engine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _kept_alive.append(engine)
    release = ctypes.PYFUNCTYPE(None, ctypes.c_uint64)(engine.get_function_address("roadgeo_release"))
    # Other threads run meanwhile (`matching.ahead`): none of them writes to arrays that a kernel was given.
    for entry in entries(module):
        address = engine.get_function_address(f"roadgeo_{entry.name}")
        entry.bind(ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_char_p, ctypes.c_void_p)(address), release)
