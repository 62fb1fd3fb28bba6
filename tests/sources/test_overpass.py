import os
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import shapely
from worlds.fake_osm import EMPTY, OUTLINE, fake_osm
from worlds.fenway import streets, write_vector

from roadgeo.errors import RoadSourceError
from roadgeo.sources.overpass import FetchOptions, fetch_lines, find_place, read_area, square
from roadgeo.sources.roads import fetch_roads
from roadgeo.storage.folders import cache_dir


@pytest.fixture
def osm(tmp_path, monkeypatch):
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path / "cache"))
    with fake_osm() as state:
        yield state


@pytest.fixture
def pauses(monkeypatch):
    """Waiting takes no time; how long it would have."""
    waited = []
    monkeypatch.setattr(time, "sleep", waited.append)
    return waited


def ask(osm, **changes):
    return FetchOptions(overpass_url=f"{osm.url}/api", nominatim_url=osm.url, **changes)


def test_the_roads_of_a_place(osm, pauses):
    said = []
    roads = fetch_roads("Fenway, Boston", options=ask(osm), say=lambda text, share=None: said.append(text))
    (source,) = roads.meta["sources"]
    assert source["name"] == "Fenway, Boston, Massachusetts, United States"
    assert source["osm_timestamp"] == "2022-05-04T19:30:42Z"
    assert roads.meta["attribution"] == "© OpenStreetMap contributors, ODbL 1.0"
    assert roads.plane.crs == "EPSG:32619"
    lines, *_ = streets()
    inside = shapely.intersection(lines, OUTLINE)
    ratio = shapely.length(roads.lines).sum() / (shapely.length(inside).sum() * 97_000)  # metres per degree, about
    assert 0.85 < ratio < 1.2
    assert said == [f"asking {osm.url[7:]}", f"asking {osm.url[7:]}, after 1 answer"] * 2
    (query,) = osm.queries
    assert '["highway"~"^(living_street|motorway|' in query
    assert '["tunnel"!~"^(yes|avalanche_protector)$"]' in query


def test_answers_are_kept_and_grow_old(osm, pauses):
    first = fetch_roads("Fenway, Boston", options=ask(osm))
    said = []
    again = fetch_roads("Fenway, Boston", options=ask(osm), say=lambda text, share=None: said.append(text))
    assert (len(osm.queries), len(osm.searches), said) == (1, 1, [])
    assert again.meta == first.meta
    assert shapely.equals(first.lines, again.lines).all()
    for folder in (cache_dir() / "osm").iterdir():
        os.utime(folder, (0, 0))
    fetch_roads("Fenway, Boston", options=ask(osm))
    assert (len(osm.queries), len(osm.searches)) == (2, 2)
    fetch_roads("Fenway, Boston", options=ask(osm, cache=False))
    assert len(osm.queries) == 3
    fetch_roads("Fenway, Boston", which="main", options=ask(osm))
    assert len(osm.queries) == 4


def test_answers_cut_off_in_the_cache_are_fetched_anew(osm, pauses):
    fetch_roads("Fenway, Boston", options=ask(osm))
    for file in cache_dir().rglob("*.json"):
        file.write_bytes(file.read_bytes()[:-200])
    fetch_roads("Fenway, Boston", options=ask(osm))
    assert len(osm.queries) == 2


def test_a_cache_that_cannot_be_written_is_done_without(osm, pauses, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path / "file"))
    assert len(fetch_roads("Fenway, Boston", options=ask(osm))) > 0


def test_another_server_is_not_asked(osm, pauses):
    osm.overpass.append((307, {"Location": "http://localhost:9/api/interpreter"}, b""))
    with pytest.raises(RoadSourceError, match="leads to http://localhost:9, which was not asked for"):
        fetch_roads(bbox=OUTLINE.bounds, options=ask(osm))


@pytest.mark.parametrize(("limit", "value", "said"), [("_MOST_BYTES", 100, "more than 0 MB"), ("_MOST_S", 0.0, "0 s")])
def test_answers_without_end_are_cut_off(osm, pauses, monkeypatch, limit, value, said):
    monkeypatch.setattr(f"roadgeo.sources.overpass.{limit}", value)
    with pytest.raises(RoadSourceError, match=said):
        fetch_roads(bbox=OUTLINE.bounds, options=ask(osm))


def test_roads_as_of_a_day(osm, pauses):
    roads = fetch_roads(bbox=OUTLINE.bounds, options=ask(osm, date="2019-10-28"))
    assert '[date:"2019-10-28T00:00:00Z"]' in osm.queries[0]
    assert roads.meta["sources"][0]["date"] == "2019-10-28"
    with pytest.raises(RoadSourceError, match="'last year' is no date"):
        fetch_roads(bbox=OUTLINE.bounds, options=ask(osm, date="last year"))


def test_boxes_polygons_and_surroundings(osm, pauses, tmp_path):
    box = fetch_roads(bbox=OUTLINE.bounds, options=ask(osm))
    outline = write_vector(tmp_path / "outline.gpkg", [OUTLINE])
    polygon = fetch_roads(polygon=outline, options=ask(osm))
    assert len(box) == len(polygon)
    assert polygon.meta["sources"][0]["name"] == "outline"
    around = fetch_roads(around=(-71.0862, 42.3485, 200.0), options=ask(osm))
    assert 0 < len(around) < len(box)
    with pytest.raises(ValueError, match="exactly one"):
        fetch_roads("Boston", bbox=(0, 0, 1, 1))


def test_an_area_astride_180_degrees_is_asked_for_in_two(osm, pauses):
    osm.roads = EMPTY
    with pytest.raises(RoadSourceError, match="no drivable roads there"):
        fetch_roads(bbox=(179.9, -17, -179.9, -16.9), options=ask(osm))
    assert len(osm.queries) == 2
    assert len(shapely.get_parts(square(180, -17, 1000))) == 2


def test_a_large_area_is_asked_for_in_parts_and_resumed(osm, pauses, monkeypatch):
    monkeypatch.setattr("osmnx.settings.max_query_area_size", 500_000)
    osm.overpass += [(200, {}, osm.roads), "cut"]
    with pytest.raises(RoadSourceError, match="broke off"):
        fetch_roads("Fenway, Boston", options=ask(osm))
    assert len(osm.queries) == 2
    said = []
    roads = fetch_roads("Fenway, Boston", options=ask(osm), say=lambda text, share=None: said.append(text))
    n_parts = len(set(osm.queries))
    assert n_parts > 3
    assert len(osm.queries) == n_parts + 1  # what came before is kept
    assert said == [f"asking {osm.url[7:]}, after {n} answer{'s' * (n > 1)}" for n in range(1, n_parts)]
    assert len(roads) == len(fetch_roads("Fenway, Boston", options=ask(osm)))
    assert len(osm.queries) == n_parts + 1


def test_nothing_of_osmnx_is_changed_for_the_rest_of_a_program(osm, pauses):
    import osmnx

    before, resolve = dict(vars(osmnx.settings)), socket.getaddrinfo
    fetch_roads("Fenway, Boston", options=ask(osm))
    assert dict(vars(osmnx.settings)) == before
    assert socket.getaddrinfo is resolve


def test_threads_ask_their_own_servers(osm, pauses):
    """Osmnx's settings are those of the process."""
    import osmnx

    before = dict(vars(osmnx.settings))
    with fake_osm() as other, ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(fetch_roads, "Fenway, Boston", options=ask(one, cache=False)) for one in [osm, other] * 3]
        assert len({len(one.result()) for one in asked}) == 1
    assert len(osm.queries) == len(other.queries) == 3
    assert dict(vars(osmnx.settings)) == before


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Atlantis", "'Atlantis': OpenStreetMap knows no such place"),
        ("Gas Lamp", "'Gas Lamp' is a point on OpenStreetMap, not an area"),
    ],
)
def test_places_without_an_area(osm, pauses, name, message):
    with pytest.raises(RoadSourceError, match=message):
        find_place(name, ask(osm))


def test_a_busy_server_is_asked_again(osm, pauses):
    osm.overpass.extend([(429, {}, b"busy"), (504, {}, b"<html>timeout</html>")])
    said = []
    host = osm.url[7:]
    assert len(fetch_roads(bbox=OUTLINE.bounds, options=ask(osm), say=lambda text, share=None: said.append(text))) > 0
    assert said[1:] == [
        f"{host} is busy (429), asking again in a minute",
        f"{host} is busy (504), asking again in a minute",
        f"asking {host}, after 1 answer",
    ]
    assert max(pauses) == 55
    assert len(osm.queries) == 3
    assert len(set(osm.queries)) == 1


def test_a_busy_nominatim_is_asked_again(osm, pauses):
    osm.nominatim.append((429, {}, b"busy"))
    assert find_place("Fenway, Boston", ask(osm))[1].startswith("Fenway")
    assert len(osm.searches) == 2


def test_a_server_that_stays_busy_is_given_up(osm, pauses):
    osm.overpass.extend([(429, {}, b"busy")] * 9)
    with pytest.raises(RoadSourceError, match=r"is still busy \(429\) after 5 more tries; try later"):
        fetch_roads(bbox=OUTLINE.bounds, options=ask(osm))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("cut", "cannot be reached or broke off"),
        ((200, {}, EMPTY), "no drivable roads there"),
        ((200, {}, b"<html>hello</html>"), "cannot be read"),
        ((400, {}, b"<html>bad query</html>"), "cannot be read"),
        ((200, {}, b'[{"a": 1}]'), "cannot be read"),
        (
            (200, {}, EMPTY[:-1] + b', "remark": "runtime error: Query timed out in \\"query\\" at line 1"}'),
            "gave up: runtime error: Query timed out",
        ),
    ],
    ids=["cut", "empty", "html", "refused", "list", "gave up"],
)
def test_answers_that_are_of_no_use(osm, pauses, answer, message):
    osm.overpass.append(answer)
    with pytest.raises(RoadSourceError, match=message) as caught:
        fetch_roads(bbox=OUTLINE.bounds, options=ask(osm))
    assert "\n" not in str(caught.value)
    assert len(fetch_roads(bbox=OUTLINE.bounds, options=ask(osm))) > 0  # nothing of it is kept


def test_no_network(pauses, tmp_path, monkeypatch):
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path))
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        nowhere = f"http://127.0.0.1:{held.getsockname()[1]}"
        options = FetchOptions(overpass_url=nowhere, nominatim_url=nowhere)
        with pytest.raises(RoadSourceError, match="cannot be reached or broke off; is there a network connection"):
            find_place("Boston", options)
        with pytest.raises(RoadSourceError, match="cannot be reached or broke off"):
            fetch_lines(OUTLINE, "drivable", False, options)


def test_out_of_reach_is_said_at_once_and_names_the_way_out(pauses, monkeypatch, tmp_path):
    """And that at once."""
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path))
    monkeypatch.setenv("HTTPS_PROXY", "http://127.0.0.1:9")
    monkeypatch.delenv("NO_PROXY", raising=False)
    with pytest.raises(RoadSourceError, match=r"Without one give --roads FILE: extracts are at .*geofabrik") as caught:
        fetch_roads(bbox=(-8.62, 41.15, -8.61, 41.16))
    assert "did you mean" not in str(caught.value)
    assert sum(pauses) == 0


def test_an_exchanged_box_is_suspected_where_there_are_no_roads(osm, pauses):
    osm.roads = EMPTY
    with pytest.raises(RoadSourceError, match=r"did you mean --bbox=-8\.62,41\.15,-8\.61,41\.16\?"):
        fetch_roads(bbox=(41.15, -8.62, 41.16, -8.61), options=ask(osm))


@pytest.mark.parametrize(
    ("shapes", "crs", "message"),
    [
        ([shapely.LineString([(0, 0), (1, 1)])], "EPSG:4326", "no polygon in it"),
        ([OUTLINE], None, "has no CRS"),
    ],
)
def test_outlines_that_are_of_no_use(tmp_path, shapes, crs, message):
    file = tmp_path / "outline.shp"
    write_vector(file, shapes, crs=crs or "EPSG:4326")
    if crs is None:
        file.with_suffix(".prj").unlink()
    with pytest.raises(RoadSourceError, match=message):
        read_area(file)
    with pytest.raises(RoadSourceError, match="no such file"):
        read_area(tmp_path / "nowhere.gpkg")
    (tmp_path / "nonsense.gpkg").write_text("nonsense")
    with pytest.raises(RoadSourceError, match="not readable as a map"):
        read_area(tmp_path / "nonsense.gpkg")


def test_outlines_in_any_crs(tmp_path):
    file = write_vector(tmp_path / "outline.gpkg", [shapely.box(330_000, 4_690_000, 331_000, 4_691_000)], "EPSG:32619")
    area, _ = read_area(file)
    assert np.allclose(area.centroid.coords[0], (-71.06, 42.35), atol=0.02)
