"""A map in shards: built piece by piece, gone on with after a failure, and searched as one map."""

import json
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely
from worlds.fenway import write_vector
from worlds.scenes import PLANE, Sight, camera, look, mapped, random_lines, random_network, scene_of

import roadgeo
from roadgeo.cli import main
from roadgeo.errors import CrsError, IndexFormatError, RoadSourceError
from roadgeo.geometry.projection import transformer
from roadgeo.location import Seconds
from roadgeo.matching import methods
from roadgeo.matching.methods import search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import Query
from roadgeo.matching.verdict import decide
from roadgeo.reference.inspection import check_reference
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.reference.shards import write_manifest
from roadgeo.roads.network import build_network
from roadgeo.running import sharding
from roadgeo.running.sharding import RoadFiles, ShardOptions, build_shards

SIDE = 5000.0
OPTIONS = ShardOptions(size_m=2500.0, margin_m=1000.0)


@pytest.fixture(scope="module")
def roads(tmp_path_factory):
    """A town of 5 x 5 km as a road file, in degrees."""
    lines = [shapely.LineString(PLANE.to_crs(np.array(line.coords))) for line in random_lines(5, SIDE)]
    return write_vector_crs(tmp_path_factory.mktemp("roads") / "town.gpkg", lines)


def write_vector_crs(path, lines):
    n = len(lines)
    write_vector(path, lines, crs=PLANE.crs, highway=["residential"] * n, name=[f"{k}th Street" for k in range(n)])
    return path


@pytest.fixture(scope="module")
def whole(roads):
    return roadgeo.index(roads, "town")


@pytest.fixture(scope="module")
def sharded(roads, tmp_path_factory):
    return build_shards(RoadFiles((roads,)), tmp_path_factory.mktemp("sharded") / "town.shards", "town", OPTIONS)


def locate(place, *references, near=None, within=None, **sight):
    """Locate what a camera sees at a place of the town (metres from its corner)."""
    truth = camera(place, (1000, 1000), 1.0, 10.0, 40.0, 130.0)
    graph = look(towns_network(), truth, sight=Sight(1.5, **sight), seed=3)
    query = Query("q", scene_of(graph), graph, Seconds())
    options = LocateOptions(near=near)
    options = replace(options, search=replace(options.search, time_limit_s=60.0))
    options = replace(options, match=replace(options.match, within=within))
    parts = [part for one in references for part in one.parts]
    return decide(query, search_references(query, parts, options, 60.0), options)


@cache
def towns_network():
    return random_network(5, SIDE)


def gap(location, place):
    truth = PLANE.to_crs(mapped(camera(place, (1000, 1000), 1.0, 10.0, 40.0, 130.0), np.array([[500.0, -500.0]])))[0]
    return np.hypot(location.center.x - truth[0], location.center.y - truth[1])


def test_shards_hold_what_the_whole_holds(whole, sharded):
    entries = sharded.manifest.filled
    assert len(entries) >= 4
    assert sum(entry.own_intersections for entry in entries) == pytest.approx(len(whole.index), abs=3)
    assert {entry.crs for entry in entries} == {whole.index.plane.crs}
    assert check_reference(sharded.path) == []


def test_streets_keep_their_names_and_kinds(sharded):
    network = read_network(sharded.shards[0].path)
    assert set(network.kinds) == {"residential"}
    assert all(name.endswith("th Street") for name in network.names)


@pytest.mark.parametrize("place", [(1200.0, 1300.0), (2500.0, 2500.0), (2500.0, 3700.0), (3800.0, 900.0)])
def test_shards_answer_as_the_whole_does(whole, sharded, place):
    """In the middle of a shard, on a border, and where four meet: one place, and no twin of itself."""
    answers = [locate(place, one) for one in (whole, sharded)]
    for one in answers:
        assert (one.status, one.reference) == ("located", "town")
        assert gap(one, place) < 2.0
    assert answers[1].log10_odds == pytest.approx(answers[0].log10_odds, abs=2.0)
    assert np.allclose(answers[0].footprint, answers[1].footprint, atol=1.0)


def test_a_stranger_is_refused_once_for_all_shards(sharded):
    graph = look(random_network(77, 2000.0), camera((1000, 1000)), sight=Sight(1.5))
    query = Query("q", scene_of(graph), graph, Seconds())
    options = replace(LocateOptions(), effort="quick")
    answer = decide(query, search_references(query, sharded.parts, options, 60.0), options)
    assert (answer.status, answer.reference) == ("not_located", "town")
    assert "looked on" not in answer.reason


def test_only_shards_that_may_hold_the_place_are_opened(sharded, roads):
    fresh = open_reference(sharded.path)
    place = (1200.0, 1300.0)
    found = locate(place, fresh)
    opened = [one for one in fresh.parts if "_index" in vars(one)]
    assert len(opened) == len(fresh.parts)
    fresh = open_reference(sharded.path)
    near = (found.center.lon, found.center.lat, 200.0)
    assert locate(place, fresh, near=near).located
    opened = [one for one in fresh.parts if "_index" in vars(one)]
    assert len(opened) == 1
    far = locate(place, open_reference(sharded.path), near=(10.0, 10.0, 500.0))
    assert far.status == "not_located"
    assert "around the place given by near" in far.reason


def test_only_shards_that_touch_the_area_are_opened(sharded, whole):
    place = (1200.0, 1300.0)
    center = locate(place, whole).center
    box = (center.lon - 0.002, center.lat - 0.002, center.lon + 0.002, center.lat + 0.002)
    fresh = open_reference(sharded.path)
    assert locate(place, fresh, within=box).located
    assert 1 <= sum("_index" in vars(one) for one in fresh.parts) < len(fresh.parts)
    beside = (box[0] + 0.006, box[1], box[2] + 0.02, box[3])
    for reference in (fresh, whole):
        assert locate(place, reference, within=beside).status == "not_located"
        far = locate(place, reference, within=(10.0, 10.0, 10.1, 10.1))
        assert far.reason.startswith("no map has an intersection in the area given by within; searched within longi")


# --- the coarse map ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def main_roads():
    """Those of 30 x 30 km."""
    return random_lines(8, 30_000.0, 1200.0)


@pytest.fixture(scope="module")
def region(main_roads, tmp_path_factory):
    """Main roads, and the streets of a town among them, in shards."""
    folder, streets = tmp_path_factory.mktemp("region"), random_lines(5, 3000.0)
    kinds = [("motorway", "primary_link", "tertiary")[k % 3] for k in range(len(main_roads))]
    lines = [shapely.LineString(PLANE.to_crs(np.array(line.coords))) for line in (*main_roads, *streets)]
    write_vector(folder / "region.gpkg", lines, crs=PLANE.crs, highway=kinds + ["residential"] * len(streets))
    options = ShardOptions(size_m=15_000.0, margin_m=1000.0)
    return build_shards(RoadFiles((folder / "region.gpkg",)), folder / "region.shards", "region", options)


def wide_view(main_roads, **hints):
    """Return a query of pixels of 10 m, where it lies, and options."""
    truth = camera((14_000.0, 16_000.0), (1000, 1000), 10.0, 10.0, 40.0, 130.0)
    graph = look(build_network(main_roads, PLANE, {}), truth, sight=Sight(5.0), seed=3)
    options = LocateOptions()
    seen = replace(options.match.camera, **hints)
    options = replace(options, match=replace(options.match, camera=seen))
    return Query("q", scene_of(graph), graph, Seconds()), mapped(truth, np.array([[500.0, -500.0]]))[0], options


def opened(reference):
    return [one.entry.name for one in reference.parts if "_index" in vars(one)]


def test_main_roads_make_a_coarse_map_beside_the_shards(region):
    entry = region.manifest.coarse
    assert entry.intersections == pytest.approx(sum(one.own_intersections for one in region.manifest.filled), rel=0.7)
    network = read_network(region.coarse.path)
    assert set(network.kinds) == {"motorway", "primary_link", "tertiary"}
    assert region.coarse.open().coarseness == region.coarse.coarseness == 6.0
    assert region.shards[0].open().coarseness == 1.0
    assert check_reference(region.path) == []
    assert {one.name for one in region.manifest.files} == {"coarse", *(one.name for one in region.manifest.filled)}


def test_the_coarse_map_is_told_of(region, capsys):
    assert main(["reference", "info", str(region.path)]) == 0
    assert f"and a coarse map of {region.manifest.coarse.intersections:,}" in capsys.readouterr().out


@pytest.mark.parametrize("hints", [{}, {"gsd_m": (8.0, 12.0)}])
def test_a_wide_view_is_found_on_the_coarse_map_alone(region, main_roads, hints):
    fresh = open_reference(region.path)
    query, place, options = wide_view(main_roads, **hints)
    found = decide(query, search_references(query, fresh.parts, options, 60.0), options)
    assert (found.status, found.reference) == ("located", "region")
    assert np.hypot(*(np.array([found.center.x, found.center.y]) - PLANE.to_crs(place[None])[0])) < 20.0
    assert opened(fresh) == ["coarse"]
    assert fresh.index_of(found) is fresh.coarse.open()


def test_small_pixels_are_not_looked_for_on_the_coarse_map(region, main_roads):
    fresh = open_reference(region.path)
    query, _, options = wide_view(main_roads, gsd_m=(0.3, 1.5))
    options = replace(options, effort="quick")
    assert search_references(query, fresh.parts, options, 60.0)[0].places == ()
    assert set(opened(fresh)) == {one.name for one in fresh.manifest.filled}


def test_what_the_coarse_map_leaves_open_is_looked_for_on_all(region, main_roads, monkeypatch):
    """Without a first look it is found all the same: on the coarse map roads come first."""
    monkeypatch.setattr(methods, "_split", lambda parts, _: ([], list(parts)))
    fresh = open_reference(region.path)
    query, place, options = wide_view(main_roads)
    found = decide(query, search_references(query, fresh.parts, options, 60.0), options)
    assert found.located
    assert np.hypot(*(np.array([found.center.x, found.center.y]) - PLANE.to_crs(place[None])[0])) < 20.0
    assert len(opened(fresh)) == len(fresh.parts)


def test_main_roads_of_half_the_globe_have_no_coarse_map(tmp_path):
    town = [np.array(line.coords) / 111_320.0 for line in random_lines(5, 2000.0)]
    lines = [shapely.LineString(xy + np.array([lon, 1.0])) for lon in (-40.0, 0.0, 40.0) for xy in town]
    write_vector(tmp_path / "world.gpkg", lines, crs="EPSG:4326", highway=["primary"] * len(lines))
    built = build_shards(RoadFiles((tmp_path / "world.gpkg",)), tmp_path / "a.shards", "a", ShardOptions(count=3))
    assert built.coarse is None
    assert built.manifest.coarse.crs == ""
    assert len(built.shards) >= 3


def test_a_build_of_before_there_were_coarse_maps_gets_one(region, tmp_path, monkeypatch):
    folder = tmp_path / "region.shards"
    shutil.copytree(region.path, folder)
    (folder / region.manifest.build / "coarse.json").unlink()
    write_manifest(folder, replace(region.manifest, coarse=None))
    built, usual = [], sharding.build_network
    monkeypatch.setattr(
        sharding, "build_network", lambda *given, **more: built.append(given[2]["shard"]) or usual(*given, **more)
    )
    source = RoadFiles((region.path.parent / "region.gpkg",))
    again = build_shards(source, folder, "region", ShardOptions(size_m=15_000.0, margin_m=1000.0))
    assert built == ["coarse"]
    assert again.manifest == region.manifest


def test_of_too_many_main_roads_the_greatest_are_drawn(region, main_roads, tmp_path, monkeypatch):
    monkeypatch.setattr(sharding, "_MOST_MAIN", 0.8 * shapely.get_num_coordinates(main_roads).sum())
    source = RoadFiles((region.path.parent / "region.gpkg",))
    fewer = build_shards(source, tmp_path / "region.shards", "region", ShardOptions(size_m=15_000.0, margin_m=1000.0))
    assert set(read_network(fewer.coarse.path).kinds) == {"motorway", "primary_link"}


def test_a_build_that_was_cut_short_goes_on(roads, tmp_path, monkeypatch):
    folder, built = tmp_path / "town.shards", []
    usual = sharding.build_network

    def dies(lines, plane, meta, *rest, **labels):
        built.append(meta["shard"])
        if len(built) == 3:
            raise KeyboardInterrupt
        return usual(lines, plane, meta, *rest, **labels)

    monkeypatch.setattr(sharding, "build_network", dies)
    with pytest.raises(KeyboardInterrupt):
        build_shards(RoadFiles((roads,)), folder, "town", OPTIONS)
    with pytest.raises(IndexFormatError):
        open_reference(folder)
    streamed = []
    monkeypatch.setattr(sharding, "stream_lines", lambda *_, **__: streamed.append(1) or iter(()))
    reference = build_shards(RoadFiles((roads,)), folder, "town", OPTIONS)
    assert not streamed
    assert len(built) == len(set(built)) + 1  # only the one that died was begun twice
    digest = open_reference(folder).digest
    again = build_shards(RoadFiles((roads,)), folder, "town", OPTIONS)
    assert (len(built), again.manifest) == (len(reference.parts) + 1, reference.manifest)
    assert {path.name for path in folder.iterdir()} == {"manifest.json", reference.manifest.build}
    assert open_reference(folder).digest == digest


def test_a_shard_of_another_build_is_refused(sharded, tmp_path):
    shutil.copytree(sharded.path, tmp_path / "town.shards")
    fresh = open_reference(tmp_path / "town.shards")
    one, other = fresh.parts[:2]
    for ending in (".gpkg", ".index"):
        shutil.copy(other.path.with_suffix(ending), one.path.with_suffix(ending))
    with pytest.raises(IndexFormatError, match="not the shard"):
        one.open()
    assert any("not the shard" in problem for problem in check_reference(fresh.path))


def test_no_roads_no_shards(tmp_path):
    path = tmp_path / "a.gpkg"
    write_vector(path, [shapely.LineString([(0, 0), (0.01, 0)])])
    with pytest.raises(RoadSourceError, match="no shard has three intersections"):
        build_shards(RoadFiles((path,)), tmp_path / "a.shards", "a")


def test_files_of_different_crs_become_one_map(roads, sharded, tmp_path):
    """Half of the town is in degrees: then all of it is cut in degrees."""
    lines = [shapely.LineString(PLANE.to_crs(np.array(line.coords))) for line in random_lines(5, SIDE)]
    halves = [write_vector_crs(tmp_path / "metres.gpkg", lines[::2]), tmp_path / "degrees.geojson"]
    way = transformer(PLANE.crs, "EPSG:4326")
    degrees = shapely.transform(lines[1::2], lambda xy: np.stack(way.transform(*xy.T), axis=1))
    write_vector(halves[1], degrees, crs="EPSG:4326", highway=["residential"] * len(degrees))
    mixed = build_shards(RoadFiles(tuple(halves)), tmp_path / "mixed.shards", "town", OPTIONS)
    assert check_reference(mixed.path) == []
    assert len(mixed.manifest.shards) > 1
    found = locate((2500.0, 2500.0), mixed)
    assert found.located
    assert gap(found, (2500.0, 2500.0)) < 5.0


def test_a_file_without_a_crs_asks_for_it(tmp_path):
    path = write_vector(tmp_path / "a.shp", [shapely.LineString([(0, 0), (1000, 0)])])
    path.with_suffix(".prj").unlink()
    with pytest.raises(CrsError, match=r"has no CRS; name it, for example --crs EPSG:26986"):
        build_shards(RoadFiles((path,)), tmp_path / "a.shards", "a")


def test_kinds_that_are_not_there(roads, tmp_path):
    with pytest.raises(RoadSourceError, match="no roads of the kind asked for; try other --kinds"):
        build_shards(RoadFiles((roads,), which="main"), tmp_path / "a.shards", "a")


def test_the_command_line_builds_describes_lists_and_removes(roads, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path / "library"))
    (tmp_path / "library").mkdir()
    assert main(["index", "--roads", str(roads), "--shards", "2km", "--margin", "500", "--name", "Town"]) == 0
    assert "shards in" in capsys.readouterr().out
    assert main(["reference", "info", "town"]) == 0
    assert "with margins of 0.5 km" in capsys.readouterr().out
    assert main(["reference", "info", "town", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["shards"]["count"] >= 3
    assert main(["reference", "check", "town"]) == 0
    assert main(["reference", "list"]) == 0
    assert "town" in capsys.readouterr().out
    assert main(["reference", "remove", "town", "--yes"]) == 0
    assert not list((tmp_path / "library").iterdir())


@pytest.mark.parametrize("asked", [["simulate", "-o", "q"], ["evaluate", "-n", "1"], ["index", "--rebuild"]])
def test_what_needs_one_piece_says_so(sharded, asked, capsys):
    assert main([*asked, str(sharded.path)]) == 1
    message = capsys.readouterr().err
    assert "is in shards, one piece is needed; name one of them, such as" in message
    assert message.count("\n") == 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--shards", "many", "--roads", "x"], "expected auto, a number, or a side"),
        (["--shards", "4", "--osm", "Boston"], "--shards goes with --roads"),
        (["--shards", "4", "--roads", "x", "--out", "a.gpkg"], "did you mean a.shards"),
        (["--shards", "4", "--roads", "x", "--coarse"], "--shards makes a coarse map beside the shards"),
    ],
)
def test_what_cannot_be_asked_is_a_usage_error(given, message, capsys):
    assert main(["index", *given]) == 2
    assert message in capsys.readouterr().err


def test_a_search_lets_go_of_the_roads_that_masks_before_it_led_to(sharded, monkeypatch):
    gone = []
    monkeypatch.setattr(methods, "let_pages_go", gone.extend)
    assert locate((1200.0, 1300.0), sharded).status == "located"
    roads = [array for shard in sharded.shards for array in shard.open().road_buckets[:3]]
    assert {id(array) for array in roads} <= {id(array) for array in gone}
    assert not any(shard.open().table_entries is array for shard in sharded.shards for array in gone)
