"""Lines on disk, where a map is cut, and what a manifest may say."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely
from worlds.scenes import random_lines

from roadgeo.errors import IndexFormatError
from roadgeo.matching.parts import touches
from roadgeo.reference.shard_plan import bounds_in_degrees, plan_shards, widen
from roadgeo.reference.shards import Manifest, ShardEntry, manifest_path, open_shards, read_manifest, write_manifest
from roadgeo.reference.spool import Spool

# --- lines on disk ----------------------------------------------------------------------------------------------------


def test_lines_come_back_for_any_box_as_if_all_had_been_cut(tmp_path):
    lines = np.array(random_lines(3, 2000.0), object)
    spool = Spool(tmp_path, 250.0)
    for first in range(0, len(lines), 100):  # as a source gives them
        spool.add(lines[first : first + 100], np.array([[f"Ö{first}", ""]] * len(lines[first : first + 100]), object))
    for box in ((0.0, 0.0, 2000.0, 2000.0), (130.0, 260.0, 700.0, 1400.0), (5000.0, 0.0, 6000.0, 10.0)):
        expected = shapely.clip_by_rect(lines, *box)
        expected = shapely.get_parts(expected[~shapely.is_empty(expected)])
        found, labels = Spool(tmp_path, 250.0).read(box)
        assert labels.shape == (len(found), 2)
        assert shapely.equals_exact(found, expected[shapely.get_type_id(expected) == 1], 0.0).all()
    found, labels = spool.read((0.0, 0.0, 2000.0, 2000.0))
    first = next(k for k, line in enumerate(found) if line.equals(lines[105]))
    assert labels[first].tolist() == ["Ö100", ""]
    assert sum(spool.n_segments.values()) == shapely.get_num_coordinates(lines).sum() - len(lines)


def test_lines_are_chosen_by_their_labels_each_once(tmp_path):
    lines = np.array(random_lines(3, 2000.0), object)
    labels = np.array([[f"{k}", ("main", "other")[k % 2]] for k in range(len(lines))], object)
    spool = Spool(tmp_path, 250.0)
    for first in range(0, len(lines), 100):
        spool.add(lines[first : first + 100], labels[first : first + 100])
    found, reported = spool.choose(lambda labels: labels[:, 1] == "main")
    assert reported.tolist() == labels[::2].tolist()
    assert shapely.equals_exact(found, lines[::2], 0.0).all()
    none, reported = spool.choose(lambda labels: labels[:, 1] == "")
    assert (len(none), reported.shape) == (0, (0, 2))
    assert len(Spool(tmp_path / "nothing", 1.0).choose(lambda labels: labels[:, 1] == "")[0]) == 0


def test_a_line_across_half_the_world_is_found_where_its_vertices_lie(tmp_path):
    spool = Spool(tmp_path, 0.05)
    spool.add(np.array([shapely.LineString([(-179.99, 10.0), (179.99, 10.01)])], object), np.array([["", ""]], object))
    lines, labels = spool.read((179.9, 9.9, 180.0, 10.1))
    assert len(lines) == 1
    assert labels.tolist() == [["", ""]]
    assert len(spool.read((0.0, 9.9, 1.0, 10.1))[0]) == 0


# --- where a map is cut -----------------------------------------------------------------------------------------------


def test_shards_cover_all_roads_once_and_hold_about_as_many_each():
    rng = np.random.default_rng(0)
    cells = {(int(x), int(y)) for x, y in rng.integers(-30, 30, (400, 2))}
    counts = {cell: int(rng.integers(1, 99)) for cell in sorted(cells)}
    boxes = [box.core for box in plan_shards(counts, 2.0, 2000)]
    held = [[c for c in counts if x0 <= 2 * c[0] < x1 and y0 <= 2 * c[1] < y1] for x0, y0, x1, y1 in boxes]
    assert sorted(cell for cells in held for cell in cells) == sorted(counts)
    assert max(sum(counts[cell] for cell in cells) for cells in held) <= 2000
    assert len(boxes) < 3 * sum(counts.values()) / 2000
    names = {box.name for box in plan_shards(counts, 2.0, 2000)}
    assert len(names) == len(boxes)


def test_squares_where_a_side_is_asked_for():
    boxes = plan_shards({(0, 0): 5, (3, 1): 1}, 100.0, 0.0)
    assert [box.core for box in boxes] == [(0.0, 0.0, 100.0, 100.0), (300.0, 100.0, 400.0, 200.0)]


def test_a_margin_is_as_wide_in_degrees_as_in_metres():
    assert widen((0.0, 0.0, 10.0, 10.0), 6.0, 2.0) == (-3.0, -3.0, 13.0, 13.0)
    x0, y0, x1, y1 = widen((10.0, 59.0, 11.0, 60.0), 1113.2, None)
    assert (y0, y1) == pytest.approx((58.99, 60.01))
    assert (10.0 - x0) == pytest.approx(0.02, rel=0.01)
    assert x1 - 11.0 == pytest.approx(10.0 - x0)
    assert bounds_in_degrees((10.0, 59.0, 11.0, 60.0), "EPSG:4326") == pytest.approx((10.0, 59.0, 11.0, 60.0))


@pytest.mark.parametrize(
    ("crs", "box", "expected"),
    [
        ("EPSG:32660", (7e5, 5e6, 9e5, 5.1e6), (179.54, 45.04, -177.84, 46.02)),
        ("EPSG:5041", (1e6, 1e6, 3e6, 3e6), (-180.0, 77.31, 180.0, 90.0)),
    ],
)
def test_bounds_astride_180_degrees_and_around_a_pole(crs, box, expected):
    assert bounds_in_degrees(box, crs) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    ("near", "may"),
    [
        ((10.5, 59.5, 10.0), True),
        ((10.5, 60.05, 5000.0), False),
        ((10.5, 60.05, 6000.0), True),
        ((11.05, 59.5, 2000.0), False),
        ((11.05, 59.5, 3000.0), True),
        ((370.5, 59.5, 1.0), True),
    ],
)
def test_a_shard_far_from_the_place_is_not_opened(near, may):
    assert touches((10.0, 59.0, 11.0, 60.0), near) == may


# --- the manifest -----------------------------------------------------------------------------------------------------

ENTRY = ShardEntry("0_0_1x1", (0, 0, 1, 1), (-1, -1, 2, 2), "EPSG:32631", 10, 8, 1.5, 99, "ab")
MANIFEST = Manifest("m", "00ff", "EPSG:4326", 3000.0, {"attribution": "x"}, (ENTRY, replace(ENTRY, name="e", crs="")))


@pytest.mark.parametrize("coarse", [None, replace(ENTRY, name="coarse"), replace(ENTRY, name="coarse", crs="")])
def test_a_manifest_is_read_as_it_was_written(tmp_path, coarse):
    manifest = replace(MANIFEST, coarse=coarse)
    number = write_manifest(tmp_path, MANIFEST).stat().st_ino
    path = write_manifest(tmp_path, manifest)
    assert path.stat().st_ino != number  # it took the other's place, whole
    assert read_manifest(path) == manifest
    reference = open_shards(path)
    assert [part.entry.name for part in reference.parts] == ["coarse", "0_0_1x1"][0 if coarse and coarse.crs else 1 :]


def test_a_manifest_of_before_there_were_coarse_maps_is_read(tmp_path):
    document = MANIFEST.to_dict()
    del document["coarse"]
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps(document))
    assert read_manifest(path) == MANIFEST
    assert manifest_path(tmp_path) == manifest_path(path) == path
    assert manifest_path(tmp_path / "none") is None
    assert [entry.name for entry in MANIFEST.filled] == ["0_0_1x1"]


@pytest.mark.parametrize(
    "change",
    [
        {"schema": "roadgeo.shards/9"},
        {"build": "../up"},
        {"shards": []},
        {"shards": [{}]},
        {"shards": 3},
        {"coarse": 3},
        {"coarse": {"name": "coarse"}},
        {"coarse": {**MANIFEST.to_dict()["shards"][0], "name": "../coarse"}},
        {"meta": []},
        {"margin_m": "3"},
        {"more": 1},
        {"shards": [{**MANIFEST.to_dict()["shards"][0], "name": "../../etc/passwd"}]},
        {"shards": [{**MANIFEST.to_dict()["shards"][0], "ground": [0, 0, 1]}]},
        {"shards": [{**MANIFEST.to_dict()["shards"][0], "intersections": "many"}]},
    ],
)
def test_a_manifest_that_cannot_be_is_refused(tmp_path, change):
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps(json.loads(json.dumps(MANIFEST.to_dict())) | change))
    with pytest.raises(IndexFormatError, match="damaged"):
        read_manifest(path)
    path.write_text("[" * 100_000)
    with pytest.raises(IndexFormatError, match="damaged"):
        read_manifest(path)
