"""Kernels are compiled once, kept and loaded, and give what Python gives, whatever they take and return."""

import os
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
        told: list[tuple[int, int]] = []
        compilation.load([MODULE], lambda done, of: told.append((done, of)))
        assert told == [(n, 4) for n in range(5)]
        (file,) = folder.iterdir()
        assert file.name == "toy_kernels.o"
        return file.read_bytes()


def fresh(patch: pytest.MonkeyPatch, folder: Path) -> Path:
    """Be a process that has not loaded anything, with an empty cache."""
    patch.setattr(compilation, "kernel_folder", lambda: folder)
    patch.setattr(compilation, "_left_to_numba", set())
    for one in compilation.entries(MODULE):
        patch.setattr(one, "_run", None)
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


def test_what_cannot_be_kept_is_left_to_numba(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "toy_kernels.o").unlink()
    monkeypatch.setattr("roadgeo.kernels.machine_code._arrays_look_as_expected", lambda: False)
    check_values()
    assert {MODULE} == compilation._left_to_numba
    assert not (folder / "toy_kernels.o").exists()
