"""Every GeoPackage that roadgeo writes keeps the standard's rules, as far as GDAL's own validator checks them."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from support.ogc import validate

from roadgeo.cli import main
from roadgeo.evaluation.demo import ROADS, demo_masks


def test_all_that_is_written_is_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path / "library"))
    monkeypatch.chdir(tmp_path)
    masks = [str(mask.path) for mask in demo_masks() if mask.in_map][:2]
    assert main(["index", "--roads", str(ROADS), "-q"]) == 0
    assert main(["locate", *masks, "-o", "out", "-q"]) in {0, 3}
    assert main(["vectorize", masks[0], "-o", "out"]) == 0
    written = sorted(tmp_path.rglob("*.gpkg"))
    assert len(written) == 5  # the reference, two locations, their summary, a vectorized mask
    assert validate(*written) == ""


def test_the_validator_notices_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    shutil.copy(ROADS, path)
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE gpkg_geometry_columns SET geometry_type_name = 'LINES'")
        database.commit()
    assert "LINES" in validate(path, ROADS)
    assert "LINES" in validate(ROADS, path)
