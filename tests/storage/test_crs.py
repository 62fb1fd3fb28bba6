"""A CRS of a stranger opens no file: neither its grids nor what defines it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio

from roadgeo.errors import CrsError
from roadgeo.geometry.projection import to_lonlat
from roadgeo.storage.crs import file_in_bytes, known_crs, name_crs

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


@pytest.mark.parametrize(
    "crs",
    [
        GEOGCS.format(",EXTENSION[PROJ4_GRIDS,/tmp/fifo]"),
        GEOGCS.format(",EXTENSION[\u201cPROJ4_GRIDS\u201d,\u201c/tmp/fifo\u201d]"),
        GEOGCS.format(',EXTENSION["PROJ4_GRIDS"["a"],"/tmp/fifo"]'),
        GEOGCS.format(',EXTENSION["PROJ4","+proj=longlat +nadgrids=""a b,/tmp/fifo"" "]'),
        '{"init": "/tmp/fifo:1"}',
        '{"proj": "longlat", "ellps": "GRS80", "nadgrids": "/tmp/fifo"}',
        json.dumps(pyproj.CRS(BOUND.format("a.gsb")).to_json_dict()).replace(
            '"value": "a.gsb"', '"valu\\u0065": "\\u002ftmp/fifo", "n": ' + "1" * 5000
        ),
        "+init+=+/tmp/fifo:1",
    ],
)
def test_other_ways_to_write_it_are_known(crs: str) -> None:
    with pytest.raises(CrsError, match="names the file"):
        known_crs(crs)
    if not crs.startswith("{"):
        assert file_in_bytes(bytes(1_000_000) + crs.encode() + bytes(100))


@pytest.mark.parametrize("file", ["/dev/stdin", "../fifo", "sub/fifo", r"C:\grid.gsb", "https://host/grid.tif"])
@pytest.mark.parametrize("way", range(10))
def test_no_file_is_opened(way: int, file: str) -> None:
    crs = naming(file)[way]
    for use in (known_crs, lambda crs: to_lonlat(crs, np.array([[5e5, 4.5e6]]))):
        with pytest.raises((CrsError, pyproj.exceptions.CRSError)) as error:
            use(crs)
        if way != 8:  # which PROJ does not take for WKT
            assert "names the file" in str(error.value)


@pytest.mark.parametrize(
    "crs",
    [
        "EPSG:26986",
        "OGC:CRS84",
        "urn:ogc:def:crs:EPSG::32629",
        "+proj=longlat +ellps=bessel +nadgrids=BETA2007.gsb +type=crs",
        "+proj=longlat +ellps=clrk66 +nadgrids=@conus,@alaska,null +type=crs",
        "+proj=merc +a=6378137 +b=6378137 +units=m +nadgrids=@null +wktext +no_defs",
        pyproj.CRS("EPSG:28992").to_wkt(),
        pyproj.CRS("EPSG:3857").to_wkt("WKT1_GDAL"),
        pyproj.CRS("EPSG:7405").to_json(),
    ],
)
def test_what_names_no_file_is_as_pyproj_has_it(crs: str) -> None:
    assert known_crs(crs) == pyproj.CRS(crs)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
def test_a_grid_in_the_current_folder_is_not_opened(tmp_path: Path) -> None:
    """Whoever opens a pipe that nobody writes to waits for ever."""
    os.mkfifo(tmp_path / "own.gsb")
    code = (
        "import contextlib, pyproj\nfrom rasterio.warp import transform\n"
        "crs = '+proj=longlat +ellps=bessel +nadgrids=own.gsb +type=crs'\n"
        "with contextlib.suppress(pyproj.exceptions.ProjError):\n"
        "    pyproj.Transformer.from_crs(crs, 'EPSG:4326')\n"
        "with contextlib.suppress(Exception):\n"
        "    transform(crs, 'EPSG:4326', [10.0], [50.0])\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=120)


# --- words for one CRS ------------------------------------------------------------------------------------------------

UTM = "EPSG:32629"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (32629, UTM),
        ("32629", UTM),
        ("EPSG:32629", UTM),
        ("epsg:32629", UTM),
        ("urn:ogc:def:crs:EPSG::32629", UTM),
        ("WGS 84 / UTM zone 29N", UTM),
        ("OSGB36 / British National Grid", "EPSG:27700"),
        (pyproj.CRS(32629), UTM),
        (pyproj.CRS(32629).to_wkt("WKT1_GDAL"), UTM),
        (pyproj.CRS(32629).to_json(), UTM),
        ("EPSG:4979", "EPSG:4326"),
    ],
)
def test_one_crs_in_many_words(given: object, expected: str) -> None:
    assert name_crs(given) == expected


@pytest.mark.parametrize("given", ["ESRI:102003", "+proj=laea +lat_0=41 +lon_0=-8", "EPSG:7415"])
def test_what_has_no_code_is_wkt_that_gdal_reads_too(given: str) -> None:
    reported = name_crs(given)
    assert rasterio.CRS.from_user_input(reported).to_wkt()
    assert pyproj.CRS(reported).equals(pyproj.CRS(given).to_2d(), ignore_axis_order=True)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("nonsense", "'nonsense' is no CRS that PROJ knows; expected for example EPSG:3857, 3857, a name such as"),
        ("EPSG:999999", "no CRS that PROJ knows"),
        (999999, "no CRS that PROJ knows"),
        ("", "no CRS that PROJ knows"),
        ("EPSG:4978", "no CRS of a map, but a Geocentric CRS"),
        ("EPSG:5701", "no CRS of a map, but a Vertical CRS"),
        ('ENGCRS["a sheet",EDATUM["it"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],UNIT["m",1]]', "no CRS of"),
    ],
)
def test_what_is_no_crs_is_said(given: object, message: str) -> None:
    with pytest.raises(CrsError, match=message) as raised:
        name_crs(given)
    assert "\n" not in str(raised.value)
