import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest
from click.testing import CliRunner

from roadgeo.cli import cli
from roadgeo.errors import MaskError
from roadgeo.sources.exif import read_focal_length, read_position, read_time
from roadgeo.sources.georeference import read_stated


def jpeg_with_exif(path, focal_mm):
    """A JPEG with one EXIF tag, FocalLengthIn35mmFilm."""
    exif = PIL.Image.Exif()
    exif.get_ifd(PIL.ExifTags.IFD.Exif)[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = focal_mm
    PIL.Image.new("RGB", (90, 60)).save(path, exif=exif)
    return path


def test_the_focal_length_is_a_multiple_of_the_longer_side(tmp_path):
    assert read_focal_length(jpeg_with_exif(tmp_path / "photo.jpg", 24)) == pytest.approx(24 / 36)


def test_a_photograph_without_exif_says_so(tmp_path):
    cv2.imwrite(str(tmp_path / "plain.jpg"), np.zeros((60, 90, 3), np.uint8))
    with pytest.raises(MaskError, match="give it in pixels"):
        read_focal_length(tmp_path / "plain.jpg")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MaskError, match=r"gone\.jpg"):
        read_focal_length(tmp_path / "gone.jpg")


@pytest.mark.parametrize("wrong", ["wide", "-3", "0", "nan"])
def test_what_is_no_focal_length_is_a_usage_error(wrong):
    result = CliRunner().invoke(cli, ["locate", "mask.png", "--focal", wrong])
    assert result.exit_code == 2
    assert "expected pixels above 0, or exif" in result.output


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize(
    ("stated", "place"),
    [
        (("N", (41.0, 9.0, 45.0), "W", (8.0, 37.0, 44.4)), (-8.629, 41.1625)),
        (("S", (33.0, 51.0, 0.0), "E", (151.0, 12.0, 36.0)), (151.21, -33.85)),
        (("N", (0.0, 0.0, 0.0), "E", (0.0, 0.0, 0.0)), None),  # no fix
        (("N", (95.0, 0.0, 0.0), "E", (8.0, 0.0, 0.0)), None),
        (None, None),
    ],
)
def test_the_camera_says_where_it_is(tmp_path, suffix, stated, place):
    exif = PIL.Image.Exif()
    if stated:
        exif[0x8825] = dict(enumerate(stated, 1))
    PIL.Image.new("RGB", (90, 60)).save(tmp_path / f"a.{suffix}", exif=exif)
    for read in (read_position(tmp_path / f"a.{suffix}"), read_stated(tmp_path / f"a.{suffix}").middle):
        assert read == (None if place is None else pytest.approx(place, abs=1e-6))


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize(("zone", "hours"), [("", 0), ("+02:00", -2), ("-03:30", 3.5), ("   :  ", 0)])
def test_clocks_that_are_put_back_do_not_go_back(tmp_path, suffix, zone, hours):
    exif = PIL.Image.Exif()
    exif[PIL.ExifTags.IFD.Exif] = {0x9003: "2024:10:27 02:30:00", **({0x9011: zone} if zone else {})}
    PIL.Image.new("L", (90, 60)).save(tmp_path / f"a.{suffix}", exif=exif)
    assert read_time(tmp_path / f"a.{suffix}") == 1729996200 + 3600 * hours
