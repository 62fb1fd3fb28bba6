"""Start-up: what is compiled is loaded without numba, and what is not is compiled with a word to the user."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from roadgeo.kernels import compilation
from roadgeo.kernels.compilation import compiled, entries, load, modules_of_the_search
from roadgeo.kernels.warmup import remove_unused, warm_up

#: Every array on the way from roads and mask to a place must be what the kernels expect, or numba is asked for help.
LOCATE = """
import sys
import roadgeo

from roadgeo.evaluation.demo import ROADS, demo_masks
reference = roadgeo.index(ROADS, "porto")
assert roadgeo.locate(demo_masks()[0].path, reference).status == "located"
assert "numba" not in sys.modules
"""


def test_all_kernels_of_the_search_are_kept_as_machine_code() -> None:
    values = []
    warm_up(lambda text, share=None: values.append(share))
    assert compiled()
    assert values == [] or (values[0] == 0.0 and values[-1] == 1.0)
    kept = [entry for module in modules_of_the_search() for entry in entries(module)]
    assert len(kept) > 25


def test_all_other_kernels_are_kept_too() -> None:
    """Each names the arguments that it writes to, and returns what it is annotated with."""
    folder = Path(compilation.__file__).parent
    modules = [f"roadgeo.kernels.{path.stem}" for path in sorted(folder.glob("*.py"))]
    modules = [module for module in modules if entries(module)]
    load(modules)
    assert compiled(modules)
    assert not compilation._left_to_numba & set(modules)


def test_a_warm_process_does_not_import_numba() -> None:
    warm_up()
    subprocess.run([sys.executable, "-c", LOCATE], check=True, timeout=300)


#: The process itself compiles nothing.
TOGETHER = """
import sys
from roadgeo.kernels import compilation

sys.executable = sys.argv[1]
seen, shown = [], []
compilation._compile = lambda module, _: seen.append(module.rpartition(".")[2])
compilation.load(["roadgeo.kernels.buckets", "roadgeo.kernels.road_rings"], lambda *done: shown.append(done))
print(seen, shown[-1:])
"""


@pytest.mark.parametrize(
    ("program", "compiled_here"),
    [(sys.executable, []), ("qgis", ["buckets", "road_rings"]), ("qgis-bin.exe", ["buckets", "road_rings"])],
    ids=["python", "qgis", "qgis-bin"],
)
def test_processes_of_their_own_compile_where_they_can(program: str, compiled_here: list[str], tmp_path: Path) -> None:
    environ = {**os.environ, "ROADGEO_CACHE": str(tmp_path)}
    command = [sys.executable, "-c", TOGETHER, program]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == f"{compiled_here} {[] if compiled_here else [(3, 3)]}"


def test_machine_code_that_was_not_used_for_weeks_is_removed(tmp_path: Path) -> None:
    own, young, old, other = (tmp_path / name for name in ("kernels-1-a", "kernels-1-b", "kernels-0-c", "downloads"))
    for folder in (own, young, old, other):
        folder.mkdir()
        (folder / "growth.o").write_bytes(b"code")
    for folder in (own, old, other):
        os.utime(folder, (time.time() - 40 * 86_400,) * 2)
    (tmp_path / "kernels-link").symlink_to(other)
    remove_unused(own)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "downloads",
        "kernels-1-a",
        "kernels-1-b",
        "kernels-link",
    ]
    assert (other / "growth.o").exists()
