import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest
from click.testing import CliRunner

from roadgeo.cli import cli
from roadgeo.errors import MaskError
from roadgeo.sources.exif import read_focal_length


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
