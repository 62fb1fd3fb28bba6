"""A segmenter for roadgeo that asks samgeo (Segment Anything, prompted by text) for roads."""

import tempfile
from functools import cache
from pathlib import Path

from roadgeo.sources.masks import read_mask


def find_roads(photo):
    """The mask of the roads in a photograph."""
    with tempfile.TemporaryDirectory() as folder:
        mask = Path(folder) / "roads.tif"
        _model().predict(str(photo), "road", box_threshold=0.24, text_threshold=0.24, output=str(mask))
        if not mask.exists():
            raise ValueError("nothing in the photograph is called a road")
        return read_mask(mask, name=str(photo))


@cache
def _model():
    from samgeo.text_sam import LangSAM

    return LangSAM()
