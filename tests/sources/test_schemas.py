"""Tables of all schemas, in all containers, give the same roads."""

import gzip
import json
import logging

import geopandas as gpd
import networkx as nx
import numpy as np
import pandas as pd
import pytest
import shapely
from worlds.fenway import write_vector
from worlds.schemas import SCHEMAS, expected, frame, table

from roadgeo.errors import NoRoadsError, RoadSourceError
from roadgeo.geometry.projection import from_lonlat
from roadgeo.sources.lines import OSM_ATTRIBUTION, RoadTable
from roadgeo.sources.roads import choose_roads, read_roads
from roadgeo.sources.schemas import recognise

CONTAINERS = ["gpkg", "shp", "geojson", "fgb", "parquet", "frame", "folder", "zip", "geojson.gz"]


def column(*values):
    array = np.empty(len(values), object)
    array[:] = values
    return array


def roads_of(schema, container, folder, **options):
    """Write a table, and read its roads."""
    shapes, columns = table(schema)
    if container == "frame":
        return choose_roads(frame(schema), **options)
    if container == "parquet":
        frame(schema).to_parquet(folder / "roads.parquet")
        return read_roads(folder / "roads.parquet", **options)
    if container == "geojson.gz":
        write_vector(folder / "roads.geojson", shapes, **columns)
        (folder / "roads.geojson.gz").write_bytes(gzip.compress((folder / "roads.geojson").read_bytes()))
        return read_roads(folder / "roads.geojson.gz", **options)
    if container in ("folder", "zip"):
        (folder / "map").mkdir()
        write_vector(folder / "map" / "roads.shp", shapes, **columns)
        write_vector(folder / "map" / "houses.shp", [shapely.box(0, 0, 1, 1)], type=["house"])
        write_vector(folder / "map" / "fences.shp", shapes[-1:], height=[2])
        if container == "folder":
            return read_roads(folder / "map", **options)
        import shutil

        return read_roads(shutil.make_archive(str(folder / "a"), "zip", folder / "map"), **options)
    return read_roads(write_vector(folder / f"roads.{container}", shapes, **columns), **options)


@pytest.mark.filterwarnings("ignore:Normalized")
@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("schema", SCHEMAS)
def test_every_table_in_every_container_gives_the_same_roads(tmp_path, schema, container):
    found = roads_of(schema, container, tmp_path)
    right = [shapely.transform(line, lambda xy: from_lonlat(found.plane, xy)) for line in expected(schema)]
    assert len(found) == len(right)
    tree = shapely.STRtree(right)
    at, _ = tree.query_nearest(found.lines, max_distance=0.01, all_matches=False)
    assert len(at) == len(right)
    assert shapely.length(found.lines).sum() == pytest.approx(shapely.length(right).sum(), rel=1e-6)
    (source,) = found.meta["sources"]
    assert source["kinds_known"]


def test_main_roads_of_every_schema(tmp_path):
    for schema in SCHEMAS:
        main = {"tiger": ("primary",), "nvdb": ("primary", "secondary")}.get(
            schema, ("primary", "secondary", "tertiary")
        )
        assert len(choose_roads(frame(schema), "main")) == len(expected(schema, main)), schema


@pytest.mark.parametrize(
    ("columns", "attribution"),
    [
        ({"highway": ["residential"]}, ""),
        ({"highway": ["residential"], "osm_id": ["1"]}, OSM_ATTRIBUTION),
        ({"fclass": ["residential"], "osm_id": ["1"]}, OSM_ATTRIBUTION),
        (
            {"class": ["residential"], "subtype": ["road"]},
            "© OpenStreetMap contributors, Overture Maps Foundation, ODbL 1.0",
        ),
        ({"MTFCC": ["S1400"]}, "U.S. Census Bureau, TIGER/Line"),
        ({"nature": ["Sentier"]}, "© IGN, Licence Ouverte 2.0"),
        ({"width": ["4"]}, ""),
    ],
)
def test_whom_to_name(columns, attribution):
    shapes = column(shapely.LineString([(0, 0), (1, 1)]))
    made = RoadTable(shapes, None, {name: column(*values) for name, values in columns.items()})
    assert recognise(made).adapt(made).meta.get("attribution", "") == attribution


@pytest.mark.parametrize(
    ("columns", "kinds"),
    [
        ({"road_kind": ["tertiary", "footway", None]}, ["tertiary", "footway", ""]),  # a column of any name
        ({"type": ["footway", "footway", "path"]}, ["footway", "footway", ""]),
        ({"surface": ["asphalt", "gravel", "residential"]}, None),
        ({"type": ["A", "B", "residential"]}, None),
        ({"highway": ["something_new", "residential", "residential"]}, ["something_new", "residential", "residential"]),
        ({"highway": ["construction", "residential", "service"]}, ["residential", "service"]),
        ({"highway": ["residential", None, ""], "name": ["a", "b", "c"]}, ["residential"]),
        ({"highway": ["residential", None, ""], "city": ["a", "b", "c"]}, ["residential", "", ""]),  # all are roads
        ({"railway": ["rail", None, "no"]}, None),
        ({"highway": [None, None, None], "waterway": ["river", None, None]}, []),
        (
            {"HIGHWAY": ["residential", "service", "pedestrian"], "AREA": [None, "no", "yes"]},
            ["residential", "service"],
        ),
        ({"tags": [{"highway": "residential"}, {"highway": "steps"}, {"barrier": "wall"}]}, ["residential", "steps"]),
        ({"class": [float("nan"), 3, True]}, None),
        ({"name": ["residential", "b", "c"]}, None),
        ({"class": ["A", "B", "C"], "fclass": ["trunk", "trunk", "trunk"]}, ["trunk"] * 3),
        (
            {"fclass": [["residential", "tertiary"], "['primary', 'service']", "primary;steps"]},
            ["residential;tertiary", "primary;service", "primary;steps"],
        ),
    ],
)
def test_what_tells_the_kind(columns, kinds):
    shapes = column(*(shapely.LineString([(k, 0), (k, 1)]) for k in range(3)))
    made = RoadTable(shapes, None, {name: column(*values) for name, values in columns.items()})
    read = recognise(made).adapt(made)
    assert (read.highway.tolist() if read.kinds_known else None) == kinds
    assert len(read.lines) == (len(kinds) if kinds is not None else 2 if "railway" in columns else 3)


#: Words for something else that are words for kinds, too.
OTHER_WORDS = {
    "Entity": ["Line", "LWPolyline", "Line"],
    "zone": ["residential", "forest", "park"],
    "landuse_1": ["residential", "service", "park"],
    "type": ["path", "path", "path"],
    "class": ["line", "line", "line"],
    "subtype": ["track", "track", "path"],
    "ref": ["B27", "D905", "E40"],
    "nature": ["Chemin", "Mur", "Chemin"],
    "state": ["construction", "planned", "abandoned"],
    "geom_type": ["line", "Line", "unknown"],
}


@pytest.mark.parametrize("container", ["gpkg", "shp", "geojson", "fgb", "parquet", "frame", "geojson.gz", "graph"])
@pytest.mark.parametrize("name", OTHER_WORDS)
def test_words_of_other_columns_are_no_kinds(tmp_path, name, container, caplog):
    shapes = [shapely.LineString([(k, 0), (k, 1)]) for k in (0.0, 0.01, 0.02)]
    columns = {name: OTHER_WORDS[name]}
    if container == "graph":
        graph = nx.MultiGraph(crs="EPSG:4326")
        for shape, word in zip(shapes, columns[name], strict=True):
            graph.add_edge(shape.coords[0], shape.coords[-1], geometry=shape, **{name: word})
        roads = choose_roads(graph)
    elif container in ("parquet", "frame"):
        table = gpd.GeoDataFrame(columns, geometry=shapes, crs=4326)
        table.to_parquet(tmp_path / "roads.parquet")
        roads = choose_roads(table if container == "frame" else tmp_path / "roads.parquet")
    else:
        path = write_vector(tmp_path / f"roads.{container.removesuffix('.gz')}", shapes, **columns)
        if container.endswith("gz"):
            path = tmp_path / "roads.geojson.gz"
            path.write_bytes(gzip.compress(path.with_suffix("").read_bytes()))
        roads = choose_roads(path)
    assert len(roads) == 3
    assert "left out" not in caplog.text


@pytest.mark.parametrize("container", ["gpkg", "shp", "geojson", "parquet", "frame"])
@pytest.mark.parametrize(
    ("name", "words", "what"),
    [
        ("art", ["tertiary", "motorway", "river"], "no roads: streams, railways, fences, or not built"),
        ("railway", [None, None, "rail"], "no roads: streams, railways, fences, or not built"),
        ("landuse", [None, "", "forest"], "no roads: streams, railways, fences, or not built"),
        ("usage", ["Tertiary", "Residential", "Footway"], "of other kinds"),
        ("usage", ["Tertiary", "<Null>", "Pedestrian"], "of other kinds"),
    ],
)
def test_a_column_that_is_believed_is_named_and_all_keeps_all(tmp_path, name, words, what, container, caplog):
    shapes = [shapely.LineString([(k, 0), (k, 1)]) for k in (0.0, 0.01, 0.02)]
    table = gpd.GeoDataFrame({name: words}, geometry=shapes, crs=4326)
    if container == "parquet":
        table.to_parquet(tmp_path / "a.parquet")
    elif container != "frame":
        write_vector(tmp_path / f"a.{container}", shapes, **{name: words})
    source = table if container == "frame" else tmp_path / f"a.{container}"
    assert len(choose_roads(source)) == 2
    assert f"left out 1 of 3 features, which are {what}, by its column {name}; --kinds all keeps them" in caplog.text
    assert len(choose_roads(source, "all")) == 3


@pytest.mark.parametrize(
    ("value", "tunnel"),
    [
        ("yes", True),
        ("no", False),
        (None, False),
        ("building_passage", False),
        ("T", True),
        ("F", False),
        (True, True),
        (1, True),
        ("['yes', 'no']", False),
        (["yes", "yes"], True),
        ("avalanche_protector", True),
        ("", False),
    ],
)
def test_tunnels(value, tunnel):
    made = RoadTable(column(shapely.LineString([(0, 0), (1, 1)])), None, {"tunnel": column(value)})
    assert recognise(made).adapt(made).tunnel.tolist() == [tunnel]


@pytest.mark.parametrize("value", [np.True_, np.int64(3), np.float64("nan"), np.str_("x"), b"primary", 1j, {"a": 1}])
def test_values_of_any_type_are_no_fault(value):
    made = RoadTable(column(shapely.LineString([(0, 0), (1, 1)])), None)
    for name in ("highway", "class", "importance", "road_flags", "names", "other_tags", "position_p", "odd"):
        item = RoadTable(made.shapes, None, {name: column(value)})
        assert len(recognise(item).adapt(item).lines) == 1


def test_names_of_all_schemas():
    assert choose_roads(frame("overture")).names[0] == "Rua 0"
    assert choose_roads(frame("tiger")).names[0] == "Main St"


@pytest.mark.filterwarnings("ignore:invalid value")
def test_lines_that_are_broken_are_left_out_and_counted(caplog):
    lines = [shapely.LineString([(0, 0.001 * k), (0.01, 0.001 * k)]) for k in range(20)]
    lines[3] = shapely.LineString([(0, 0), (np.nan, 1)])
    lines[5] = shapely.LineString([(0, 0), (np.inf, 1)])
    lines[7] = shapely.LineString([(0, 0), (1, 1e9)])
    with caplog.at_level(logging.WARNING):
        roads = choose_roads(column(*lines), crs="EPSG:4326")
    assert len(roads) == 17
    assert "left out 2 of 20 features, which have a vertex that is not finite" in caplog.text
    assert "left out 1 of 20 features, which lie beyond the Earth" in caplog.text


def test_unknown_kinds_are_told(tmp_path, caplog):
    file = write_vector(tmp_path / "a.gpkg", [shapely.LineString([(0, 0), (0.01, 0.01)])], width=["4"])
    with caplog.at_level(logging.WARNING):
        read_roads(file)
    assert "a.gpkg: no column tells what kind of road a line is" in caplog.text
    assert "all 1 lines are taken" in caplog.text


def test_lines_of_something_else_are_no_roads(tmp_path):
    file = write_vector(tmp_path / "a.gpkg", [shapely.LineString([(0, 0), (0.01, 0.01)])], fclass=["stream"])
    with pytest.raises(NoRoadsError, match="no roads in it, for its 1 features are something else, such as streams"):
        read_roads(file)
    with pytest.raises(RoadSourceError):
        read_roads(file, which="all")


def test_lines_that_are_taken_without_a_kind_are_told(tmp_path, caplog):
    lines = [shapely.LineString([(0.001 * k, 0), (0.001 * k, 0.01)]) for k in range(3)]
    file = write_vector(tmp_path / "a.gpkg", lines, highway=["residential", None, None])
    assert len(read_roads(file).lines) == 3
    assert "2 of 3 lines have no kind of road; they are taken" in caplog.text


def overture(folder, container, lines, rules):
    """Write segments as Overture does, with rules of flags, and return what to read; a frame is given as it is."""
    columns = {"class": ["secondary"] * len(lines), "subtype": ["road"] * len(lines), "road_flags": rules}
    source = folder / f"a.{container}"
    if container in ("frame", "parquet"):
        table = gpd.GeoDataFrame(columns, geometry=lines, crs=4326)
        table.to_parquet(folder / "a.parquet")
        return table if container == "frame" else source
    return write_vector(source, lines, **columns | {"road_flags": [rule and json.dumps(rule) for rule in rules]})


@pytest.mark.parametrize("container", ["frame", "parquet", "geojson", "gpkg"])
@pytest.mark.parametrize("between", [[None, 0.4], [0.4, 0.0], [-0.1, 0.4], [0.6, None], [0.6, 2.0]])
def test_a_part_of_a_segment_may_lack_an_end(tmp_path, container, between):
    line, rule = shapely.LineString([(0, 0), (0, 0.01)]), [{"values": ["is_tunnel"], "between": between}]
    source = overture(tmp_path, container, [line], [rule])
    assert shapely.length(choose_roads(source).lines).sum() == pytest.approx(0.6 * 1105.7, rel=1e-2)


@pytest.mark.parametrize("container", ["frame", "parquet", "geojson", "gpkg"])
@pytest.mark.parametrize("between", [None, [0.0, 0.5]])
def test_a_tunnel_may_be_a_link_too(tmp_path, container, between):
    lines = [shapely.LineString([(k / 100, 0), (k / 100, 0.01)]) for k in range(2)]
    rule = [{"values": ["is_link", "is_tunnel"], "between": between}]
    source = overture(tmp_path, container, lines, [rule, None])
    seen = 1.0 if between is None else 1.5
    assert shapely.length(choose_roads(source).lines).sum() == pytest.approx(seen * 1105.7, rel=1e-2)


#: Columns with the state of a road: its value where it is not built, and where it is.
UNBUILT = {
    "road_flags": ([{"values": ["is_link", "is_under_construction"], "between": None}], [{"values": ["is_link"]}]),
    "ETAT": ("En construction", "En service"),
    "etat_de_l_objet": ("En projet", "En service"),
    "operationalState": ("Under Construction", "Open"),
    "ZUS": ("4000", "1000"),
    "Zustand": ("Im Bau", "in Betrieb"),
    "STATUS": ("Proposed", "Active"),
}


@pytest.mark.parametrize("kinds", ["drivable", "all"])
@pytest.mark.parametrize("container", ["frame", "parquet", "geojson", "gpkg", "shp", "csv"])
@pytest.mark.parametrize("column", UNBUILT)
def test_a_road_that_is_not_built_is_none(tmp_path, caplog, column, container, kinds):
    lines = [shapely.LineString([(k / 100, 0), (k / 100, 0.01)]) for k in range(3)]
    unbuilt, built = UNBUILT[column]
    values = [unbuilt, built, None]
    columns = {"class": ["secondary"] * 3, "subtype": ["road"] * 3}
    source = tmp_path / f"a.{container}"
    table = gpd.GeoDataFrame({**columns, column: values}, geometry=lines, crs=4326)
    if container == "parquet":
        table.to_parquet(source)
    elif container == "csv":
        texts = [value and value if isinstance(value, str) else json.dumps(value) for value in values]
        pd.DataFrame({**columns, column: texts, "geometry": shapely.to_wkt(lines)}).to_csv(source, index=False)
    elif container != "frame":
        texts = [value if isinstance(value, str | None) else json.dumps(value) for value in values]
        write_vector(source, lines, **columns, **{column[:10]: texts})
    found = choose_roads(
        table if container == "frame" else source, kinds, crs="EPSG:4326" if container == "csv" else None
    )
    assert len(found.lines) == 2
    assert "left out 1 of 3 features, which are no roads: streams, railways, fences, or not built" in caplog.text


@pytest.mark.parametrize("container", ["frame", "parquet", "geojson", "gpkg"])
@pytest.mark.parametrize("tunnels", [False, True])
def test_a_part_of_a_segment_that_is_not_built_is_cut_out(tmp_path, container, tunnels):
    line = shapely.LineString([(0, 0), (0, 0.01)])
    rule = [
        {"values": ["is_under_construction"], "between": [0.2, 0.5]},
        {"values": ["is_bridge"], "between": [0.7, 1]},
    ]
    source = overture(tmp_path, container, [line], [rule])
    assert shapely.length(choose_roads(source, tunnels=tunnels).lines).sum() == pytest.approx(0.7 * 1105.7, rel=1e-2)


@pytest.mark.parametrize("container", ["frame", "parquet", "geojson", "gpkg"])
def test_a_part_of_a_segment_in_a_tunnel_is_cut_out(tmp_path, container):
    """Overture's `between`: shares of the length."""
    line = shapely.LineString([(0, 0), (0, 0.01)])
    rules = [
        [{"values": ["is_tunnel"], "between": [0.2, 0.5]}, {"values": ["is_bridge"], "between": [0.7, 0.8]}],
        [{"values": ["is_tunnel"], "between": None}],
        [{"values": ["is_link"], "between": [0.0, 1.0]}],
        None,
    ]
    shapes = [shapely.affinity.translate(line, k / 100) for k in range(4)]
    source = overture(tmp_path, container, shapes, rules)
    found = choose_roads(source)
    lengths = shapely.length(found.lines) / shapely.length(choose_roads(source, tunnels=True).lines).max()
    assert sorted(lengths.tolist()) == pytest.approx([0.2, 0.5, 1.0, 1.0], abs=1e-3)
    assert shapely.length(choose_roads(source, tunnels=True).lines).sum() == pytest.approx(4 * 1105.7, rel=1e-2)


@pytest.mark.parametrize(
    ("name", "word"),
    [("a.mbtiles", "tiles"), ("a.pmtiles", "tiles"), ("a.osc", "changes"), ("a.dwg", "DXF"), ("a.xlsx", "CSV")],
)
def test_formats_that_are_not_read_say_what_to_do(tmp_path, name, word):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(RoadSourceError, match=word):
        choose_roads(tmp_path / name)
