"""`examples/scale`: maps made of one, masks located on all of them, and the figure of what that costs."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from pyproj import CRS

import roadgeo
from roadgeo.cli import main
from roadgeo.evaluation.demo import ROADS
from roadgeo.reference.opening import open_reference

SCALE = Path(__file__).parents[2] / "examples" / "scale"


def run(name: str, *arguments: object, cwd: Path) -> str:
    command = [sys.executable, str(SCALE / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=True).stdout


def test_a_mask_has_one_place_on_maps_that_were_made_of_one(tmp_path: Path) -> None:
    item = tmp_path / "map_00.shards"
    for command in (
        ["index", "--roads", ROADS, "--shards", "auto", "--out", item],
        ["index", "--roads", ROADS, "--out", tmp_path / "porto.gpkg"],
        ["simulate", tmp_path / "porto.gpkg", "-o", tmp_path / "masks", "-n", "2", "--noise", "clean", "--size", "700"],
    ):
        assert main([*map(str, command), "--quiet"]) == 0
    assert "map_01.shards" in run("maps.py", item, "--count", 2, cwd=tmp_path)
    assert run("maps.py", item, "--count", 2, cwd=tmp_path) == ""  # it is there already
    maps = sorted(tmp_path.glob("map_*.shards"))
    reported = run(
        "measure.py", *maps, "--masks", tmp_path / "masks", "--counts", 1, 2, "--out", "measured", cwd=tmp_path
    )
    assert reported
    with (tmp_path / "measured" / "table_quick.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["masks"]) for row in rows] == [2, 2]
    assert [int(row["wrong"]) for row in rows] == [0, 0]
    assert int(rows[1]["intersections"]) == 2 * int(rows[0]["intersections"]) > 500
    mask = next((tmp_path / "masks" / "clean").glob("*.png"))
    assert roadgeo.locate(mask, [open_reference(path) for path in maps]).reference == open_reference(item).name


def test_copies_of_roads_lie_each_on_ground_of_its_own(tmp_path: Path) -> None:
    lines = shapely.linestrings(np.random.default_rng(1).uniform(0.0, 5000.0, (40, 2, 2)))
    column = {"encoding": "WKB", "geometry_types": ["LineString"], "crs": CRS("EPSG:32629").to_json_dict()}
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    schema = pa.schema([("highway", pa.string()), ("geometry", pa.binary())], {"geo": json.dumps(geo)})
    table = pa.table([["residential"] * len(lines), shapely.to_wkb(lines)], schema)
    pq.write_table(table, tmp_path / "one.parquet")
    run("roads.py", "one.parquet", "three.parquet", "--count", 3, cwd=tmp_path)
    copies = pq.ParquetFile(tmp_path / "three.parquet")
    assert (copies.num_row_groups, copies.metadata.num_rows) == (3, 3 * len(lines))
    wests = [shapely.total_bounds(shapely.from_wkb(copies.read_row_group(k)["geometry"]))[0] for k in range(3)]
    assert np.allclose(wests, [-13.5, 12.0, 24.0], atol=0.1)


def test_the_figure_shows_the_table(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run("figure.py", SCALE / "results" / "cost.csv", "scale.svg", cwd=tmp_path)
    drawn = (tmp_path / "scale.svg").read_text()
    assert "located (median)" in drawn
    assert "Gigabytes" in drawn
