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


def test_the_benchmark_measures_everything_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "benchmark.py"), str(ROADS), "-n", "1", "-o", "out", "--methods", "auto"]
    options = ["--kinds", "clean", "mild", "hard", "--elsewhere", "2", "--profile", "1"]
    for _ in range(2):
        done = subprocess.run([*command, *options], capture_output=True, text=True, cwd=tmp_path, check=True)
    told = ("porto_roads  clean", "turned over     2", "10^3", "right masks", "look up", "ms each under", "adjustment.")
    for text in told:
        assert text in done.stdout
    assert (tmp_path / "out" / "benchmark.txt").read_text() == done.stdout
    assert len((tmp_path / "out" / "porto_roads_auto.jsonl").read_text().splitlines()) == 4
    refused = subprocess.run([*command, "--seed", "5"], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert refused.returncode == 1
    assert "holds trials of another run" in refused.stderr


def test_results_are_compared_to_the_last_bit(tmp_path: Path) -> None:
    line = '{"query": "a.png", "status": "located", "center": {"x": 1.5}, "seconds": {"total": %s}}\n'
    for folder, seconds, x in (("before", 1, 1.5), ("same", 2, 1.5), ("after", 1, 1.5000001)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "r.jsonl").write_text((line % seconds).replace("1.5}", f"{x}}}"))

    def compare(*options: str) -> tuple[int, str]:
        command = [sys.executable, str(EXAMPLES / "compare_results.py"), *options]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
        return done.returncode, done.stdout

    assert compare("before", "same")[0] == 0
    status, told = compare("before", "after")
    assert status == 1
    assert "center.x: 1\n    a.png: 1.5 -> 1.5000001" in told
    assert compare("before", "after", "--tolerance", "1e-6")[0] == 0
