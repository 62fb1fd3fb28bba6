import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


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
