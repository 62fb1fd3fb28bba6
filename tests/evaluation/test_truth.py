"""Tables of truths, ours and foreign."""

import csv
import json

import numpy as np
import pytest

from roadgeo.errors import OutputError, RoadSourceError
from roadgeo.evaluation.truth import Truth, read_truth, write_truth
from roadgeo.storage.geopackage import read_layer

MATRIX = np.array([[0.9, 0.1, 330000.123456789], [0.12, -1.1, 4690000.5], [1e-5, -2e-5, 1.0]])
TRUTHS = [
    Truth(
        "clean/q_0.png", "clean", MATRIX, "EPSG:32619", (1500, 1000), True, {"tilt_deg": 12.5, "n_intersections": 33}
    ),
    Truth("poor/q_0.png", "poor", MATRIX * 1.01, "EPSG:32619", (20, 10), False, {"missing": 0.1}),
]


@pytest.mark.parametrize("name", ["truth.csv", "truth.json"])
def test_what_was_written_is_read(name, tmp_path):
    write_truth(tmp_path, TRUTHS)
    for ours, theirs in zip(TRUTHS, read_truth(tmp_path / name), strict=True):
        assert np.array_equal(ours.homography, theirs.homography)
        assert (ours.file, ours.kind, ours.crs, ours.size, ours.on_map) == (
            theirs.file,
            theirs.kind,
            theirs.crs,
            theirs.size,
            theirs.on_map,
        )
        assert ours.properties == theirs.properties


def test_footprints_are_drawn(tmp_path):
    write_truth(tmp_path, TRUTHS)
    rings, columns = read_layer(tmp_path / "footprints.gpkg", "footprints")
    assert rings[0][:4] == pytest.approx(TRUTHS[0].footprint)
    assert columns["file"] == ["clean/q_0.png", "poor/q_0.png"]
    assert columns["tilt_deg"] == [12.5, None]


def test_no_queries_are_a_table_without_rows(tmp_path):
    write_truth(tmp_path, [])
    assert read_truth(tmp_path / "truth.csv") == []
    assert read_truth(tmp_path / "truth.json") == []


def test_a_local_table_counts_from_pixel_centres(tmp_path):
    row = {
        "query": "x_clean_000",
        "kind": "clean",
        "file": "clean/q_000.png",
        "centre_x": 1000.0,
        "centre_y": 2000.0,
        "centre_e": 401000.0,
        "centre_n": 4502000.0,
        "n_intersections": 31,
        "gsd": 1.0,
        "tilt_deg": 0.0,
        **{f"h{i}{j}": v for (i, j), v in np.ndenumerate([[1, 0, 250.5], [0, -1, 2749.5], [0, 0, 1]])},
    }
    with (tmp_path / "truth.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, row)
        table.writeheader()
        table.writerow(row)
    (truth,) = read_truth(tmp_path / "truth.csv")
    assert truth.crs is None
    assert truth.center == pytest.approx([401000.0, 4502000.0])
    assert truth.footprint[0] == pytest.approx([400250.0, 4502750.0])
    assert truth.properties == {"n_intersections": 31, "gsd_m": 1, "tilt_deg": 0}
    (tmp_path / "meta.json").write_text('{"crs": "EPSG:32612"}')
    assert read_truth(tmp_path / "truth.csv")[0].crs == "EPSG:32612"


def test_tiles_are_north_up_around_their_centres(tmp_path):
    (tmp_path / "tiles.csv").write_text(
        "tile,easting,northing,in_map,share_of_mask_on_map,white\n"
        "22828990,228236.5,899021.0,True,0.729,0.1\n22828991,228236.5,899021.0,False,0.0,0.1\n"
    )
    on, off = read_truth(tmp_path / "tiles.csv")
    assert (on.file, on.kind, on.crs) == ("masks/22828990.png", "mask", "EPSG:26986")
    assert on.center == pytest.approx([228236.5, 899021.0])
    assert on.footprint[0] == pytest.approx([227486.5, 899771.0])
    assert on.on_map
    assert not off.on_map


@pytest.mark.parametrize(
    "text",
    [
        "a,b\n1,2\n",
        "{}",
        '{"queries": [{}]}',
        '{"queries": 3}',
        "file,kind\nx,y\n",
        "\x00",
        f"file,kind\n{'x' * 200_000},y\n",
    ],
)
def test_other_tables_are_refused(text, tmp_path):
    (tmp_path / "truth.csv").write_text(text)
    if text == "\x00":
        assert read_truth(tmp_path / "truth.csv") == []
    else:
        with pytest.raises(RoadSourceError, match="no table of truths"):
            read_truth(tmp_path / "truth.csv")


def test_files_that_cannot_be(tmp_path):
    with pytest.raises(RoadSourceError, match="cannot read"):
        read_truth(tmp_path / "nowhere.csv")
    with pytest.raises(OutputError):
        write_truth(tmp_path / "nowhere", TRUTHS)


def test_the_json_is_plain(tmp_path):
    write_truth(tmp_path, TRUTHS)
    table = json.loads((tmp_path / "truth.json").read_text())
    assert table["schema"] == "roadgeo.truth/1"
    assert table["queries"][0]["homography"] == MATRIX.tolist()
