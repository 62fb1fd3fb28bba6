import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from roadgeo.cli import cli
from roadgeo.errors import MaskError
from roadgeo.sources.exif import read_focal_length


def jpeg_with_exif(path, focal_mm):
    """A JPEG with one EXIF tag, FocalLengthIn35mmFilm (0xA405), written byte by byte."""
    picture = cv2.imencode(".jpg", np.zeros((60, 90, 3), np.uint8))[1].tobytes()
    sub = b"\x01\x00" + b"\x05\xa4\x03\x00\x01\x00\x00\x00" + focal_mm.to_bytes(2, "little") + b"\x00\x00" + bytes(4)
    ifd = b"\x01\x00" + b"\x69\x87\x04\x00\x01\x00\x00\x00" + (26).to_bytes(4, "little") + bytes(4)
    exif = b"Exif\x00\x00" + b"II*\x00\x08\x00\x00\x00" + ifd + sub
    path.write_bytes(picture[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + picture[2:])
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
    result = CliRunner().invoke(cli, ["locate", "mask.png", "--camera", wrong])
    assert result.exit_code == 2
    assert "expected pixels above 0, or exif" in result.output
