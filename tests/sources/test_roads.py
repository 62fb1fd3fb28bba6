from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Transformer
from shapely.geometry import LineString
from worlds.fenway import elements, streets, write_streets, write_vector

from roadgeo.errors import CrsError, RoadSourceError
from roadgeo.geometry.projection import from_lonlat, to_lonlat
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.kinds import highways
from roadgeo.roads.simplification import planarize, simplify
from roadgeo.sources.roads import Roads, choose_roads, read_roads

HERE = LineString([(-71.09, 42.345), (-71.08, 42.345), (-71.08, 42.352)])


def write(path, *lines, crs="EPSG:4326", **columns):
    """Write lines given in degrees, in another CRS."""
    way = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    moved = [shapely.transform(line, lambda xy: np.stack(way.transform(*xy.T), axis=1)) for line in lines]
    return write_vector(path, moved, crs=crs, **columns)


def test_roads_lie_on_their_plane(tmp_path):
    roads = read_roads(write_streets(tmp_path / "streets.gpkg"))
    assert isinstance(roads, Roads)
    assert roads.plane.crs == "EPSG:32619"
    lines, _, tunnel = streets()
    assert len(roads) == len(lines) - tunnel.count("yes")
    coords = shapely.get_coordinates(roads.lines)
    assert np.abs(coords).max() < 2000
    first = shapely.get_coordinates(lines[0])
    np.testing.assert_allclose(shapely.get_coordinates(roads.lines[0]), from_lonlat(roads.plane, first), atol=1e-6)
    assert roads.meta["roads"] == "drivable"
    assert roads.meta["sources"] == [
        {
            "name": "streets.gpkg",
            "features": len(lines),
            "format": "GPKG",
            "layer": "streets",
            "lines": len(lines),
            "kinds_known": True,
            "other_kinds": 0,
            "tunnels": tunnel.count("yes"),
            "kept": len(roads),
        }
    ]


@pytest.mark.parametrize("crs", ["EPSG:26986", "EPSG:2249", "EPSG:3857", "EPSG:32619", "EPSG:4269"])
def test_any_crs_gives_the_same_ground(tmp_path, crs):
    """EPSG:2249 is in feet; NAD 83 and WGS 84 are within 2 m."""
    roads = read_roads(write(tmp_path / "a.gpkg", HERE, crs=crs))
    plain = read_roads(write(tmp_path / "b.gpkg", HERE))
    kept = crs in ("EPSG:26986", "EPSG:32619")
    assert roads.plane.crs == (crs if kept else plain.plane.crs)
    assert roads.meta["plane"] == ("the source's own CRS" if kept else "a metric CRS chosen for the place")
    np.testing.assert_allclose(shapely.length(roads.lines), shapely.length(plain.lines), rtol=2e-3)
    lonlat = to_lonlat(roads.plane.crs, roads.plane.to_crs(shapely.get_coordinates(roads.lines)))
    apart = from_lonlat(plain.plane, lonlat) - shapely.get_coordinates(plain.lines)
    assert np.abs(apart).max() < 2


def test_kinds_and_tunnels(tmp_path):
    lines = [LineString([(0, 0.001 * k), (0.01, 0.001 * k)]) for k in range(5)]
    file = write_vector(
        tmp_path / "roads.gpkg",
        lines,
        highway=["primary", "residential", "service", "footway", "trunk"],
        tunnel=[None, None, None, None, "yes"],
    )
    kept = {kind: len(read_roads(file, which=kind)) for kind in ("main", "drivable", "vehicles", "all")}
    assert kept == {"main": 1, "drivable": 2, "vehicles": 3, "all": 4}
    assert len(read_roads(file, tunnels=True)) == 3
    (source,) = read_roads(file).meta["sources"]
    assert (source["other_kinds"], source["tunnels"], source["kept"]) == (2, 1, 2)


def test_several_sources_in_different_crs_and_formats(tmp_path):
    there = shapely.transform(HERE, lambda xy: np.add(xy, (0.02, 0.0)))
    folder = tmp_path / "folder"
    folder.mkdir()
    write(folder / "a.shp", HERE, crs="EPSG:26986")
    write(folder / "b.geojson", there)
    osm = write_streets(tmp_path / "c.osm")
    roads = read_roads([folder, osm])
    assert [source["name"] for source in roads.meta["sources"]] == ["a.shp", "b.geojson", "c.osm"]
    assert roads.meta["attribution"] == "© OpenStreetMap contributors, ODbL 1.0"
    assert read_roads([folder, osm], attribution="mine").meta["attribution"] == "mine"
    (apart,) = shapely.distance(roads.lines[:1], roads.lines[1:2])
    assert apart == pytest.approx(0.01 * 82_300, rel=0.01)


def test_a_box_cuts(tmp_path):
    roads = read_roads(write(tmp_path / "a.gpkg", HERE), bbox=(-71.085, 42.34, -71.07, 42.35))
    expected = read_roads(
        write(tmp_path / "b.gpkg", LineString([(-71.085, 42.345), (-71.08, 42.345), (-71.08, 42.35)]))
    )
    assert shapely.length(roads.lines).sum() == pytest.approx(shapely.length(expected.lines).sum(), rel=1e-5)
    with pytest.raises(RoadSourceError, match=r"a.gpkg: no roads of the kind asked for"):
        read_roads(tmp_path / "a.gpkg", bbox=(0, 0, 1, 1))


def test_an_exchanged_box_is_suspected_only_where_roads_are(tmp_path):
    file = write(tmp_path / "a.gpkg", HERE)
    with pytest.raises(RoadSourceError, match=r"did you mean --bbox=-71\.2,42\.3,-71,42\.4\?"):
        read_roads(file, bbox=(42.3, -71.2, 42.4, -71.0))
    with pytest.raises(RoadSourceError, match=r"try another --kinds or area$"):
        read_roads(file, bbox=(10, 20, 11, 21))


def test_a_box_astride_180_degrees(tmp_path):
    lines = [LineString([(179.5, -17), (179.999, -17)]), LineString([(-179.999, -17), (-179.5, -17)])]
    roads = read_roads(write_vector(tmp_path / "fiji.gpkg", lines), bbox=(179.9, -18, -179.9, -16))
    assert shapely.total_bounds(roads.lines)[2] - shapely.total_bounds(roads.lines)[0] == pytest.approx(
        21_280, rel=0.01
    )


def test_lines_that_run_across_180_degrees(tmp_path):
    """As a program writes them that knows nothing of that meridian."""
    lines = [LineString([(179.99, -17), (-179.99, -17)]), LineString([(179.999, -17.01), (179.999, -16.99)])]
    file = write_vector(tmp_path / "fiji.gpkg", lines)
    assert shapely.length(read_roads(file).lines).tolist() == pytest.approx([2129, 2213], rel=0.01)
    for west, east, length in ((179.995, -179.995, 1064), (179.998, 180, 213), (-180, -179.998, 213)):
        roads = read_roads(file, bbox=(west, -17.005, east, -16.995))
        assert shapely.length(roads.lines)[0] == pytest.approx(length, rel=0.01)


def test_a_shapefile_without_prj_asks_for_a_crs(tmp_path):
    file = write(tmp_path / "a.shp", HERE, crs="EPSG:2249")
    expected = read_roads(file)
    file.with_suffix(".prj").unlink()
    with pytest.raises(CrsError, match=r"a.shp: has no CRS; name it, for example --crs EPSG:26986"):
        read_roads(file)
    found = read_roads(file, crs="EPSG:2249")
    assert shapely.equals_exact(found.lines, expected.lines, 0.01).all()


def test_coordinates_that_do_not_fit_the_crs(tmp_path):
    metres = write_vector(tmp_path / "a.geojson", [LineString([(236000, 900000), (237000, 900000)])])
    with pytest.raises(CrsError, match=r"a.geojson: coordinates reach 900000 and do not fit its CRS, EPSG:4326"):
        read_roads(metres)
    assert read_roads(metres, crs="EPSG:26986").plane.crs == "EPSG:26986"


def test_progress_is_told(tmp_path):
    said = []
    files = write_streets(tmp_path / "a.gpkg"), write_streets(tmp_path / "b.osm.pbf")
    read_roads(files, say=lambda *step: said.append(step))
    assert said[:3] == [("reading a.gpkg, 1 of 2",), ("reading a.gpkg, 1 of 2", 1.0), ("reading b.osm.pbf, 2 of 2",)]
    assert said[3:] == [("reading b.osm.pbf, 2 of 2", 0.5), ("reading b.osm.pbf, 2 of 2", 1.0)]
    said.clear()
    read_roads(files[0], say=lambda *step: said.append(step))
    assert said == [("reading a.gpkg",), ("reading a.gpkg", 1.0)]


def test_lines_from_memory():
    roads = choose_roads([HERE, None], crs="EPSG:4326")
    assert roads.plane.crs == "EPSG:32619"
    assert shapely.length(roads.lines).sum() == pytest.approx(823.6 + 777.6, rel=0.005)
    for crs, message in ((None, "the roads: has no CRS"), ("nonsense", "is no CRS")):
        with pytest.raises(CrsError, match=message):
            choose_roads([HERE], crs=crs)
    with pytest.raises(RoadSourceError, match="no roads"):
        choose_roads([], crs="EPSG:4326")


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32619"])
def test_a_vertex_at_the_origin_far_off_all_others_is_missing(tmp_path, caplog, crs):
    """Programs write 0, 0 where they know no place; a plane that reaches there is true nowhere."""
    lines = [HERE, shapely.transform(HERE, lambda xy: xy + 0.001), shapely.transform(HERE, lambda xy: xy - 0.001)]
    file = write(tmp_path / "a.geojson", *lines)
    if crs != "EPSG:4326":
        file = write(tmp_path / "a.gpkg", *lines, crs=crs)
    found = pyogrio.read_dataframe(file)
    right = read_roads(file)
    spoilt = shapely.LineString([(0, 0), *found.geometry[0].coords])
    roads = choose_roads([spoilt, *found.geometry], crs=crs)
    assert roads.plane.crs == right.plane.crs
    assert shapely.equals_exact(roads.lines, right.lines, 1e-6).all()
    assert "left out 1 of 4 features, which lie beyond the Earth, or have a vertex at 0, 0" in caplog.text
    near = [shapely.transform(line, lambda xy: xy - HERE.coords[0]) for line in lines]
    assert len(choose_roads(near, crs="EPSG:4326")) == 3


def junctions(ways):
    """Count the nodes where three or more pieces of road meet, straight from lists of nodes."""
    pieces = {frozenset(piece) for way in ways for piece in pairwise(way)}
    meeting = Counter(node for piece in pieces if len(piece) == 2 for node in piece)
    return sum(n >= 3 for n in meeting.values())


def osm_ways(file):
    """Nodes of the drivable ways of an OpenStreetMap file, with no help from roadgeo's reader."""
    import osmium

    for way in osmium.FileProcessor(str(file), osmium.osm.NODE | osmium.osm.WAY):
        if not isinstance(way, osmium.osm.Way) or way.tags.get("highway") not in highways("drivable"):
            continue
        if way.tags.get("area") != "yes" and way.tags.get("tunnel") not in ("yes", "avalanche_protector"):
            yield [node.ref for node in way.nodes]


def vector_ways(file):
    """Vertices of the drivable lines of a file, with no help from roadgeo's reader."""
    import geopandas as gpd
    import osmnx as ox

    if file.suffix == ".graphml":
        frame = ox.graph_to_gdfs(ox.load_graphml(file), nodes=False)
    else:
        frame = gpd.read_parquet(file) if file.suffix == ".parquet" else gpd.read_file(file)
    for _, row in frame.explode(index_parts=False).iterrows():
        tags = str(row.get("highway", "road"))
        if (
            any(tag in tags.replace("'", " ").split() for tag in ("pedestrian", "services"))
            or row.get("tunnel") == "yes"
        ):
            continue
        yield [tuple(xy) for xy in np.round(np.array(row.geometry.coords)[:, :2], 6)]


def test_counts_agree_with_the_answer_of_a_server(tmp_path):
    ways = [way["nodes"] for way in elements()[1] if way["tags"].get("tunnel") != "yes"]
    graph = planarize(read_roads(write_streets(tmp_path / "a.osm.pbf")).lines)
    crossings_on_bridges = int((graph.degree() >= 3).sum()) - junctions(ways)
    assert (junctions(ways), crossings_on_bridges) == (99, 36)


#: Intersections of real sources: counted straight from the file, after noding (bridges make crossings), and of the
#: simplified network (what a mask fuses is one).
REAL = {
    "sources/aleppo_1133.parquet": (25394, 25523, 22940),
    "sources/campo-grande.osm.gz": (7401, 7182, 6771),
    "sources/harrisburg.osm.pbf": (2847, 2982, 2856),
    "sources/krems.osm.gz": (270, 298, 240),
    "sources/liechtenstein.osm.pbf": (1235, 1238, 1148),
    "sources/liege_1656.parquet": (9735, 10281, 8452),
    "sources/monaco.osm.gz": (256, 262, 187),
    "sources/oslo_east.osm.pbf": (2293, 2378, 1714),
    "sources/porto.osm.pbf": (41987, 43709, 36533),
    "sources/scheveningen.graphml": (910, 910, 723),
    "sources/slc_4881.parquet": (7624, 8144, 7180),
    "sources/stockholm_shp/edges.shp": (526, 530, 370),
    "boston/boston_osm_roads.gpkg": (14195, 14760, 13364),
    "boston/cambridge_city_centerlines.geojson": (1515, 1522, 1460),
}


#: The smallest source of each format, of those that are counted in seconds.
SMALL = {Path(name).suffix: name for name, (n, *_) in sorted(REAL.items(), key=lambda row: -row[1][0]) if n < 3000}


@pytest.mark.parametrize("name", SMALL.values())
def test_counts_agree_with_an_independent_count(data_dir, name):
    file = data_dir / name
    independent = junctions(osm_ways(file) if ".osm" in name else vector_ways(file))
    noded = planarize(read_roads(file).lines)
    counts = independent, int((noded.degree() >= 3).sum()), len(find_intersections(simplify(noded)))
    np.testing.assert_allclose(counts, REAL[name], rtol=0.003)
    assert 0.95 < counts[1] / independent < 1.12


@pytest.mark.parametrize("crs", ["EPSG:32619", "EPSG:2154", "EPSG:4258"])
def test_exchanged_coordinates_are_mentioned(tmp_path, caplog, crs):
    lon, lat = {"EPSG:32619": (-71.0, 42.3), "EPSG:2154": (2.3, 48.8), "EPSG:4258": (-8.6, 41.1)}[crs]
    degrees = np.array([[lon, lat], [lon + 0.01, lat + 0.01], [lon + 0.02, lat]])
    xy = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*degrees.T)
    right, wrong = (np.column_stack(pair) for pair in (xy, xy[::-1]))
    for points, is_mentioned in ((right, False), (wrong, True)):
        caplog.clear()
        choose_roads([points], crs=crs)
        assert ("exchanged, x for y, they would" in caplog.text) is is_mentioned


def test_latitudes_beyond_the_pole_are_exchanged_longitudes():
    with pytest.raises(CrsError, match="do not fit its CRS, EPSG:4326; exchanged, x for y, they would: swap them"):
        choose_roads([np.array([[35.6, 139.7], [35.7, 139.8]])], crs=4326)
