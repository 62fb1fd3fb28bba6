"""Roads that a program holds: graphs of several libraries, series, shapes."""

import contextlib
import logging
import sqlite3
import struct
from functools import cache
from pathlib import Path

import geopandas as gpd
import networkx as nx
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from worlds.fenway import streets

from roadgeo.errors import CrsError, RoadSourceError
from roadgeo.sources.roads import choose_roads

CRS = "EPSG:4326"


def osmnx_graph(kind=nx.MultiDiGraph):
    """As osmnx has them: nodes with x and y, edges some of which have a shape."""
    graph = kind(crs=CRS)
    for n, line in enumerate(streets()[0]):
        (x0, y0), *_, (x1, y1) = line.coords
        graph.add_node((n, 0), x=x0, y=y0)
        graph.add_node((n, 1), x=x1, y=y1)
        more = {} if len(line.coords) == 2 else {"geometry": line}
        graph.add_edge((n, 0), (n, 1), highway=streets()[1][n], tunnel=streets()[2][n], osmid=n, **more)
    return graph


def momepy_graph():
    """As `momepy.gdf_to_nx` makes them: nodes are coordinates, edges have shapes, the graph a CRS."""
    graph = nx.MultiGraph(crs=gpd.GeoSeries([], crs=CRS).crs, approach="primal")
    for line, highway, tunnel in zip(*streets(), strict=True):
        graph.add_edge(
            line.coords[0], line.coords[-1], geometry=line, highway=highway, tunnel=tunnel, mm_len=line.length
        )
    return graph


GRAPHS = {
    "osmnx": osmnx_graph,
    "to_digraph": lambda: osmnx_graph(nx.DiGraph),
    "to_undirected": lambda: osmnx_graph(nx.MultiGraph),
    "momepy": momepy_graph,
    "text": lambda: nx.parse_graphml("\n".join(nx.generate_graphml(_as_text(momepy_graph())))),
}


def _as_text(graph):
    plain = nx.MultiGraph(crs=CRS)
    for n, (start, end, data) in enumerate(graph.edges(data=True)):
        plain.add_edge(f"{n}a {start}", f"{n}b {end}", geometry=data["geometry"].wkt, highway=data["highway"],
                       tunnel=data["tunnel"] or "no")  # fmt: skip
    return plain


@pytest.mark.parametrize("name", GRAPHS)
def test_graphs_of_every_library_give_the_same_roads(name):
    table = gpd.GeoDataFrame({"highway": streets()[1], "tunnel": streets()[2]}, geometry=streets()[0], crs=CRS)
    right = choose_roads(table)
    found = choose_roads(GRAPHS[name](), crs=CRS)
    assert found.plane.crs == right.plane.crs
    lengths = [np.sort(shapely.length(item.lines)) for item in (found, right)]
    np.testing.assert_allclose(*lengths, atol=0.01)
    assert sorted(found.kinds) == sorted(right.kinds)


def test_a_skeleton_of_pixels_says_that_it_lies_nowhere():
    graph = nx.Graph()  # as sknw makes them: nodes are numbers, and all is rows and columns
    graph.add_node(0, pts=np.array([[3, 4]]), o=np.array([3.0, 4.0]))
    graph.add_node(1, pts=np.array([[9, 4]]), o=np.array([9.0, 4.0]))
    graph.add_edge(0, 1, pts=np.array([[4, 4], [5, 4]]), weight=2.0)
    with pytest.raises(RoadSourceError, match="have no place: expected `geometry`, or nodes with"):
        choose_roads(graph, crs=CRS)


@pytest.mark.parametrize(
    "graph", [nx.Graph([("ab", "12")]), nx.Graph([(None.__class__, 3)]), nx.Graph([((1, 2, 3), (4, 5, 6))]), nx.Graph()]
)
def test_other_graphs_are_refused(graph):
    with pytest.raises(RoadSourceError):
        choose_roads(graph, crs=CRS)


def test_a_series_says_that_it_tells_no_kinds(caplog):
    with caplog.at_level(logging.WARNING):
        roads = choose_roads(gpd.GeoSeries(streets()[0], crs=CRS))
    assert len(roads) == len(streets()[0])
    assert "the roads: no column tells what kind of road a line is" in caplog.text
    assert roads.meta["sources"][0]["kinds_known"] is False


def merged(name: str = "geometry") -> pd.DataFrame:
    """Return what `pd.merge` of a table and a GeoDataFrame gives: it has shapes, and no CRS."""
    roads = gpd.GeoDataFrame({"highway": streets()[1], name: streets()[0]}, geometry=name, crs=CRS)
    ranks = pd.DataFrame({"highway": sorted(set(streets()[1])), "rank": 1})
    return pd.merge(ranks, roads, on="highway")


@pytest.mark.parametrize("name", ["geometry", "geom"])
def test_a_table_with_shapes_needs_a_crs(name: str) -> None:
    table = merged(name)
    with pytest.raises(CrsError, match="the roads: has no CRS; name it"):
        choose_roads(table)
    right = choose_roads(gpd.GeoDataFrame({"highway": streets()[1]}, geometry=streets()[0], crs=CRS))
    assert len(choose_roads(table, crs=4326)) == len(right)
    table.loc[0, name] = None
    assert len(choose_roads(table, crs=4326)) == len(right) - 1


@pytest.mark.parametrize(
    "columns",
    [{"highway": ["residential"]}, {"geometry": ["Main Street"]}, {"geometry": [b"x"]}, {"geometry": [3.0]}, {}],
)
@pytest.mark.parametrize("library", ["pandas", "pyarrow", "stream"])
def test_a_table_without_shapes_is_refused(columns: dict[str, list[object]], library: str) -> None:
    with pytest.raises(RoadSourceError, match=r"roads of type \w+ cannot be read: .*expected a path, a GeoDataFrame"):
        choose_roads(TABLES[library](columns), crs=4326)


class Streamed:
    """Stands for a table of any library that hands it over as Arrow does."""

    def __init__(self, columns: dict[str, list[object]]) -> None:
        self.table = pa.table(columns)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        return self.table.__arrow_c_stream__(requested_schema)


def polars(columns: dict[str, list[object]]) -> object:
    return pytest.importorskip("polars").DataFrame(columns)


TABLES = {"pandas": pd.DataFrame, "pyarrow": pa.table, "stream": Streamed, "polars": polars}
SHAPES = {
    "WKB": shapely.to_wkb,
    "hexadecimal": lambda shapes: shapely.to_wkb(shapes, hex=True),
    "of PostGIS": lambda shapes: shapely.to_wkb(shapely.set_srid(shapes, 4326), hex=True, include_srid=True),
    "WKT": lambda shapes: shapely.to_wkt(shapes, rounding_precision=-1),
    "WKT of PostGIS": lambda shapes: ["SRID=4326;" + text for text in shapely.to_wkt(shapes, rounding_precision=-1)],
}


def write_sqlite(columns: dict[str, list[object]], path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as database:
        pd.DataFrame(columns).to_sql("roads", database)


#: Files of tables that declare no shapes.
FILES = {
    "roads.parquet": lambda columns, path: pq.write_table(pa.table(columns), path),
    "parquet without a suffix": lambda columns, path: pq.write_table(pa.table(columns), path),
    "roads.csv": lambda columns, path: pd.DataFrame(columns).to_csv(path, index=False),
    "semicolons.csv": lambda columns, path: pd.DataFrame(columns).to_csv(path, sep=";"),
    "roads.csv.gz": lambda columns, path: pd.DataFrame(columns).to_csv(path),
    "roads.sqlite": write_sqlite,
}


@cache
def roads_of_frame():
    """The streets as a GeoDataFrame gives them."""
    lines, highway, tunnel = streets()
    return choose_roads(gpd.GeoDataFrame({"highway": highway, "tunnel": tunnel}, geometry=lines, crs=CRS))


@pytest.mark.parametrize("name", ["geometry", "wkb_geometry", "shape_of_it", "WKT"])
@pytest.mark.parametrize("shapes", SHAPES)
@pytest.mark.parametrize("library", [*TABLES, *FILES])
def test_tables_of_any_library_give_the_same_roads(tmp_path: Path, library: str, shapes: str, name: str) -> None:
    lines, highway, tunnel = streets()
    packed = [None, *SHAPES[shapes](np.array(lines))]
    columns = {"highway": [None, *highway], "tunnel": [None, *tunnel], name: packed}
    crs = None if "PostGIS" in shapes else 4326
    if library in FILES:
        if library.endswith((".csv", ".csv.gz", ".sqlite")) and shapes == "WKB":
            pytest.skip("kept as text")
        FILES[library](columns, tmp_path / library)
        found = choose_roads(tmp_path / library, crs=crs)
    else:
        found = choose_roads(TABLES[library](columns), crs=crs)
    right = roads_of_frame()
    assert shapely.hausdorff_distance(found.lines, right.lines).max() < 1e-6
    assert found.kinds.tolist() == right.kinds.tolist()


#: A curve as other programs write it, for shapely holds none.
ARC = bytes.fromhex("010800000003000000" + struct.pack("<6d", 0, 0, 1, 1, 2, 0).hex())
CURVES = {
    "WKB": ARC,
    "WKB in digits": ARC.hex().upper(),
    "WKT": "CIRCULARSTRING (0 0,1 1,2 0)",
    "WKT of PostGIS": "SRID=4326;COMPOUNDCURVE ((0 0,1 0),CIRCULARSTRING (1 0,1 1,2 0))",
    "WKT with M": "MULTICURVE M (CIRCULARSTRING M (1 0 1,1 1 1,2 0 1))",
}


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("library", [*TABLES, *FILES])
def test_curves_in_a_column_are_refused(tmp_path: Path, library: str, curve: str) -> None:
    if curve == "WKB" and library.endswith((".csv", ".csv.gz", ".sqlite")):
        pytest.skip("kept as text")
    columns = {"highway": ["residential"] * 2, "geometry": [CURVES[curve]] * 2}
    given = tmp_path / library if library in FILES else TABLES[library](columns)
    if library in FILES:
        FILES[library](columns, given)
    with pytest.raises(RoadSourceError, match=r"holds curves.*ogr2ogr -nlt CONVERT_TO_LINEAR") as raised:
        choose_roads(given, crs=4326)
    assert str(raised.value).startswith(str(tmp_path / library) if library in FILES else "a column")


@pytest.mark.parametrize("encoding", ["WKB", "geoarrow"])
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32619"])
def test_a_table_of_geopandas_that_arrow_holds_keeps_its_crs(encoding: str, crs: str) -> None:
    table = gpd.GeoDataFrame({"highway": streets()[1]}, geometry=streets()[0], crs=CRS).to_crs(crs)
    found = choose_roads(pa.table(table.to_arrow(geometry_encoding=encoding)))
    right = choose_roads(table)
    assert shapely.hausdorff_distance(found.lines, right.lines).max() < 1e-6
    assert found.plane == right.plane


@pytest.mark.parametrize("crs", ["{'init': 'epsg:4326'}", "{'init': 'epsg:4326', 'no_defs': True}", "epsg:4326"])
def test_graphml_of_any_osmnx(tmp_path: Path, crs: str) -> None:
    """Of 2017: the CRS as a dictionary's text, numbers and truths as text, lists as text."""
    graph = nx.MultiDiGraph(crs=crs, name="Fenway", created_with="OSMnx 0.8.2")
    for n, line in enumerate(streets()[0]):
        for end, (x, y) in ((0, line.coords[0]), (1, line.coords[-1])):
            graph.add_node(f"{n}{end}", x=str(x), y=str(y), osmid=f"{n}{end}")
        kind = f"['{streets()[1][n]}', 'unclassified']"
        graph.add_edge(f"{n}0", f"{n}1", geometry=line.wkt, highway=kind, oneway="None", length="12.5", osmid="[1, 2]")
    nx.write_graphml(graph, tmp_path / "a.graphml")
    found = choose_roads(tmp_path / "a.graphml")
    assert len(found) == len(streets()[0])
    assert found.kinds[0] == f"{streets()[1][0]};unclassified"
