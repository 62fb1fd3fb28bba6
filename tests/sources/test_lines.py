import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import (
    GeometryCollection,
    LinearRing,
    LineString,
    MultiLineString,
    MultiPoint,
    Point,
    Polygon,
    box,
)
from worlds.fenway import streets, write_streets, write_vector

from roadgeo.errors import RoadSourceError
from roadgeo.sources.lines import OSM_ATTRIBUTION, simple_lines
from roadgeo.sources.streams import list_sources, read_lines

FORMATS = [
    "streets.gpkg",
    "streets.shp",
    "streets.geojson",
    "streets.fgb",
    "streets.parquet",
    "streets.osm",
    "streets.osm.gz",
    "streets.osm.bz2",
    "streets.osm.pbf",
]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_lines(tmp_path, name):
    lines, highway, tunnel = streets()
    read = read_lines(write_streets(tmp_path / name))
    assert read.crs == "EPSG:4326"
    assert read.meta["features"] == len(read.lines) == len(lines)
    here, there = np.argsort(shapely.length(lines)), np.argsort(shapely.length(read.lines))  # FlatGeobuf sorts by place
    assert read.highway[there].tolist() == [highway[k] for k in here]
    assert read.tunnel[there].tolist() == [tunnel[k] == "yes" for k in here]
    assert shapely.equals_exact(read.lines[there], lines[here], 1e-7).all()
    assert (read.meta.get("attribution") == OSM_ATTRIBUTION) == (".osm" in name)


def test_graphml_of_osmnx(tmp_path):
    import networkx as nx
    import osmnx as ox

    graph = nx.MultiDiGraph(crs="epsg:4326")
    graph.add_node(1, x=-71.09, y=42.35)
    graph.add_node(2, x=-71.08, y=42.35)
    graph.add_edge(1, 2, key=0, osmid=5, highway=["residential", "tertiary"], length=800.0)
    graph.add_edge(2, 1, key=0, osmid=6, highway="footway", tunnel="yes", length=800.0)
    ox.save_graphml(graph, tmp_path / "streets.graphml")
    read = read_lines(tmp_path / "streets.graphml")
    assert read.crs == "EPSG:4326"
    assert [line.coords[0] for line in read.lines] == [(-71.09, 42.35), (-71.08, 42.35)]
    assert read.highway.tolist() == ["residential;tertiary", "footway"]
    assert read.tunnel.tolist() == [False, True]


def test_overture_segments(tmp_path):
    import geopandas as gpd

    flags = [
        None,
        [{"values": ["is_tunnel"], "between": None}],
        [{"values": ["is_tunnel"], "between": [0.1, 0.2]}],
        None,
    ]
    frame = gpd.GeoDataFrame(
        {
            "id": list("abcd"),
            "subtype": ["road", "road", "road", "rail"],
            "class": ["residential", "primary", "service", "unknown"],
            "road_flags": flags,
        },
        geometry=[LineString([(k, 0), (k, 1)]) for k in range(4)],
        crs="OGC:CRS84",
    )
    frame.to_parquet(tmp_path / "segments.parquet")
    read = read_lines(tmp_path / "segments.parquet")
    assert read.highway.tolist() == ["residential", "primary", "service", "service", "service"]
    assert read.tunnel.tolist() == [False, True, False, True, False]
    assert "Overture" in read.meta["attribution"]


def test_an_extract_that_cuts_ways_keeps_what_is_there(tmp_path):
    rows = [
        '<osm version="0.6"><node id="1" version="1" lat="1" lon="1"/><node id="2" version="1" lat="1" lon="2"/>',
        '<way id="1" version="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="primary"/></way>',
        '<way id="2" version="1"><nd ref="2"/><nd ref="3"/><tag k="highway" v="primary"/></way>',
        '<way id="3" version="1"><nd ref="1"/><nd ref="1"/><tag k="highway" v="primary"/></way>',
        '<way id="4" version="1"><nd ref="1"/><nd ref="2"/><tag k="building" v="yes"/></way>',
        '<way id="5" version="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="footway"/><tag k="area" v="yes"/></way>',
        "</osm>",
    ]
    (tmp_path / "cut.osm").write_text("\n".join(rows))
    read = read_lines(tmp_path / "cut.osm")
    assert [list(line.coords) for line in read.lines] == [[(1, 1), (2, 1)]]
    assert read.meta["features"] == 3


def test_shapes_of_all_kinds():
    line = LineString([(0, 0), (1, 1)])
    shapes = [
        line,
        None,
        LineString(),
        MultiLineString([[(0, 0), (1, 0)], [(5, 5), (6, 6)]]),
        GeometryCollection([Point(0, 0), line, GeometryCollection([line, MultiLineString([[(2, 2), (3, 3)]])])]),
        LineString([(0, 0, 5), (1, 1, 6)]),
        LinearRing([(0, 0), (1, 0), (1, 1)]),
        LineString([(0, 0), (np.inf, 1)]),
        Point(1, 1),
        MultiPoint([(0, 0)]),
        box(0, 0, 1, 1),
    ]
    lines, place = simple_lines(np.array(shapes, object))
    assert place.tolist() == [0, 3, 3, 4, 4, 4, 5, 6]
    assert not shapely.has_z(lines).any()
    empty, _ = simple_lines(np.array([], object))
    assert len(empty) == 0


def test_a_file_without_crs_says_so(tmp_path):
    file = write_streets(tmp_path / "streets.shp")
    file.with_suffix(".prj").unlink()
    assert read_lines(file).crs is None


def test_a_crs_that_is_nowhere_is_none(tmp_path):
    engineering = 'ENGCRS["x",EDATUM["x"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    assert read_lines(write_vector(tmp_path / "x.gpkg", [LineString([(0, 0), (1, 1)])], crs=engineering)).crs is None


def test_layers(tmp_path):
    file = tmp_path / "map.gpkg"
    line = [LineString([(0, 0), (1, 1)])]
    write_vector(file, [Point(0, 0)], layer="places")
    write_vector(file, line, layer="streets", append=True)
    assert read_lines(file).meta["layer"] == "streets"
    write_vector(file, line * 2, layer="rivers", append=True)
    with pytest.raises(RoadSourceError, match="several layers hold lines, streets, rivers: choose with --layer"):
        read_lines(file)
    assert len(read_lines(file, "rivers").lines) == 2
    with pytest.raises(RoadSourceError, match="no layer 'roads'; it has places, streets, rivers"):
        read_lines(file, "roads")
    write_vector(file, line * 3, layer="roads", append=True)
    assert read_lines(file).meta["layer"] == "roads"


def broken(tmp_path, name):
    """A file of that name with nonsense in it."""
    (tmp_path / name).write_bytes(b"these are no roads\n" * 20)
    return tmp_path / name


@pytest.mark.parametrize(
    "name",
    ["x.gpkg", "x.shp", "x.geojson", "x.fgb", "x.parquet", "x.osm", "x.osm.pbf", "x.osm.gz", "x.graphml", "x.txt"],
)
def test_nonsense_is_refused_on_one_line(tmp_path, name):
    with pytest.raises(RoadSourceError, match=r"x\.") as caught:
        read_lines(broken(tmp_path, name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part_size", [1, 1 << 20])
def test_pbf_files_are_read_in_parts_and_progress_is_told(tmp_path, monkeypatch, part_size):
    file = write_streets(tmp_path / "a.osm.pbf")
    whole = read_lines(file)
    monkeypatch.setattr("roadgeo.storage.pbf._PART", part_size)
    values = []
    read = read_lines(file, advance=values.append)
    assert shapely.equals(read.lines, whole.lines).all()
    assert read.highway.tolist() == whole.highway.tolist()
    assert values == sorted(values)
    assert values[-1] == 1.0
    assert len(values) == 2 if part_size > file.stat().st_size else len(values) > 2  # nodes, then ways


@pytest.mark.parametrize("at", [300, -500, -1])
def test_a_pbf_file_that_is_cut_off_says_so(tmp_path, at):
    file = write_streets(tmp_path / "a.osm.pbf")
    file.write_bytes(file.read_bytes()[:at])
    with pytest.raises(RoadSourceError, match="cut off, damaged or no PBF file"):
        read_lines(file)


@pytest.mark.parametrize("name", FORMATS)
def test_half_a_file_is_refused_or_read_in_part(tmp_path, name):
    file = write_streets(tmp_path / name)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    try:
        assert len(read_lines(file).lines) > 0
    except RoadSourceError as error:
        assert name in str(error)  # noqa: PT017


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ([Point(0, 0)], "holds Point, expected lines"),
        ([Polygon([(0, 0), (1, 0), (1, 1)])], "holds Polygon, expected lines"),
        ([LineString()], "no lines in it"),
    ],
)
def test_what_is_no_line_is_refused(tmp_path, shapes, message):
    with pytest.raises(RoadSourceError, match=message):
        read_lines(write_vector(tmp_path / "x.gpkg", shapes))


def test_a_plain_parquet_table_is_refused(tmp_path):
    import pandas as pd

    pd.DataFrame({"highway": ["primary"]}).to_parquet(tmp_path / "x.parquet")
    with pytest.raises(RoadSourceError, match="declares no geometry column"):
        read_lines(tmp_path / "x.parquet")


@pytest.mark.parametrize("encode", [shapely.to_wkb, shapely.to_wkt], ids=["wkb", "wkt"])
@pytest.mark.parametrize("name", ["geometry", "geom", "WKB_GEOMETRY"])
def test_parquet_that_says_nothing_of_its_shapes(tmp_path, encode, name):
    import pandas as pd

    lines, highway, _ = streets()
    pd.DataFrame({"highway": highway, name: encode(lines), "id": b"1"}).to_parquet(tmp_path / "x.parquet")
    read = read_lines(tmp_path / "x.parquet")
    assert read.highway.tolist() == highway
    assert shapely.equals_exact(read.lines, lines, 1e-5).all()
    assert read.crs is None


def test_native_encodings_of_geoparquet(tmp_path):
    import geopandas as gpd

    lines, highway, _ = streets()
    frame = gpd.GeoDataFrame({"highway": highway}, geometry=lines, crs=32629)
    frame.to_parquet(tmp_path / "x.parquet", geometry_encoding="geoarrow")
    read = read_lines(tmp_path / "x.parquet")
    assert shapely.equals(read.lines, lines).all()
    assert (read.crs, read.highway.tolist()) == ("EPSG:32629", highway)


def test_folders(tmp_path):
    with pytest.raises(RoadSourceError, match="no road file in this folder"):
        list_sources(tmp_path)
    for name in ("b.gpkg", "a.osm.pbf", "c.shp"):
        write_streets(tmp_path / name)
    (tmp_path / "notes.txt").touch()
    (tmp_path / "c.shp").rename(tmp_path / "c.SHP")
    assert [file.name for file in list_sources(tmp_path)] == ["a.osm.pbf", "b.gpkg", "c.SHP"]
    assert list_sources(tmp_path / "b.gpkg") == [tmp_path / "b.gpkg"]
    with pytest.raises(RoadSourceError, match="no such file or folder"):
        list_sources(tmp_path / "d")
    with pytest.raises(RoadSourceError, match="no such file"):
        read_lines(tmp_path / "d.gpkg")


# --- containers -------------------------------------------------------------------------------------------------------


def kml(*layers):
    """KML with a folder for each list of lines."""

    def folder(n, lines):
        spots = ["".join(f"{x},{y} " for x, y in line.coords) for line in lines]
        marks = "".join(
            f"<Placemark><LineString><coordinates>{s}</coordinates></LineString></Placemark>" for s in spots
        )
        return f"<Folder><name>layer {n}</name>{marks}</Folder>"

    inner = "".join(folder(n, lines) for n, lines in enumerate(layers))
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{inner}</Document></kml>'


def gpx(*kinds):
    """GPX with the streets cut into as many parts as kinds of tracks are named."""
    lines, rows = streets()[0], []
    for kind, part in zip(kinds, np.array_split(lines, len(kinds)), strict=True):
        tag, point = {"tracks": ("trk", "trkpt"), "routes": ("rte", "rtept")}[kind]
        for line in part:
            spots = "".join(f'<{point} lat="{y}" lon="{x}"/>' for x, y in line.coords)
            rows.append(f"<{tag}>{spots if tag == 'rte' else f'<trkseg>{spots}</trkseg>'}</{tag}>")
    return f'<gpx version="1.1" creator="x" xmlns="http://www.topografix.com/GPX/1/1">{"".join(rows)}</gpx>'


@pytest.mark.parametrize("kinds", [["tracks"], ["routes"], ["routes", "tracks"]])
def test_gpx_is_read_whole(tmp_path, kinds):
    (tmp_path / "walk.gpx").write_text(gpx(*kinds))
    read = read_lines(tmp_path / "walk.gpx")
    assert len(read.lines) == len(streets()[0])
    assert read.meta["layer"] == ", ".join(kinds)
    assert len(read_lines(tmp_path / "walk.gpx", kinds[0]).lines) == -(-len(streets()[0]) // len(kinds))


def test_folders_of_kml_are_one_drawing(tmp_path):
    lines = streets()[0]
    (tmp_path / "sketch.kml").write_text(kml(lines[:5], [], lines[5:]))
    assert len(read_lines(tmp_path / "sketch.kml").lines) == len(lines)


def test_an_empty_layer_is_passed_over(tmp_path):
    file = tmp_path / "map.gpkg"
    write_vector(file, [], layer="rivers", highway=[])
    write_vector(file, [LineString([(0, 0), (1, 1)])], layer="streets", append=True)
    assert read_lines(file).meta["layer"] == "streets"


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
def test_dxf(tmp_path):
    write_vector(tmp_path / "plan.dxf", streets()[0], crs=None)
    read = read_lines(tmp_path / "plan.dxf")
    assert len(read.lines) == len(streets()[0])
    assert read.crs is None


@pytest.mark.parametrize("name", ["map.ZIP", "map.shp.zip", "map.zip"])
def test_archives(tmp_path, name):
    import zipfile

    (tmp_path / "deep").mkdir()
    write_streets(tmp_path / "deep" / "streets.shp")
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        for file in (tmp_path / "deep").iterdir():
            archive.write(file, f"a/b/{file.name}")
    assert len(read_lines(tmp_path / name).lines) == len(streets()[0])


@pytest.mark.parametrize("container", ["shp", "zip"])
@pytest.mark.parametrize("index", ["missing", "cut off", "empty"])
def test_a_shapefile_whose_index_is_lost_is_read_and_nothing_is_written_beside_it(tmp_path, index, container):
    file, lost = write_streets(tmp_path / "a.shp"), tmp_path / "a.shx"
    lost.write_bytes(lost.read_bytes()[: 0 if index == "empty" else -40])
    if index == "missing":
        lost.unlink()
    if container == "zip":
        file = Path(shutil.make_archive(str(tmp_path.parent / f"{tmp_path.name}{index}"), "zip", tmp_path))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(read_lines(file).lines) == len(streets()[0])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".geojson", ".fgb", ".gml"])
@pytest.mark.parametrize("name", ["a\nb", "a\tb", "Straße 1 道路", "a  b"])
def test_names_may_hold_anything(tmp_path, name, suffix):
    (tmp_path / "fol\nder").mkdir()
    write_streets(tmp_path / f"a{suffix}")
    for part in [*tmp_path.glob("a.*")]:
        part.rename(tmp_path / "fol\nder" / f"{name}{part.suffix}")
    assert len(read_lines(tmp_path / "fol\nder" / f"{name}{suffix}").lines) == len(streets()[0])


@pytest.mark.parametrize("share", [0.0, 0.01, 0.7])
@pytest.mark.parametrize("suffix", [".dbf", ".DBF"])
def test_a_table_that_is_cut_off_is_no_shapefile_without_kinds(tmp_path, share, suffix):
    file, table = write_streets(tmp_path / "a.shp"), tmp_path / "a.dbf"
    table.write_bytes(table.read_bytes()[: int(share * table.stat().st_size)])
    table.rename(table.with_suffix(suffix))
    with pytest.raises(RoadSourceError, match=r"its .dbf is cut off"):
        read_lines(file)


@pytest.mark.parametrize("name", ["a.csv", "a.geojson", "a.tsv"])
@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be"])
def test_text_of_two_bytes_a_letter_says_so(tmp_path, name, encoding):
    (tmp_path / name).write_bytes(b"\xfe\xff" * (encoding != "utf-16") + "WKT,highway\n".encode(encoding))
    with pytest.raises(RoadSourceError, match="text in UTF-16; save it in UTF-8"):
        read_lines(tmp_path / name)


def test_names_of_columns_that_are_not_in_the_encoding_that_a_file_names(tmp_path):
    file = write_vector(tmp_path / "a.shp", [LineString([(0, 0), (0.01, 0.01)])], vXgtyp=["Gångväg"])
    part = file.with_suffix(".dbf")
    part.write_bytes(part.read_bytes().replace(b"vXgtyp", b"v\xe4gtyp").replace("Gångväg".encode(), b"G\xe5ngv\xe4g  "))
    file.with_suffix(".cpg").write_text("UTF-8")
    read = read_lines(file)
    assert read.highway.tolist() == ["footway"]
    assert read.meta["encoding"] == "Latin-1"


@pytest.mark.parametrize("suffix", [".geojson", ".shp", ".csv"])
def test_text_that_is_not_in_the_encoding_that_a_file_names(tmp_path, suffix):
    line = LineString([(0, 0), (0.01, 0.01)])
    if suffix == ".csv":
        file = tmp_path / "a.csv"
        file.write_bytes(f'WKT,highway,name\n"{line.wkt}",primary,Concei\xe7\xe3o\n'.encode("latin-1"))
    else:
        file = write_vector(tmp_path / f"a{suffix}", [line], highway=["primary"], name=["ConceiXXo"])
        part = file.with_suffix(".dbf") if suffix == ".shp" else file
        part.write_bytes(part.read_bytes().replace(b"XX", b"\xe7\xe3"))
        if suffix == ".shp":
            file.with_suffix(".cpg").write_text("UTF-8")
    read = read_lines(file)
    assert read.highway.tolist() == ["primary"]
    assert read.name.tolist() == ["Conceição"]
    assert read.meta["encoding"] == "Latin-1"


def test_results_in_a_folder_are_no_roads(tmp_path, caplog):
    import roadgeo
    from roadgeo.sources.roads import read_roads

    write_streets(tmp_path / "streets.gpkg")
    roadgeo.index(tmp_path / "streets.gpkg", path=tmp_path / "city.gpkg")
    write_vector(tmp_path / "a_location.gpkg", streets()[0], layer="query_roads")
    assert list_sources(tmp_path) == [tmp_path / "streets.gpkg"]
    assert "city.gpkg: passed over: a result or a reference of roadgeo" in caplog.text
    assert len(read_roads(tmp_path / "city.gpkg")) > 0  # by its name


def test_a_folder_without_roads(tmp_path):
    write_vector(tmp_path / "a.gpkg", [LineString([(0, 0), (1, 1)])], fclass=["stream"])
    write_vector(tmp_path / "b.gpkg", [Point(0, 0)])
    with pytest.raises(RoadSourceError, match="none of its 2 files holds roads"):
        list_sources(tmp_path)
    (tmp_path / "c.gpkg").write_bytes(b"nonsense")
    with pytest.raises(RoadSourceError, match=r"c\.gpkg: not readable"):
        list_sources(tmp_path)
