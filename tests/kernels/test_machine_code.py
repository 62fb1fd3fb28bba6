"""Kernels are compiled once, kept and loaded, and give what Python gives, whatever they take and return."""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from support import toy_kernels as toys

from roadgeo.kernels import compilation

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}, reason="nothing is compiled"),
]

MODULE = toys.__name__
VALUES = np.array([[0.5, 2.0, 3.0], [1.0, -1.0, 4.0]])
STEPS = np.array([1, 2, 3])


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The machine code of the toys."""
    with pytest.MonkeyPatch.context() as patch:
        folder = fresh(patch, tmp_path_factory.mktemp("code"))
        reported: list[tuple[int, int]] = []
        compilation.load([MODULE], lambda done, of: reported.append((done, of)))
        assert reported == [(n, 4) for n in range(5)]
        (file,) = folder.iterdir()
        assert file.name == "toy_kernels.o"
        return file.read_bytes()


def fresh(patch: pytest.MonkeyPatch, folder: Path) -> Path:
    """Be a process that has not loaded anything, with an empty cache."""
    patch.setattr(compilation, "kernel_folder", lambda: folder)
    patch.setattr(compilation, "_left_to_numba", set())
    for entry in compilation.entries(MODULE):
        patch.setattr(entry, "_run", None)
    return folder


@pytest.fixture
def folder(kept: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache that holds the machine code."""
    (tmp_path / "toy_kernels.o").write_bytes(kept)
    return fresh(monkeypatch, tmp_path)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "_compile", lambda *_: pytest.fail("it is there already"))


def check_values() -> None:
    for power in (1, 2):
        for double in (False, True):
            given = (VALUES, 0.5, double, power)
            assert toys.weigh(*given) == toys.weigh.function(*given)
    out = np.zeros(3)
    assert toys.walk(toys.Line(0.5, STEPS), out) is None
    assert out.tolist() == [1.5, 3.5, 6.5]
    n, many, grid, (total, order) = toys.spread(VALUES[0])
    assert (n, many, total) == (3, True, 5.5)
    assert grid.tolist() == [[0.5, -0.5], [2.0, -2.0], [3.0, -3.0]]
    assert order.tolist() == [0, 1, 2]


@pytest.mark.usefixtures("folder", "no_compiler")
def test_what_was_kept_gives_what_python_gives() -> None:
    check_values()


@pytest.mark.usefixtures("folder", "no_compiler")
def test_arrays_of_nothing() -> None:
    n, many, grid, (total, order) = toys.spread(np.empty(0))
    assert (n, many, total, grid.shape, order.shape) == (0, False, 0.0, (0, 2), (0,))


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("values", [VALUES.T, VALUES[:, ::2], VALUES.astype(np.float32)])
def test_other_arrays_are_left_to_numba(values: np.ndarray) -> None:
    assert toys.weigh(values, 0.5, True, 2) == pytest.approx(toys.weigh.function(values, 0.5, True, 2))


@pytest.mark.usefixtures("folder", "no_compiler")
def test_a_failure_is_named() -> None:
    assert toys.share(VALUES[0], 2) == 1
    with pytest.raises(ArithmeticError, match="kernel share failed: a division by zero"):
        toys.share(VALUES[0], 0)


@pytest.mark.usefixtures("folder", "no_compiler")
def test_an_array_that_is_read_only_is_not_written_to(tmp_path: Path) -> None:
    """One that lies in a file ended the process."""
    np.zeros(3).tofile(tmp_path / "zeros")
    out = np.memmap(tmp_path / "zeros", mode="r")
    with pytest.raises(ValueError, match="kernel walk writes to an array that is read-only"):
        toys.walk(toys.Line(0.5, STEPS), out.view(np.float64))
    STEPS.flags.writeable = False  # what is only read may be
    check_values()


def test_a_kernel_that_writes_to_what_it_does_not_name_is_not_compiled() -> None:
    from numba.core.errors import TypingError

    from roadgeo.kernels.compilation import Kernel, _engine
    from roadgeo.kernels.machine_code import compile_kernels

    with pytest.raises(TypingError, match="readonly"):
        compile_kernels([Kernel(toys.walk.function, {})], _engine().llvm, _engine().machine, lambda _: None)


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_damaged_machine_code_is_made_again(folder: Path, kept: bytes, damage: bytes | None) -> None:
    (folder / "toy_kernels.o").write_bytes(kept[:-1] if damage is None else damage)
    check_values()
    assert compilation._load(MODULE)
    assert (folder / "toy_kernels.o").stat().st_size == len(kept)


def test_where_nothing_can_be_kept_kernels_run_all_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left on device")

    (folder / "toy_kernels.o").unlink()
    monkeypatch.setattr(Path, "write_bytes", full)
    check_values()
    assert not list(folder.iterdir())


@pytest.mark.parametrize("why", ["arrays look otherwise", "private parts are gone", "numba is newer"])
def test_what_cannot_be_kept_is_left_to_numba(
    why: str, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "toy_kernels.o").unlink()
    if why == "arrays look otherwise":
        monkeypatch.setattr("roadgeo.kernels.machine_code._arrays_look_as_expected", lambda: False)
    elif why == "private parts are gone":
        monkeypatch.setitem(sys.modules, "roadgeo.kernels.machine_code", None)
    else:
        monkeypatch.setattr(compilation, "_numba_version", lambda: "99.1.0rc2")
    check_values()
    assert {MODULE} == compilation._left_to_numba
    assert not (folder / "toy_kernels.o").exists()
    assert "take longer to load" in caplog.text


def test_what_is_kept_is_of_one_numba_python_and_processor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path))
    of = compilation.kernel_folder.__wrapped__
    kept = {of()}
    assert kept == {of()}
    with monkeypatch.context() as patch:
        patch.setattr(compilation, "_numba_version", lambda: "0.61.0")
        kept.add(of())
    with monkeypatch.context() as patch:
        patch.setattr(sys, "abiflags", "t", raising=False)
        kept.add(of())
    with monkeypatch.context() as patch:
        engine = compilation._engine()
        patch.setattr(compilation, "_engine", lambda: engine._replace(name=f"{engine.name},-avx2"))
        kept.add(of())
    assert len(kept) == 4


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permission bits of POSIX")
def test_a_cache_that_others_may_write_to_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What lies there is executed: anybody might have planted it."""
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    of = compilation.kernel_folder.__wrapped__
    folder = of()
    assert (folder.parent, folder.stat().st_mode & 0o777) == (tmp_path / "cache", 0o700)
    for path, mode in ((folder, 0o770), (folder, 0o707), (folder.parent, 0o777)):
        before = path.stat().st_mode
        path.chmod(mode)
        assert not of().is_relative_to(tmp_path / "cache")
        path.chmod(before)
        assert of() == folder
    monkeypatch.setattr(os, "getuid", lambda: 4242)  # somebody else's
    assert not of().is_relative_to(tmp_path / "cache")
