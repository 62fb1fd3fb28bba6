import csv
from pathlib import Path

import numpy as np
import shapely
from outputs.test_location_files import located

from roadgeo.location import Location
from roadgeo.outputs.summary import write_summary
from roadgeo.storage.geopackage import read_layer

RING = [[-8.61, 41.16], [-8.60, 41.16], [-8.60, 41.15], [-8.61, 41.15]]


def test_all_footprints_in_one_geopackage_and_one_table(tmp_path: Path) -> None:
    found = {**located().to_dict(), "footprint_lonlat": RING}
    refused = Location("b.png", "not_located", "nothing, like this, fits", "porto").to_dict()
    failed = {"schema": "roadgeo.location/1", "query": "c.png", "status": "error", "reason": "no such file"}
    geopackage, table = write_summary(tmp_path, [failed, found, refused])
    (ring,), footprints = read_layer(geopackage, "footprints")
    np.testing.assert_allclose(ring[:4], RING)
    assert footprints["query"] == ["photo_mask.png"]
    _, others = read_layer(geopackage, "others")
    assert others["query"] == ["c.png", "b.png"]
    assert others["reason"] == ["no such file", "nothing, like this, fits"]
    with table.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert [row["status"] for row in rows] == ["error", "located", "not_located"]
    assert rows[2]["reason"] == "nothing, like this, fits"
    assert shapely.from_wkt(rows[1]["footprint_wkt"]).equals(shapely.Polygon(RING))
    assert [row["footprint_wkt"] for row in rows[::2]] == ["", ""]
    assert float(rows[1]["lon"]) == located().center.lon


def test_nothing_located_is_a_summary_too(tmp_path: Path) -> None:
    geopackage, table = write_summary(tmp_path, [])
    assert read_layer(geopackage, "footprints")[0] == []
    assert table.read_text().count("\n") == 1
