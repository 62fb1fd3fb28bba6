"""Each command runs in a folder of its own, with a library of its own."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path / "library"))
    monkeypatch.chdir(tmp_path)
