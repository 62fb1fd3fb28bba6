"""What the user says of images, masks or photographs: options of `locate`, `track`, `verify` and `vectorize`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import click

from roadgeo.cli.parameters import BANDS, Plugin

if TYPE_CHECKING:
    from roadgeo.running.options import ReadOptions

__all__ = ["mask_options", "n_threads", "read_options", "segmenting_options"]

Command = TypeVar("Command", bound=Callable[..., Any])

_MAX_THREADS = 4


class Segmenter(Plugin):
    """The name of a plugin, or the file of a model."""

    name = "segmenter"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Check that it is there; nothing of it is read.

        Raises
        ------
        click.BadParameter
            It is not.
        """
        text = str(value)
        if not text.lower().endswith(".onnx"):
            return super().convert(value, param, ctx)
        if not os.path.isfile(text):  # noqa: PTH113 (names may hold what Path refuses)
            self.fail(f"no such model file: {text}", param, ctx)
        return text


_OPTIONS = [
    click.option(
        "--segment",
        type=click.Choice(["auto", "always", "never"]),
        default="auto",
        show_default=True,
        help="Find the roads in photographs first: in what looks like one, in everything, or in nothing.",
    ),
    click.option(
        "--segmenter",
        "segmenters",
        metavar="NAME|MODEL.onnx",
        type=Segmenter("roadgeo.segmenters"),
        multiple=True,
        help="Who finds roads in photographs: a plugin (`roadgeo info --plugins` lists them), or a model as QGIS "
        "Deepness, GeoDeep or STAC describe them. Several are fused. Default: the model that ships.",
    ),
    click.option(
        "--class", "class_name", metavar="NAME", help="Class of the model that is road. Default: told by the names."
    ),
]
_FUSE = click.option(
    "--fuse", is_flag=True, help="All that is given shows one frame (exposures, masks of several models): fuse it."
)


def segmenting_options(command: Command, *, fuse: bool = True) -> Command:
    """Add the options of `_OPTIONS`, and `--fuse`."""
    for option in reversed([*_OPTIONS, _FUSE] if fuse else _OPTIONS):
        command = option(command)
    return command


def mask_options(command: Command) -> Command:
    """Add `--threshold` and `--band`: which values of an image are road."""
    told = "Values above T are road; of a photograph (--segment always) probabilities. Default: told by them."
    threshold = click.option("--threshold", metavar="T", type=float, help=told)
    held = "Band that holds the mask. Default: told by the bands."
    band = click.option("--band", metavar="N", type=click.IntRange(1), help=held)
    seen = "Red, green and blue band of photographs, such as 3,2,1. Default: told by their names, or the first three."
    return threshold(band(click.option("--bands", metavar="R,G,B", type=BANDS, help=seen)(command)))


def n_threads(jobs: int = 1) -> int:
    """Return how many threads a model gets."""
    return 1 if jobs > 1 else min(os.cpu_count() or 1, _MAX_THREADS)


def read_options(given: Mapping[str, Any], photos: Mapping[str, str], others: Sequence[str], jobs: int) -> ReadOptions:
    """Put together how what is given is read; `others` are fused with each query."""
    from roadgeo.running.options import ReadOptions

    return ReadOptions(
        given["threshold"],
        given["band"],
        photos,
        exif=given["focal_px"] == "exif",
        segment=given["segment"],
        segmenters=given["segmenters"],
        class_name=given["class_name"],
        fused_with=tuple(others),
        threads=n_threads(jobs),
        dem=given.get("dem") or "",
        allow_mirror=bool(given.get("allow_mirror")),
        units=given.get("units") or "auto",
        layer=given.get("layer"),
        aspect=given.get("aspect"),
        bands=given["bands"],
    )
