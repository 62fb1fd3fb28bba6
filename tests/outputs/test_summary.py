import csv
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from outputs.test_location_files import located, road_mask

from roadgeo.location import Location
from roadgeo.outputs.columns import attributes
from roadgeo.outputs.location_layers import write_geopackage
from roadgeo.outputs.outlines import write_geojson
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.summary import write_summary
from roadgeo.storage.geopackage import read_layer

RING = [[-8.61, 41.16], [-8.60, 41.16], [-8.60, 41.15], [-8.61, 41.15]]


@pytest.mark.parametrize("text", ["=HYPERLINK(0).png", "=cmd|' -C calc'!A0", "+1", "-x.png", "@SUM(A1)", "\t=1"])
def test_no_cell_of_the_table_is_a_formula(text: str, tmp_path: Path) -> None:
    """A name, or the attribution of a map of somebody else, would be computed by a spreadsheet."""
    found = {**located().to_dict(), "footprint_lonlat": RING, "query": text, "attribution": text, "reference": "a=1"}
    with write_summary(tmp_path, [found])[1].open(newline="") as lines:
        (row,) = csv.DictReader(lines)
    shown = "'" + text.replace("\t", " ")
    assert (row["query"], row["attribution"], row["reference"]) == (shown, shown, "a=1")
    assert float(row["lon"]) < 0


def test_all_footprints_in_one_geopackage_and_one_table(tmp_path: Path) -> None:
    found = {**located().to_dict(), "footprint_lonlat": RING}
    refused = Location("b.png", "not_located", "nothing, like this, fits", "porto").to_dict()
    failed = {"schema": "roadgeo.location/1", "query": "c.png", "status": "error", "reason": "no such file"}
    geopackage, table = write_summary(tmp_path, [failed, found, refused])
    (ring,), footprints = read_layer(geopackage, "footprints")
    np.testing.assert_allclose(ring[:4], RING)
    assert footprints["query"] == ["photo_mask.png"]
    assert footprints["attribution"] == ["© somebody"]
    assert footprints["max_corner_sigma_m"] == [0.8]
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
    assert [row["attribution"] for row in rows] == ["", "© somebody", ""]
    assert [row["max_corner_sigma_m"] for row in rows] == ["", "0.8", ""]


def test_every_table_has_the_same_columns(tmp_path: Path) -> None:
    """A column that is listed once is in the summary, its CSV, and every footprint."""
    found = {**located().to_dict(), "footprint_lonlat": RING}
    geopackage, table = write_summary(tmp_path, [found])
    columns = set(attributes(found))
    assert columns <= set(read_layer(geopackage, "footprints")[1])
    assert columns <= set(table.read_text().splitlines()[0].split(","))
    subject = Subject(located(), road_mask(), output_paths(tmp_path, "a"))
    write_geopackage(tmp_path / "a.gpkg", subject)
    assert columns <= set(read_layer(tmp_path / "a.gpkg", "footprint")[1])
    write_geojson(tmp_path / "a.geojson", subject)
    assert columns == set(json.loads((tmp_path / "a.geojson").read_text())["properties"])


def test_nothing_located_is_a_summary_too(tmp_path: Path) -> None:
    geopackage, table = write_summary(tmp_path, [])
    assert read_layer(geopackage, "footprints")[0] == []
    assert table.read_text().count("\n") == 1
