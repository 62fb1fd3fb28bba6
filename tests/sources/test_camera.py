"""What cameras state of their view becomes hints, with the errors of such statements."""

import math
from pathlib import Path

import PIL.ExifTags
import PIL.Image
import PIL.PngImagePlugin
import pytest
from pyproj import Geod

from roadgeo.errors import MaskError
from roadgeo.sources.camera import estimate_gsd, read_stated

WIDE, HIGH, FOCAL_MM = 400, 300, 24
FOCAL_PX = FOCAL_MM / 36 * WIDE
PLACE = (-8.629, 41.1625)

#: A view from 100 m, 30 degrees from the vertical, to the east, as makers write it.
MAKERS = {
    "DJI": 'drone-dji:RelativeAltitude="+100.00" drone-dji:GimbalYawDegree="+90.00" '
    'drone-dji:GimbalPitchDegree="-60.00"',
    "Autel": "<drone:RelativeAltitude>100.0</drone:RelativeAltitude><drone:GimbalYawDegree>90</drone:GimbalYawDegree>"
    "<drone:GimbalPitchDegree>-60</drone:GimbalPitchDegree>",
    "Autel, old": '<x Camera:AboveGroundAltitude="100" Camera:Yaw="90" Camera:Pitch="-60"/>',
    "Parrot": "<drone-parrot:CameraYawDegree>90.0</drone-parrot:CameraYawDegree>"
    "<drone-parrot:CameraPitchDegree>-60.0</drone-parrot:CameraPitchDegree>"
    "<Camera:AboveGroundAltitude>100/1</Camera:AboveGroundAltitude>",
    "senseFly": '<x Camera:AboveGroundAltitude="100.0" Camera:Yaw="90.0" Camera:Pitch="30.0"/>',
    "a gimbal upside down": 'drone-dji:RelativeAltitude="+100.00" drone-dji:GimbalYawDegree="-90.00" '
    'drone-dji:GimbalRollDegree="+180.00" drone-dji:GimbalPitchDegree="-60.00"',
}


def photograph(path: Path, xmp: str = "", position: bool = True, focal: bool = True, altitude: float = 0.0) -> str:
    """A photograph of a camera in Porto."""
    exif = PIL.Image.Exif()
    if focal:
        exif.get_ifd(PIL.ExifTags.IFD.Exif)[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = FOCAL_MM
    gps = {1: "N", 2: (41.0, 9.0, 45.0), 3: "W", 4: (8.0, 37.0, 44.4)} if position else {}
    if altitude:
        gps[6] = altitude
    if gps:
        exif.get_ifd(PIL.ExifTags.IFD.GPSInfo).update(gps)
    text = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description {xmp}/></rdf:RDF></x:xmpmeta>'
    info = PIL.PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", text)
    exif[700] = text.encode()
    how = {".jpg": {"xmp": text.encode()}, ".webp": {"xmp": text.encode()}, ".png": {"pnginfo": info}}
    PIL.Image.new("RGB", (WIDE, HIGH)).save(path, exif=exif, **how.get(path.suffix, {}))
    return str(path)


@pytest.mark.parametrize("maker", MAKERS)
def test_makers_write_it_differently(tmp_path: Path, maker: str) -> None:
    stated = read_stated(["near", "gsd_m", "heading_deg", "focal_px"], photograph(tmp_path / "a.jpg", MAKERS[maker]))
    assert stated["heading_deg"][0] == pytest.approx(90.0)
    assert stated["focal_px"] == pytest.approx(FOCAL_PX)
    lon, lat, radius = stated["near"]
    azimuth, _, away = Geod(ellps="WGS84").inv(*PLACE, lon, lat)
    assert azimuth == pytest.approx(90.0, abs=1.0)
    assert away == pytest.approx(100.0 * math.tan(math.radians(30.0)), abs=0.5)
    assert 30.0 < radius < 80.0
    low, high = stated["gsd_m"]
    assert low < 100.0 / FOCAL_PX / math.cos(math.radians(30.0)) ** 1.5 < high < 1.6 * low * 1.3


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_any_file_may_state_it(tmp_path: Path, suffix: str) -> None:
    path = photograph(tmp_path / f"a.{suffix}", MAKERS["DJI"])
    assert read_stated(["heading_deg"], path) == {"heading_deg": (90.0, 15.0)}
    assert read_stated(["near"], path)["near"][:2] == pytest.approx((-8.62831, 41.1625), abs=1e-4)


@pytest.mark.parametrize(
    ("name", "missing", "message"),
    [
        ("near", {"xmp": MAKERS["DJI"], "position": False}, "state no position"),
        ("near", {}, "state no height of its camera: give --near as a value, or none"),
        ("gsd_m", {"altitude": 300.0}, "state no height above the ground"),
        ("gsd_m", {"xmp": MAKERS["DJI"], "focal": False}, "no focal length"),
        ("heading_deg", {}, "state no direction of its camera: give --heading as a value, or none"),
        ("near", {"xmp": MAKERS["DJI"].replace("-60", "-05")}, "looked at the horizon"),
    ],
)
def test_a_statement_that_is_missing_is_named(tmp_path: Path, name: str, missing: dict, message: str) -> None:
    with pytest.raises(MaskError, match=message):
        read_stated([name], photograph(tmp_path / "a.jpg", **missing))


def test_the_circle_is_wider_where_less_is_stated(tmp_path: Path) -> None:
    exact = MAKERS["DJI"].replace("-60", "-90") + ' drone-dji:RtkStdLat="0.02"'
    paths = [
        photograph(tmp_path / "rtk.jpg", exact),
        photograph(tmp_path / "plain.jpg", MAKERS["DJI"].replace("-60", "-90")),
        photograph(tmp_path / "aslant.jpg", MAKERS["DJI"]),
        photograph(tmp_path / "no_gimbal.jpg", 'drone-dji:RelativeAltitude="+100.00"'),
        photograph(tmp_path / "sea.jpg", altitude=900.0),
    ]
    radii = [read_stated(["near"], path)["near"][2] for path in paths]
    assert radii == sorted(radii)
    assert radii[0] < 10.0
    assert radii[-1] == pytest.approx(915.0)


def test_the_scale_is_estimated_from_the_better_height(tmp_path: Path) -> None:
    dji = photograph(tmp_path / "a.jpg", MAKERS["DJI"], altitude=900.0)
    assert estimate_gsd(dji) == pytest.approx(100.0 / FOCAL_PX)
    assert estimate_gsd(photograph(tmp_path / "b.jpg", altitude=900.0)) == pytest.approx(900.0 / FOCAL_PX)
    assert estimate_gsd(photograph(tmp_path / "c.jpg")) is None


def test_a_mask_goes_by_its_photograph(tmp_path: Path) -> None:
    photo = photograph(tmp_path / "a.jpg", MAKERS["DJI"])
    PIL.Image.new("L", (WIDE // 2, HIGH // 2)).save(tmp_path / "mask.png")
    assert read_stated(["focal_px"], str(tmp_path / "mask.png"), photo)["focal_px"] == pytest.approx(FOCAL_PX / 2)
