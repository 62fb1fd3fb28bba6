"""Road files of strangers: what they name is neither read nor fetched, and what they compute is not computed."""

import bz2
import gzip
import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import geopandas as gpd
import pyogrio
import pytest
import shapely
from support.loopback import counting_server

from roadgeo.errors import RoadSourceError
from roadgeo.sources.overpass import read_area
from roadgeo.sources.streams import read_lines
from roadgeo.storage import vectors
from roadgeo.storage.gdal import CONSENT

LINE = {"type": "LineString", "coordinates": [[11.0, 48.0], [11.1, 48.1]]}
AREA = {"type": "Polygon", "coordinates": [[[11, 48], [12, 48], [12, 49], [11, 48]]]}
READERS = {"lines": lambda path: read_lines(path), "area": read_area}


@pytest.fixture
def server() -> Iterator[tuple[str, list[str]]]:
    with counting_server() as served:
        yield served


def geojson(**more: object) -> str:
    shapes = [{"type": "Feature", "properties": {}, "geometry": shape} for shape in (LINE, AREA)]
    return json.dumps({"type": "FeatureCollection", **more, "features": shapes})


def hostile(address: str, folder: Path) -> dict[str, str]:
    """Return files that have GDAL fetch or read something else, by what does it."""
    (folder / "other.geojson").write_text(geojson())

    def virtual(source: object) -> str:
        layer = f'<OGRVRTLayer name="other"><SrcDataSource>{source}</SrcDataSource></OGRVRTLayer>'
        return f"<OGRVRTDataSource>{layer}</OGRVRTDataSource>"

    pipeline = {"type": "gdal_streamed_alg", "command_line": f"gdal vector pipeline ! read /vsicurl/{address}/p.json"}
    return {
        "virtual, local": virtual(folder / "other.geojson"),
        "virtual": virtual(f"/vsicurl/{address}/v.geojson"),
        "wfs": f"<OGRWFSDataSource><URL>{address}/wfs</URL></OGRWFSDataSource>",
        "oapif": f"<OGROAPIFDataSource><URL>{address}/oapif</URL></OGROAPIFDataSource>",
        "csw": f"<OGRCSWDataSource><URL>{address}/csw</URL></OGRCSWDataSource>",
        "pipeline": json.dumps(pipeline),
        "link": geojson(crs={"type": "link", "properties": {"href": f"{address}/crs", "type": "proj4"}}),
        "url": geojson(crs={"type": "URL", "properties": {"url": f"{address}/crs"}}),
        "name": geojson(crs={"type": "name", "properties": {"name": f"{address}/crs"}}),
        "hidden link": geojson(crs={"type": "link", "properties": {"href": f"{address}/crs"}}).replace(
            "link", "l\\u0069nk"
        ),
    }


@pytest.mark.parametrize("read", READERS.values(), ids=list(READERS))
@pytest.mark.parametrize("no_proxy", ["", "127.0.0.1"])
def test_nothing_is_fetched_and_no_other_file_is_read(tmp_path, server, monkeypatch, read, no_proxy):
    monkeypatch.setenv("no_proxy", no_proxy)
    address, asked = server
    for what, text in hostile(address, tmp_path).items():
        path = tmp_path / "roads.geojson"
        path.write_text(text)
        if what in ("name", "link", "url", "hidden link"):  # read, or refused for want of a CRS
            with suppress(RoadSourceError):
                read(path)
        else:
            with pytest.raises(RoadSourceError, match=CONSENT):
                read(path)
        assert asked == [], what
    assert os.environ["no_proxy"] == no_proxy


def test_gml_does_not_fetch_its_schema(tmp_path, server):
    address, asked = server
    path = tmp_path / "roads.gml"
    gpd.GeoDataFrame(geometry=[shapely.LineString(LINE["coordinates"])], crs="EPSG:4326").to_file(path, driver="GML")
    path.with_suffix(".xsd").unlink()
    text = path.read_text()
    assert "schemaLocation" in text
    path.write_text(text.replace("roads.xsd", f"{address}/roads.xsd"))
    assert len(read_lines(path).lines) == 1
    assert asked == []


def test_drivers_are_back_afterwards(tmp_path, monkeypatch):
    before, real = pyogrio.list_drivers(), pyogrio.list_layers
    path, left = tmp_path / "roads.geojson", []
    path.write_text(geojson())
    monkeypatch.setattr(pyogrio, "list_layers", lambda file: left.extend(pyogrio.list_drivers()) or real(file))
    assert len(read_lines(path).lines) == 1
    assert {"GeoJSON"} <= {*left} <= vectors._DRIVERS
    assert pyogrio.list_drivers() == before
    assert pyogrio.get_gdal_config_option("GDAL_SKIP") is None
    assert pyogrio.get_gdal_config_option("GDAL_HTTP_PROXY") is None


def test_drivers_stay_left_out_until_the_last_who_needs_it_is_done():
    before = pyogrio.list_drivers()
    with vectors.few_drivers():
        with vectors.few_drivers():
            pass
        assert {*pyogrio.list_drivers()} <= vectors._DRIVERS
    assert pyogrio.list_drivers() == before


def test_a_file_says_once_what_it_holds(tmp_path, monkeypatch):
    """GDAL reads a whole GeoJSON file to say so."""
    asked, real = [], pyogrio.read_info
    path = tmp_path / "roads.geojson"
    path.write_text(geojson())
    monkeypatch.setattr(pyogrio, "read_info", lambda *args, **named: asked.append(args) or real(*args, **named))
    assert len(read_lines(path).lines) == 1
    assert len(asked) == 1


def test_drivers_of_other_builds_of_gdal_are_left_out_too(monkeypatch):
    others = {"OGCAPI", "PostGISRaster", "ECW", "GDALG", "WMS", "WCS", "TileDB", "Zarr", "DAAS", "EEDA", "HTTP"}
    monkeypatch.setattr(vectors, "_drivers", lambda skipped: {*others, "GPKG"})
    monkeypatch.setattr(pyogrio.core, "_register_drivers", lambda: None)  # such a build
    with vectors.few_drivers():
        assert {*pyogrio.get_gdal_config_option("GDAL_SKIP").split(",")} == {*others, ""}


def test_a_virtual_file_is_read_by_consent(tmp_path, monkeypatch):
    path = tmp_path / "roads.vrt"
    path.write_text(hostile("http://127.0.0.1:9", tmp_path)["virtual, local"])
    monkeypatch.setenv(CONSENT, "OGR_VRT")
    assert len(read_lines(path).lines) == 1


class TestDatabases:
    @pytest.fixture
    def path(self, tmp_path):
        path = tmp_path / "roads.gpkg"
        frame = gpd.GeoDataFrame(geometry=[shapely.LineString(LINE["coordinates"])], crs="EPSG:4326")
        frame.to_file(path, layer="roads")
        return path

    def forge(self, path, script):
        with closing(sqlite3.connect(path)) as database:
            for name in ("ST_IsEmpty", "ST_MinX", "ST_MinY", "ST_MaxX", "ST_MaxY"):
                database.create_function(name, 1, lambda blob: 0)
            database.executescript(script)
            database.commit()

    def test_a_view_that_never_ends(self, path):
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS fid, NULL AS geom FROM n"
        self.forge(path, f"DROP TABLE roads; CREATE VIEW roads AS {endless};")
        with pytest.raises(RoadSourceError, match="is a view, expected a table"):
            read_lines(path)

    def test_contents_that_never_end(self, path):
        script = "ALTER TABLE gpkg_contents RENAME TO c; CREATE VIEW gpkg_contents AS WITH RECURSIVE n(i) AS (SELECT 1"
        self.forge(path, f"{script} UNION ALL SELECT i + 1 FROM n) SELECT c.* FROM c, n;")
        with pytest.raises(RoadSourceError, match="is a view, expected a table"):
            read_lines(path)

    def test_a_column_that_is_larger_than_the_file(self, path):
        self.forge(path, "ALTER TABLE roads ADD COLUMN highway AS (zeroblob(900000000));")
        with pytest.raises(RoadSourceError, match="is computed"):
            read_lines(path)

    def test_a_database_of_no_database(self, path):
        path.write_bytes(path.read_bytes()[:5000])
        with pytest.raises(RoadSourceError, match="not readable"):
            read_lines(path)


class TestBombs:
    @pytest.mark.parametrize("suffix", [".gz", ".bz2"])
    def test_compressed(self, tmp_path, suffix, monkeypatch):
        monkeypatch.setattr("roadgeo.storage.unpacking._FREE", 1 << 20)
        path = tmp_path / f"roads.osm{suffix}"
        blank = b"<osm version='0.6'>" + b" " * (20 << 20) + b"</osm>"
        path.write_bytes(gzip.compress(blank) if suffix == ".gz" else bz2.compress(blank))
        with pytest.raises(RoadSourceError, match="unpacks to more than 100 times its size"):
            read_lines(path)


def test_what_is_no_regular_file(tmp_path):
    os.mkfifo(tmp_path / "roads.gpkg")
    for read in READERS.values():
        with pytest.raises(RoadSourceError, match="no regular file"):
            read(tmp_path / "roads.gpkg")
        with pytest.raises(RoadSourceError, match="no regular file"):
            read(Path("/dev/zero"))


def test_a_pipe_or_a_broken_map_is_told_of_by_the_name_that_was_given(tmp_path: Path) -> None:
    """A link in a passing folder is what GDAL opens."""
    (tmp_path / "roads.gml").write_text(
        '<?xml version="1.0"?><gml:FeatureCollection xmlns:gml="http://www.opengis.net/gml">'
    )
    with pytest.raises(RoadSourceError) as error:
        read_lines(tmp_path / "roads.gml")
    assert "/roadgeo-" not in str(error.value)
