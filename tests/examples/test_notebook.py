"""The notebooks, one for each kind of user, run as they stand, and are stored without what they printed."""

from pathlib import Path

import nbclient
import nbformat
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("locate.ipynb", ["located", "drone_report.html", "<Reason.", "EPSG:32629"]),
        ("georeference.ipynb", ["located", "drone_photo.jpg.points", "'off'", "'east_m': -29."]),
        ("flight.ipynb", ["00.png located", "05.png tracked", "not_located"]),
    ],
)
def test_a_notebook_runs(name: str, expected: list[str], tmp_path: Path) -> None:
    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    assert not [cell for cell in notebook.cells if cell.get("outputs")]
    nbclient.NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "\n".join(str(output.get("text") or output.get("data")) for output in shown)
    assert [value for value in expected if value not in text] == []
    assert name != "locate.ipynb" or any("image/svg+xml" in output.get("data", {}) for output in shown)
