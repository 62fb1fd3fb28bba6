"""Maps and masks that name other files: each way to write such a CRS, in each format, and other ways found since."""

import html
import json
import os
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import geopandas
import numpy as np
import pyproj
import rasterio
import shapely

__all__ = ["MAPS", "MASKS", "mrf", "naming", "virtual"]

LINES = [shapely.LineString([(5e5, 4.5e6), (501000, 4501000)]), shapely.LineString([(5e5, 4501000), (501000, 4500000)])]
GEOGCS = (
    'GEOGCS["x",DATUM["y",SPHEROID["GRS 1980",6378137,298.257222101]{}],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]'
)
BOUND = (
    'BOUNDCRS[SOURCECRS[GEOGCRS["x",DATUM["y",ELLIPSOID["GRS 1980",6378137,298.257222101]],CS[ellipsoidal,2],'
    'AXIS["lon",east],AXIS["lat",north],ANGLEUNIT["degree",0.0174532925199433]]],TARGETCRS[GEOGCRS["WGS 84",'
    'DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]],CS[ellipsoidal,2],AXIS["lat",north],'
    'AXIS["lon",east],ANGLEUNIT["degree",0.0174532925199433]]],ABRIDGEDTRANSFORMATION["t",METHOD["NTv2",'
    'ID["EPSG",9615]],PARAMETERFILE["Latitude and longitude difference file","{}",ID["EPSG",8656]]]]'
)
PROJCS = (
    f'PROJCS["x",{GEOGCS.format("")},PROJECTION["Transverse_Mercator"],PARAMETER["central_meridian",-9],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],UNIT["metre",1],'
    'EXTENSION["PROJ4","+proj=tmerc +lon_0=-9 +ellps=GRS80 +nadgrids={} +units=m +wktext"]]'
)


def naming(file: str) -> list[str]:
    """A CRS that names a file, in each way in which that can be said."""
    return [
        f"+proj=longlat +ellps=GRS80 +nadgrids={file} +no_defs +type=crs",
        f"proj=utm zone=29 ellps=GRS80 nadgrids = @null,@{file} type=crs",
        f"+proj=longlat +datum=WGS84 +geoidgrids={file} +vunits=m +type=crs",
        f"+init={file}:1",
        GEOGCS.format(f',EXTENSION["PROJ4_GRIDS","{file}"]'),
        GEOGCS.format(f',Extension [ "proj4_grids" , "{file}" ]'),
        PROJCS.replace("{}", file),
        BOUND.replace("{}", file),
        BOUND.replace("{}", file).replace("PARAMETERFILE[", "ParameterFile ( ").replace(',ID["EPSG",8656]]', ")"),
        json.dumps(pyproj.CRS(BOUND.replace("{}", file)).to_json_dict()),
    ]


def _write(path: Path, **how: str) -> Path:
    geopandas.GeoDataFrame(geometry=LINES, crs="EPSG:32629").to_file(path, **how)
    return path


def geojson(folder: Path, crs: str, key: str = '"crs"', before: str = "") -> Path:
    line = {"type": "LineString", "coordinates": [[5e5, 4.5e6], [501000, 4501000]]}
    feature = {"type": "Feature", "properties": {}, "geometry": line}
    reported = json.dumps({"crs": {"type": "name", "properties": {"name": crs}}, "features": [feature]})
    path = folder / "roads.geojson"
    path.write_text(before + '{"type": "FeatureCollection", ' + reported[1:].replace('"crs"', key))
    return path


def escaped(folder: Path, crs: str) -> Path:
    path = geojson(folder, crs, r'"c\u0072s"')
    path.write_text(path.read_text().replace("grids", r"gri\u0064s").replace("/", r"\/"))
    return path


def padded(folder: Path, crs: str) -> Path:
    path = geojson(folder, crs)
    path.write_text(path.read_text().replace('"crs":', f'"crs"{" " * 5000}:'))
    return path


def behind_a_tab(folder: Path, crs: str) -> Path:
    return geojson(folder, crs, before="\v")


def behind_a_nul(folder: Path, crs: str) -> Path:
    return geojson(folder, crs, '"crs\\u0000x"')


def esrijson(folder: Path, crs: str) -> Path:
    document = {"displayFieldName": "", "geometryType": "esriGeometryPolyline", "spatialReference": {"wkt": crs}}
    rows = [{"attributes": {"id": 1}, "geometry": {"paths": [[[5e5, 4.5e6], [501000, 4501000]]]}}]
    (folder / "roads.json").write_text(
        json.dumps({**document, "features": rows}).replace('"spatialReference":', f'"spatialReference"{" " * 5000}:')
    )
    return folder / "roads.json"


def topojson(folder: Path, crs: str) -> Path:
    roads = {"type": "LineString", "arcs": [0], "properties": {}}
    document = {"type": "Topology", "crs": {"type": "name", "properties": {"name": crs}}, "objects": {"roads": roads}}
    document["arcs"] = [[[5e5, 4.5e6], [501000, 4501000]]]
    (folder / "roads.topojson").write_text(json.dumps(document).replace('"crs":', f'"crs"{" " * 5000}:'))
    return folder / "roads.topojson"


def shapefile(folder: Path, crs: str) -> Path:
    path = _write(folder / "roads.shp")
    (folder / "roads.prj").write_text(crs)
    return path


def mapinfo_that_is_json(folder: Path, crs: str) -> Path:
    path = geojson(folder, crs)
    return path.rename(folder / "roads.tab")


def geopackage(folder: Path, crs: str) -> Path:
    _write(folder / "roads.gpkg")
    with sqlite3.connect(folder / "roads.gpkg") as database:
        values = (crs, "NONE", 32629)
        database.execute("UPDATE gpkg_spatial_ref_sys SET definition = ?, organization = ? WHERE srs_id = ?", values)
    database.close()
    return folder / "roads.gpkg"


def gml(folder: Path, crs: str) -> Path:
    srs = html.escape(crs).replace("/", "&#47;")
    return _gml(folder, f'<gml:LineString srsName="{srs}">', "")


def gml_by_default(folder: Path, crs: str) -> Path:
    """Give the CRS as the default of an attribute."""
    given = html.escape(crs).replace("/", "&#47;")
    return _gml(folder, "<gml:LineString>", f'<!DOCTYPE a [<!ATTLIST gml:LineString srsName CDATA "{given}">]>')


def _gml(folder: Path, line: str, document_type: str) -> Path:
    (folder / "roads.gml").write_text(
        f'<?xml version="1.0"?>{document_type}<ogr:FeatureCollection xmlns:ogr="http://ogr.maptools.org/" '
        'xmlns:gml="http://www.opengis.net/gml"><gml:featureMember><ogr:r fid="a"><ogr:geometryProperty>'
        f"{line}<gml:coordinates>-8.61,41.14 -8.60,41.15</gml:coordinates></gml:LineString>"
        "</ogr:geometryProperty></ogr:r></gml:featureMember></ogr:FeatureCollection>"
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
    import pyarrow.parquet as pq

    geopandas.GeoDataFrame(geometry=LINES, crs="EPSG:32629").to_parquet(folder / "roads.parquet")
    table = pq.read_table(folder / "roads.parquet")
    meta = json.loads(table.schema.metadata[b"geo"])
    meta["columns"]["geometry"]["crs"] = json.loads(crs) if crs.startswith("{") else crs
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(meta).encode()}), folder / "roads.parquet")
    return folder / "roads.parquet"


MAPS: list[Callable[[Path, str], Path]] = [
    *(geojson, escaped, padded, behind_a_tab, behind_a_nul, esrijson, topojson, shapefile, mapinfo_that_is_json),
    *(geopackage, gml, gml_by_default, graphml, parquet),
]


def tiff(folder: Path, file: str) -> Path:
    """Write a TIFF of two pages, whose second has a CRS that names a file."""
    crs = GEOGCS.format(f',EXTENSION["PROJ4_GRIDS","{file}"]')
    text = f"x|ESRI PE String = {crs}|".encode()
    keys = struct.pack("<8H", 1, 1, 0, 1, 3073, 34737, len(text), 0)

    def page(at: int, following: int, crs: bool) -> bytes:
        tags = [(256, 3, 1, 64), (257, 3, 1, 64), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1)]
        tags += [(273, 4, 1, 4096), (277, 3, 1, 1), (278, 3, 1, 64), (279, 4, 1, 4096)]
        end = at + 2 + 12 * (len(tags) + 2 * crs) + 4
        tags += [(34735, 3, 8, end), (34737, 2, len(text), end + len(keys))] * crs
        rows = b"".join(struct.pack("<HHII", *tag) for tag in tags)
        return struct.pack("<H", len(tags)) + rows + struct.pack("<I", following) + (keys + text) * crs

    head = struct.pack("<2sHI", b"II", 42, 8)
    whole = head + page(8, 1024, False)
    whole = whole.ljust(1024, b"\0") + page(1024, 0, True)
    (folder / "mask.tif").write_bytes(whole.ljust(4096, b"\0") + bytes(range(256)) * 16)
    return folder / "mask.tif"


def imagine(folder: Path, file: str) -> Path:
    """Write an Erdas Imagine raster that keeps its pixels in that file, by a name in letters of another case."""
    named = os.path.relpath(file, folder)
    inner = folder / "made"
    inner.mkdir()
    made = inner / f"{'x' * (len(named) - 4)}.img"  # the file of its pixels has a name of the same length
    place = rasterio.Affine(1, 0, 5e5, 0, -1, 4.5e6)
    how = {"dtype": "uint8", "USE_SPILL": "YES", "crs": "EPSG:32629", "transform": place}
    with rasterio.open(made, "w", "HFA", 64, 64, 1, **how) as raster:
        raster.write(np.ones((64, 64), np.uint8), 1)
    content = made.read_bytes().replace(made.with_suffix(".ige").name.encode(), named.encode())
    (folder / "mask.img").write_bytes(content.replace(b"ExternalRasterDMS\0", b"externalrasterdms\0"))
    return folder / "mask.img"


def virtual(folder: Path, file: str) -> Path:
    (folder / "mask.vrt").write_text(
        '<VRTDataset rasterXSize="64" rasterYSize="64"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="0">{file}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>'
    )
    return folder / "mask.vrt"


def mrf(folder: Path, victim: Path) -> Path:
    """Write an MRF whose cache is another file: whoever reads it writes there."""
    place = rasterio.Affine(1, 0, 5e5, 0, -1, 4.5e6)
    with rasterio.open(folder / "source.tif", "w", "GTiff", 64, 64, 1, dtype="uint8", transform=place) as raster:
        raster.write(np.full((64, 64), ord("X"), np.uint8), 1)
    (folder / "inner.mrf").write_text(
        f"<MRF_META><CachedSource><Source>{folder}/source.tif</Source></CachedSource><Raster>"
        '<Size x="64" y="64" c="1"/><PageSize x="64" y="64" c="1"/><Compression>NONE</Compression>'
        f"<DataType>Byte</DataType><DataFile>{victim}</DataFile><IndexFile>{victim}.idx</IndexFile></Raster></MRF_META>"
    )
    return folder / "inner.mrf"


MASKS: list[Callable[[Path, str], Path]] = [tiff, imagine, virtual]
