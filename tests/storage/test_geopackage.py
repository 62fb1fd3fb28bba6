import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from roadgeo.errors import CrsError, IndexFormatError, OutputError
from roadgeo.storage.geopackage import PIXELS, FeatureTable, GeometryType, layer_names, read_layer, write_layers

LINE = np.array([[300000.5, 4.7e6], [300010.0, 4.7e6 + 3], [300020.0, 4.7e6 - 1]])
RING = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])


@pytest.mark.parametrize(
    ("kind", "geometries", "expected"),
    [
        ("POINT", np.array([[1.0, 2.0], [3.0, 4.0]]), [[1.0, 2.0], [3.0, 4.0]]),
        ("POINT", np.empty((0, 2)), []),
        ("LINESTRING", [LINE, LINE[:2]], [LINE.tolist(), LINE[:2].tolist()]),
        ("LINESTRING", [], []),
        ("POLYGON", [RING], [[*RING.tolist(), RING[0].tolist()]]),
    ],
)
@pytest.mark.parametrize("crs", ["EPSG:32619", PIXELS, "+proj=laea +lat_0=42 +lon_0=-71"])
def test_what_is_written_is_read(
    tmp_path: Path, kind: GeometryType, geometries: list, expected: list, crs: str
) -> None:
    path = tmp_path / "a.gpkg"
    write_layers(path, [FeatureTable("things", kind, geometries, {"n": np.arange(len(geometries))}, crs)])
    found, columns = read_layer(path, "things")
    assert [geometry.tolist() for geometry in found] == expected
    assert columns == {"fid": list(range(1, len(expected) + 1)), "n": list(range(len(expected)))}


def test_columns_keep_their_types(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    columns = {
        "whole": [1, None],
        "real": np.array([1.5, np.nan]),
        "flag": np.array([True, False]),
        "text": ["Straße", None],
        "empty": [None, None],
    }
    write_layers(path, [FeatureTable("table", columns=columns)])
    _, found = read_layer(path, "table")
    assert found == {
        "fid": [1, 2],
        "whole": [1, None],
        "real": [1.5, None],
        "flag": [1, 0],
        "text": ["Straße", None],
        "empty": [None, None],
    }
    with closing(sqlite3.connect(path)) as database:
        types = [row[2] for row in database.execute("PRAGMA table_info('table')")]
    assert types == ["INTEGER", "INTEGER", "REAL", "BOOLEAN", "TEXT", "TEXT"]


def test_the_file_is_a_geopackage_1_3_that_gdal_reads(tmp_path: Path) -> None:
    import pyogrio

    path = tmp_path / "a.gpkg"
    lines = FeatureTable("roads", "LINESTRING", [LINE, LINE + 1000], {"a": ["x", "y"]}, "EPSG:32619", style="<qgis/>")
    write_layers(
        path,
        [lines, FeatureTable("ends", "POINT", LINE, {}, "EPSG:4326"), FeatureTable("meta", columns={"key": ["k"]})],
    )
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (10300,)
        assert database.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert database.execute("PRAGMA foreign_key_check").fetchall() == []
        assert database.execute("SELECT f_table_name, styleQML FROM layer_styles").fetchall() == [("roads", "<qgis/>")]
    assert layer_names(path) == ["roads", "ends", "meta", "layer_styles"]
    info = pyogrio.read_info(path, layer="roads")
    assert (info["crs"], info["geometry_type"], info["features"]) == ("EPSG:32619", "LineString", 2)
    near = pyogrio.read_dataframe(path, layer="roads", bbox=(300000, 4.7e6, 300001, 4.7e6 + 1))
    assert near["a"].tolist() == ["x"]


def test_the_spatial_index_survives_edits_by_gdal(tmp_path: Path) -> None:
    """The triggers stand where the standard wants them, so that a feature added in QGIS is found by its place."""
    import pyogrio

    path = tmp_path / "a.gpkg"
    write_layers(path, [FeatureTable("roads", "LINESTRING", [LINE], {}, "EPSG:32619")])
    added = pyogrio.read_dataframe(path, layer="roads").translate(5000, 0).to_frame("geometry")
    pyogrio.write_dataframe(added, path, layer="roads", append=True)
    assert len(pyogrio.read_dataframe(path, layer="roads", bbox=(304000, 4.6e6, 306000, 4.8e6))) == 1


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0 but no more", b"text"])
def test_a_damaged_file_is_one_clear_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.gpkg"
    path.write_bytes(content)
    with pytest.raises(IndexFormatError, match=r"a\.gpkg"):
        read_layer(path, "roads")


def test_misuse_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    with pytest.raises(CrsError, match="unknown CRS"):
        write_layers(path, [FeatureTable("a", "POINT", np.zeros((1, 2)), {}, "EPSG:banana")])
    assert list(tmp_path.iterdir()) == []  # nothing partial is left
    with pytest.raises(OutputError, match="cannot write"):
        write_layers(tmp_path / "missing" / "a.gpkg", [])
    with pytest.raises(IndexFormatError, match="no such file"):
        layer_names(path)
    write_layers(path, [FeatureTable("a", columns={"n": [1]})])
    with pytest.raises(IndexFormatError, match="no layer 'b'"):
        read_layer(path, "b")


def test_a_crs_that_resembles_one_of_epsgs_keeps_its_own_datum(tmp_path: Path) -> None:
    path, crs = tmp_path / "a.gpkg", "+proj=utm +zone=29 +ellps=intl +towgs84=-231,-196.1,482.2 +units=m"
    write_layers(path, [FeatureTable("a", "POINT", np.zeros((1, 2)), {}, crs)])
    with closing(sqlite3.connect(path)) as database:
        (number,) = database.execute("SELECT srs_id FROM gpkg_contents").fetchone()
    assert number >= 100_000
