"""The notebook runs as it stands, and is stored without what it printed."""

from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "locate.ipynb"


def test_the_notebook_runs(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not [cell for cell in notebook.cells if cell.get("outputs")]
    nbclient.NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("located" in one.get("text/html", "") for one in shown)
    assert any("image/png" in one for one in shown)
    assert any("drone_report.html" in one.get("text/plain", "") for one in shown)
    assert any("<Reason." in one.get("text/plain", "") for one in shown)
