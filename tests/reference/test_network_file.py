import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pyogrio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds.networks import grid_network, same_values

from roadgeo.errors import CrsError, IndexFormatError
from roadgeo.geometry.projection import LocalPlane
from roadgeo.reference.inspection import check_reference, describe_reference
from roadgeo.reference.network_file import (
    computed_digest,
    network_digest,
    read_meta,
    read_network,
    stored_digest,
    write_network,
)
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.network import RoadNetwork, as_stored
from roadgeo.storage.geopackage import layer_names


@pytest.fixture
def network() -> RoadNetwork:
    return as_stored(grid_network())


@pytest.fixture
def path(tmp_path: Path, network: RoadNetwork) -> Path:
    write_network(tmp_path / "grid.gpkg", network)
    return tmp_path / "grid.gpkg"


@contextmanager
def editing(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a GeoPackage as a GIS does: with the functions that the spatial index's triggers call."""
    with closing(sqlite3.connect(path)) as database:
        database.create_function("ST_IsEmpty", 1, lambda blob: 0)
        for name in ("ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY"):
            database.create_function(name, 1, lambda blob: 0.0)
        yield database
        database.commit()


# --- round trip -------------------------------------------------------------------------------------------------------


def test_round_trip_is_exact(path: Path, network: RoadNetwork) -> None:
    found = read_network(path)
    assert same_values(found.graph, network.graph)
    assert same_values(found.intersections, network.intersections)
    assert found.plane == network.plane
    assert found.meta == network.meta
    np.testing.assert_array_equal(found.coverage, network.coverage)


@given(
    xy=st.lists(st.floats(-2e6, 2e6), min_size=2, max_size=2),
    origin=st.tuples(st.integers(-(10**7), 10**7), st.integers(-(10**7), 10**7)),
)
def test_stored_positions_are_fixed_points(xy: list[float], origin: tuple[int, int]) -> None:
    plane = LocalPlane("EPSG:32619", (float(origin[0]), float(origin[1])))
    graph = RoadGraph.from_polylines(np.array([xy]), np.array([[0, 0]]), [np.array([xy, xy])])
    once = as_stored(replace(grid_network(), graph=graph, plane=plane))
    assert same_values(as_stored(once).graph, once.graph)
    np.testing.assert_allclose(once.graph.xy, [xy], rtol=0, atol=4e-9)
    np.testing.assert_array_equal(plane.from_crs(plane.to_crs(once.graph.xy)), once.graph.xy)


def test_a_crs_without_a_code(tmp_path: Path, network: RoadNetwork) -> None:
    import pyproj

    wkt = pyproj.CRS("+proj=laea +lat_0=-16 +lon_0=179.9 +datum=WGS84").to_wkt("WKT2_2019")
    network = as_stored(replace(network, plane=LocalPlane(wkt, (0.0, 0.0))))
    write_network(tmp_path / "fiji.gpkg", network)
    assert read_network(tmp_path / "fiji.gpkg").plane == network.plane
    info = pyogrio.read_info(tmp_path / "fiji.gpkg", layer="roads")
    assert pyproj.CRS(info["crs"]).coordinate_operation.method_name == "Lambert Azimuthal Equal Area"


def test_a_network_without_roads(tmp_path: Path, network: RoadNetwork) -> None:
    nothing = RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2), np.int32), [])
    none = network.intersections
    none = type(none)(*(getattr(none, field)[:0] for field in none.__dataclass_fields__))
    empty = replace(network, graph=nothing, intersections=none, coverage=())
    write_network(tmp_path / "empty.gpkg", empty)
    found = read_network(tmp_path / "empty.gpkg")
    assert same_values(found.graph, nothing)
    assert same_values(found.intersections, none)
    assert found.coverage == ()


# --- as other programs see it -----------------------------------------------------------------------------------------


def test_gdal_reads_every_layer(path: Path, network: RoadNetwork) -> None:
    expected = {
        "coverage": ("Polygon", 1),
        "roads": ("LineString", network.graph.n_edges),
        "tangents": ("LineString", int(network.intersections.n_tangents.sum())),
        "intersections": ("Point", len(network.intersections)),
        "roadgeo_meta": (None, 9),
    }
    assert layer_names(path) == [*expected, "layer_styles"]
    for layer, (kind, n) in expected.items():
        info = pyogrio.read_info(path, layer=layer)
        assert (info["geometry_type"], info["features"]) == (kind, n)
        assert info["crs"] == ("EPSG:32619" if kind else None)


def test_every_map_layer_is_styled_with_names_for_people(path: Path) -> None:
    with closing(sqlite3.connect(path)) as database:
        styles = dict(database.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"))
        columns = {layer: [row[1] for row in database.execute(f"PRAGMA table_info({layer})")][2:] for layer in styles}
    assert list(styles) == ["coverage", "roads", "tangents", "intersections"]
    for layer, qml in styles.items():
        aliases = ET.fromstring(qml).findall("aliases/alias")
        assert [alias.get("field") for alias in aliases] == columns[layer]


def test_provenance_stands_in_the_metadata(path: Path) -> None:
    with closing(sqlite3.connect(path)) as database:
        texts = database.execute(
            "SELECT metadata FROM gpkg_metadata JOIN gpkg_metadata_reference ON md_file_id = id ORDER BY id"
        ).fetchall()
    assert texts[0] == ("© tests",)
    assert '"sources": [{"path": "grid.gpkg"}]' in texts[1][0]


# --- digests ----------------------------------------------------------------------------------------------------------


def test_digest_is_that_of_the_content(path: Path, network: RoadNetwork) -> None:
    digest = network_digest(network)
    assert stored_digest(path) == computed_digest(path) == digest
    other = replace(network, intersections=replace(network.intersections, xy=network.intersections.xy + 1e-3))
    assert network_digest(other) != digest
    assert network_digest(as_stored(grid_network(seed=1))) != digest


def test_styles_and_other_layers_do_not_change_the_digest(path: Path, network: RoadNetwork) -> None:
    before = path.read_bytes()
    with editing(path) as database:
        database.execute("UPDATE layer_styles SET styleQML = '<qgis/>'")
        database.execute("CREATE TABLE qgis_projects (name TEXT PRIMARY KEY)")
        database.execute("UPDATE roads SET length_m = 0")
        database.execute("VACUUM" if database.in_transaction is False else "SELECT 1")
    assert path.read_bytes() != before
    assert stored_digest(path) == network_digest(network)


@pytest.mark.parametrize(
    "edit",
    [
        "DELETE FROM intersections WHERE fid = 3",
        "UPDATE intersections SET ray1_deg = 12.5 WHERE fid = 3",
        "UPDATE intersections SET geom = (SELECT geom FROM intersections WHERE fid = 4) WHERE fid = 3",
        """INSERT INTO intersections (geom, residual_m, ray1_deg, tangent1_deg)
        SELECT geom, residual_m, ray1_deg, tangent1_deg FROM intersections WHERE fid = 1""",
    ],
)
def test_edits_change_the_digest(path: Path, network: RoadNetwork, edit: str) -> None:
    with editing(path) as database:
        database.execute(edit)
    assert read_meta(path)["roadgeo.digest"] is None
    assert stored_digest(path) == computed_digest(path) == network_digest(read_network(path))
    assert stored_digest(path) != network_digest(network)


def test_an_edit_undone_is_no_edit(path: Path, network: RoadNetwork) -> None:
    with editing(path) as database:
        database.execute("UPDATE intersections SET residual_m = residual_m + 1")
        database.execute("UPDATE intersections SET residual_m = residual_m - 1")
        database.execute("UPDATE intersections SET branches = 99")
    np.testing.assert_allclose(read_network(path).intersections.residual, network.intersections.residual, atol=1e-6)
    with editing(path) as database:
        database.executemany(
            "UPDATE intersections SET residual_m = ? WHERE fid = ?",
            [(float(r), i) for i, r in enumerate(network.intersections.residual, 1)],
        )
    assert stored_digest(path) == network_digest(network)


def test_a_layer_made_anew_by_another_program_is_looked_through(path: Path, network: RoadNetwork) -> None:
    meta, _, geometry, columns = pyogrio.raw.read(path, layer="intersections")
    fields = {"geometry_type": "Point", "crs": meta["crs"], "fields": meta["fields"]}
    pyogrio.raw.write(path, geometry, columns, layer="intersections", driver="GPKG", **fields)
    assert isinstance(read_meta(path)["roadgeo.digest"], str)  # left behind, its triggers gone
    assert stored_digest(path) == network_digest(network)
    pyogrio.raw.write(path, geometry[1:], [c[1:] for c in columns], layer="intersections", driver="GPKG", **fields)
    assert stored_digest(path) == computed_digest(path) != network_digest(network)


def test_an_edit_that_qgis_has_not_checkpointed_is_seen(path: Path, network: RoadNetwork) -> None:
    with editing(path) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("DELETE FROM intersections WHERE fid = 1")
        database.commit()
        assert path.with_name(f"{path.name}-wal").stat().st_size
        assert stored_digest(path) != network_digest(network)
        assert len(read_network(path).intersections) == len(network.intersections) - 1


# --- files that are no reference --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ("DROP TABLE roads", "roads"),
        ("DROP TABLE intersections", "intersections"),
        ("DROP TABLE roadgeo_meta", "is no reference"),
        ("UPDATE roads SET to_node = 1000 WHERE fid = 2", "nodes that do not exist"),
        ("UPDATE roads SET from_node = NULL WHERE fid = 2", "nodes that do not exist"),
        ("UPDATE roads SET from_node = 'x' WHERE fid = 2", "no numbers"),
        ("UPDATE intersections SET ray1_deg = 'x' WHERE fid = 2", "no numbers"),
        ("UPDATE intersections SET ray1_deg = 'x' WHERE fid = 2", "make the file again"),
        ("UPDATE intersections SET geom = NULL WHERE fid = 2", "no point"),
        ("UPDATE roads SET geom = x'00' WHERE fid = 2", "no point"),
        ("UPDATE roadgeo_meta SET value = '{' WHERE key = 'name'", "no JSON"),
        ("UPDATE roadgeo_meta SET value = NULL WHERE key = 'name'", "no JSON"),
        ("UPDATE roadgeo_meta SET value = '\"roadgeo.reference/9\"' WHERE key = 'roadgeo.schema'", "reference/9"),
        ("UPDATE roadgeo_meta SET value = '[1e400, 0.0]' WHERE key = 'roadgeo.origin'", "origin"),
        ("UPDATE roadgeo_meta SET value = '[1.0]' WHERE key = 'roadgeo.origin'", "origin"),
        ("UPDATE roadgeo_meta SET value = '3' WHERE key = 'roadgeo.crs'", "CRS"),
        ("UPDATE roadgeo_meta SET value = '99999999999' WHERE key = 'roadgeo.nodes'", "nodes that do not exist"),
        ("INSERT INTO intersections (geom) SELECT geom FROM intersections WHERE fid = 1", "no ray or no tangent"),
    ],
)
def test_contradictions_are_named(path: Path, edit: str, message: str) -> None:
    with editing(path) as database:
        database.execute(edit)
    with pytest.raises(IndexFormatError, match=message):
        read_network(path)


def test_other_files_are_refused(tmp_path: Path, path: Path) -> None:
    pyogrio.raw.write(
        tmp_path / "other.gpkg", np.array([], object), [], fields=[], layer="a", driver="GPKG", geometry_type="Point",
        crs="EPSG:4326",
    )  # fmt: skip
    (tmp_path / "text.gpkg").write_text("no database")
    path.write_bytes(path.read_bytes()[:20000])
    for name in ("other.gpkg", "text.gpkg", "grid.gpkg", "none.gpkg"):
        with pytest.raises(IndexFormatError, match=name):
            read_network(tmp_path / name)


# --- writing that fails -----------------------------------------------------------------------------------------------


def test_an_unknown_crs_is_refused(tmp_path: Path, network: RoadNetwork) -> None:
    with pytest.raises(CrsError):
        write_network(tmp_path / "grid.gpkg", replace(network, plane=LocalPlane("EPSG:0", (0.0, 0.0))))


class TestHostileTables:
    """What a GeoPackage of a stranger gives must lie in it: no rows without end, no computed values."""

    ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS key, i AS value FROM n"

    def forge(self, path, script):
        with closing(sqlite3.connect(path)) as database:
            database.executescript(f"PRAGMA writable_schema = ON; {script}")
            database.commit()

    @pytest.mark.parametrize("name", ["roadgeo_meta", "intersections", "roads", "coverage", "gpkg_geometry_columns"])
    def test_a_view_in_place_of_a_table(self, path, name):
        self.forge(path, f'DROP TABLE IF EXISTS "{name}"; CREATE VIEW "{name}" AS {self.ENDLESS};')
        with pytest.raises(IndexFormatError, match="is a view, expected a table"):
            read_network(path)

    @pytest.mark.parametrize("name", ["roadgeo_meta", "intersections", "roads", "coverage"])
    def test_columns_that_are_larger_than_the_file(self, path, name):
        self.forge(path, f'ALTER TABLE "{name}" ADD COLUMN more AS (zeroblob(900000000));')
        with pytest.raises(IndexFormatError, match="is computed"):
            read_network(path)

    def test_a_default_that_every_row_repeats(self, path):
        self.forge(path, f"ALTER TABLE roads ADD COLUMN more TEXT DEFAULT '{'x' * 500_000}';")
        with pytest.raises(IndexFormatError, match="is computed"):
            read_network(path)

    def test_a_tree_that_never_ends(self, path, monkeypatch):
        """Pages of a table that all lead to the same page: a few kilobytes hold 400 to the fourth power rows."""
        monkeypatch.setattr("roadgeo.storage.sqlite._STEPS", 1_000_000)
        deep_tree(path, "roads")
        for read in (read_network, check_reference, describe_reference):
            if read is check_reference:
                assert read(path)
            else:
                with pytest.raises(IndexFormatError, match=r"cannot be used|no readable"):
                    read(path)

    def test_a_layer_without_its_geometry(self, path):
        self.forge(path, "UPDATE gpkg_geometry_columns SET column_name = 'other' WHERE table_name = 'roads';")
        with pytest.raises(IndexFormatError, match="lacks its column"):
            read_network(path)

    @pytest.mark.parametrize("layer", ["roads", "intersections", "coverage"])
    def test_a_layer_that_is_no_layer_of_geometries(self, path, layer):
        self.forge(path, f"DELETE FROM gpkg_geometry_columns WHERE table_name = '{layer}';")
        with pytest.raises(IndexFormatError, match=f"its layer '{layer}' holds a geometry that is no"):
            read_network(path)

    @pytest.mark.parametrize(("layer", "of"), [("roads", "intersections"), ("intersections", "roads")])
    def test_a_geometry_of_another_kind(self, path, layer, of):
        with closing(sqlite3.connect(path)) as database:
            for (trigger,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f'DROP TRIGGER "{trigger}"')
            (one,) = database.execute(f"SELECT geom FROM {of} LIMIT 1").fetchone()
            database.execute(f"UPDATE {layer} SET geom = ? WHERE rowid = 2", (one,))
            database.commit()
        with pytest.raises(IndexFormatError, match=f"its layer '{layer}' holds a geometry that is no"):
            read_network(path)


def deep_tree(path, table, depth=4):
    """Put a tree of interior pages above a table's root whose branches are all the same page below."""
    with closing(sqlite3.connect(path)) as database:
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
        (size,) = database.execute("PRAGMA page_size").fetchone()
    raw = bytearray(path.read_bytes())
    page = raw[(root - 1) * size : root * size]
    below = len(raw) // size + 1
    raw += page  # what was the root now lies at the end, below everything else
    for level in range(depth):
        cells = (size - 12) // 7
        new = bytearray(size)
        new[:12] = struct.pack(">BHHHBI", 5, 0, cells, size - 5 * cells, 0, below)
        for i in range(cells):
            at = size - 5 * (i + 1)
            new[12 + 2 * i : 14 + 2 * i] = at.to_bytes(2, "big")
            new[at : at + 5] = struct.pack(">IB", below, 127)
        if level < depth - 1:
            raw += new
            below += 1
        else:
            raw[(root - 1) * size : root * size] = new
    raw[28:32] = (len(raw) // size).to_bytes(4, "big")
    path.write_bytes(raw)
