import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from roadgeo.evaluation.demo import ROADS

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("locate_a_mask.py", ["located: ", "in EPSG:32629"]),
        ("locate_many.py", ["map_sheet.png: located", "elsewhere.png: not_located", "4 footprints"]),
    ],
)
def test_an_example_runs_as_it_stands(name: str, expected: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", str(EXAMPLES / name)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert done.stderr == ""
    for text in expected:
        assert text in done.stdout


def test_the_bench_compares_two_checkouts_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    shutil.copytree(EXAMPLES.parent / "roadgeo", tmp_path / "other" / "roadgeo")
    command = [sys.executable, str(EXAMPLES / "bench.py"), "--cities", str(ROADS), "-n", "1", "-j", "1", "--out", "out"]
    options = ["--kinds", "base", "clean", "--against", "other"]
    for _ in range(2):
        done = subprocess.run([*command, *options], capture_output=True, text=True, cwd=tmp_path, check=True)
        for text in ("base", "turned over", "highest log10 odds", "the same to the last bit, times aside: 3 of 3"):
            assert text in done.stdout
    assert (tmp_path / "out" / "bench.txt").read_text() == done.stdout
    run, _ = json.loads((tmp_path / "out" / "bench.json").read_text()).values()
    assert run["all"]["masks"] == 2
    assert run["all"]["wrong"] == run["turned over"]["wrong"] == 0
    refused = subprocess.run(
        [*command, "--against", "no such"], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert refused.returncode == 1
    assert "neither a folder nor a commit" in refused.stderr
