"""One name for each CRS; a grid by its bare name is looked for in PROJ's own folders."""

import os
import subprocess
import sys
from pathlib import Path

import pyproj
import pytest
import rasterio

from roadgeo.errors import CrsError
from roadgeo.storage.crs import name_crs


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
