"""Pictures as phones and copters keep them: stored turned, with a tag that says how to turn them back."""

import struct
from pathlib import Path

import numpy as np
from PIL import Image

__all__ = ["mark_turned", "save_turned"]

_TAG = 274
#: What stores an upright picture so that its orientation makes it upright again.
_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


def save_turned(path: Path, upright: np.ndarray, orientation: int) -> Path:
    """Write an upright (H, W) or (H, W, bands) array as a picture of an orientation, in the format of its name."""
    image = Image.fromarray(upright)
    stored = image.transpose(_BACK[orientation]) if orientation in _BACK else image
    if path.suffix == ".tif":
        stored.save(path, tiffinfo={_TAG: orientation})
        return path
    exif = Image.Exif()
    exif[_TAG] = orientation
    stored.save(path, exif=exif.tobytes(), quality=95, lossless=True)
    return path


def mark_turned(path: Path, orientation: int) -> Path:
    """Have a GeoTIFF that GDAL wrote say that it is to be turned."""
    content = bytearray(path.read_bytes())
    # The entry of the sample format (339), which is the default's, becomes that of the orientation.
    at = content.index(struct.pack("<HHI", 339, 3, 1))
    content[at : at + 10] = struct.pack("<HHIH", _TAG, 3, 1, orientation)
    path.write_bytes(content)
    return path
