"""Maps whose CRS names files are refused before GDAL looks at those; a pipe there would hold it for ever."""

import html
import json
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

import geopandas
import pytest
import shapely
from storage.test_crs import naming

from roadgeo.errors import RoadgeoError
from roadgeo.sources.roads import read_roads

CORPUS = Path(__file__).parents[1] / "corpus"
LINES = [shapely.LineString([(5e5, 4.5e6), (501000, 4501000)]), shapely.LineString([(5e5, 4501000), (501000, 4500000)])]


def write(path: Path) -> None:
    geopandas.GeoDataFrame(geometry=LINES, crs="EPSG:32629").to_file(path)


def geojson(folder: Path, crs: str, key: str = '"crs"') -> Path:
    line = {"type": "LineString", "coordinates": [[5e5, 4.5e6], [501000, 4501000]]}
    feature = {"type": "Feature", "properties": {}, "geometry": line}
    reported = json.dumps({"crs": {"type": "name", "properties": {"name": crs}}, "features": [feature]})
    path = folder / "roads.geojson"
    path.write_text('{"type": "FeatureCollection", ' + reported[1:].replace('"crs"', key))
    return path


def escaped(folder: Path, crs: str) -> Path:
    path = geojson(folder, crs, r'"c\u0072s"')
    path.write_text(path.read_text().replace("grids", r"gri\u0064s").replace("/", r"\/"))
    return path


def padded(folder: Path, crs: str) -> Path:
    path = geojson(folder, crs)
    path.write_text(path.read_text().replace('"type": "name"', f'"type": "name", "by": "{"x" * 100_000}"'))
    return path


def shapefile(folder: Path, crs: str) -> Path:
    write(folder / "roads.shp")
    (folder / "roads.prj").write_text(crs)
    return folder / "roads.shp"


def geopackage(folder: Path, crs: str) -> Path:
    write(folder / "roads.gpkg")
    with sqlite3.connect(folder / "roads.gpkg") as database:
        values = (crs, "NONE", 32629)
        database.execute("UPDATE gpkg_spatial_ref_sys SET definition = ?, organization = ? WHERE srs_id = ?", values)
    database.close()
    return folder / "roads.gpkg"


def flatgeobuf(folder: Path, crs: str) -> Path:
    geopandas.GeoDataFrame(geometry=LINES, crs="+proj=tmerc +lon_0=-9.5 +ellps=GRS80").to_file(folder / "roads.fgb")
    content = (folder / "roads.fgb").read_bytes()
    at = content.index(b'PROJCRS["unknown"')
    reported = crs.encode()[-800:]  # as long as what stands there
    (folder / "roads.fgb").write_bytes(content[:at] + reported + content[at + len(reported) :])
    return folder / "roads.fgb"


def gml(folder: Path, crs: str) -> Path:
    (folder / "roads.gml").write_text(
        '<?xml version="1.0"?><ogr:FeatureCollection xmlns:ogr="http://ogr.maptools.org/" '
        'xmlns:gml="http://www.opengis.net/gml"><gml:featureMember><ogr:r fid="a"><ogr:geometryProperty>'
        f'<gml:LineString srsName="{html.escape(crs).replace("/", "&#47;")}"><gml:coordinates>-8.61,41.14 -8.60,41.15'
        "</gml:coordinates></gml:LineString></ogr:geometryProperty></ogr:r></gml:featureMember></ogr:FeatureCollection>"
    )
    return folder / "roads.gml"


def graphml(folder: Path, crs: str) -> Path:
    (folder / "roads.graphml").write_text(
        '<?xml version="1.0"?><graphml xmlns="http://graphml.graphdrawing.org/xmlns">'
        '<key id="d0" for="graph" attr.name="crs" attr.type="string"/><graph edgedefault="directed">'
        f'<data key="d0">{html.escape(crs)}</data></graph></graphml>'
    )
    return folder / "roads.graphml"


def parquet(folder: Path, crs: str) -> Path:
    pq = pytest.importorskip("pyarrow.parquet")
    geopandas.GeoDataFrame(geometry=LINES, crs="EPSG:32629").to_parquet(folder / "roads.parquet")
    table = pq.read_table(folder / "roads.parquet")
    meta = json.loads(table.schema.metadata[b"geo"])
    meta["columns"]["geometry"]["crs"] = json.loads(crs) if crs.startswith("{") else crs
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(meta).encode()}), folder / "roads.parquet")
    return folder / "roads.parquet"


@pytest.mark.parametrize("made", [geojson, escaped, padded, shapefile, geopackage, flatgeobuf, gml, graphml, parquet])
@pytest.mark.parametrize("way", [0, 3, 4, 6, 7, 9])
def test_a_crs_opens_no_file(made: Callable[[Path, str], Path], way: int, tmp_path: Path) -> None:
    path = made(tmp_path, naming("/nowhere/fifo")[way])
    with pytest.raises(RoadgeoError, match="names the file"):
        read_roads(path, which="all")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("geojson/crs_key_escaped.geojson", "names the file '/nowhere/roadgeo/fifo'"),
        ("geojson/crs_key_of_other_case.geojson", "names the file '/nowhere/roadgeo/fifo'"),
        ("geojson/crs_trailing_comma.geojson", "what it says of its CRS is no valid JSON; save it again"),
        ("geojson/crs_raw_tab.geojson", "what it says of its CRS is no valid JSON; save it again"),
        ("geojson/crs_key_twice.geojson", "what it says of its CRS is no valid JSON; save it again"),
        ("zip/crs_names_a_file.zip", "names the file '/nowhere/roadgeo/fifo'"),
        ("tab/view_of_other_tables.tab", "is a view of other tables, which are not opened"),
    ],
)
def test_what_only_lenient_readers_understand_is_refused(name: str, message: str) -> None:
    with pytest.raises(RoadgeoError, match=message):
        read_roads(CORPUS / name, which="all")


def test_archives_are_recognised_by_their_content_and_unpacked_by_us(tmp_path: Path) -> None:
    """GDAL opens archives by itself, and what is packed cannot be looked at."""
    content = (CORPUS / "zip" / "crs_names_a_file.zip").read_bytes()
    for ending, message in ((".shz", "names the file"), (".kml", "is packed, whatever its name says")):
        (tmp_path / f"roads{ending}").write_bytes(content)
        with pytest.raises(RoadgeoError, match=message):
            read_roads(tmp_path / f"roads{ending}", which="all")


def test_a_crs_is_found_however_far_from_the_beginning(tmp_path: Path) -> None:
    path = shapefile(tmp_path, " " * 100_000 + naming("/nowhere/fifo")[6])
    with pytest.raises(RoadgeoError, match="names the file"):
        read_roads(path, which="all")
    (tmp_path / "roads.prj").rename(tmp_path / "ROADS.Prj")  # found by name on disks that ignore case
    with pytest.raises(RoadgeoError, match="names the file"):
        read_roads(path, which="all")
    geopandas.GeoDataFrame(geometry=LINES, crs="EPSG:32629").to_file(tmp_path / "roads.gdb", driver="OpenFileGDB")
    with (tmp_path / "roads.gdb" / "a00000004.gdbtable").open("ab") as table:
        table.write(bytes(100_000) + naming("/nowhere/fifo")[6].encode("utf-16-le"))
    with pytest.raises(RoadgeoError, match="names the file"):
        read_roads(tmp_path / "roads.gdb", which="all")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
@pytest.mark.parametrize("ending", ["prj", "cpg", "qix", "shp.xml"])
def test_a_pipe_beside_a_map_is_refused(ending: str, tmp_path: Path) -> None:
    """GDAL would wait for somebody to write to it."""
    write(tmp_path / "roads.shp")
    (tmp_path / f"roads.{ending}").unlink(missing_ok=True)
    os.mkfifo(tmp_path / f"roads.{ending}")
    with pytest.raises(RoadgeoError, match=f"roads.{ending} beside it is no regular file"):
        read_roads(tmp_path / "roads.shp", which="all")


def test_attributes_called_crs_are_no_crs(tmp_path: Path) -> None:
    path = geojson(tmp_path, "EPSG:32629")
    path.write_text(path.read_text().replace('"properties": {}', '"properties": {"crs": "a/b", "c\\u0072s": 3}'))
    assert len(read_roads(path, which="all").lines) == 1
