"""Contents of pictures and pages: layers of marks in one frame (x right, y down), and how each layer looks.

Both writers, of SVG and of pixels, take colours and widths from here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from roadgeo._arrays import AnyArray, FloatArray

__all__ = [
    "PALETTE",
    "STYLES",
    "Arrows",
    "Bitmap",
    "Box",
    "Circles",
    "Color",
    "Cross",
    "Dots",
    "Layer",
    "Lines",
    "Mark",
    "Ring",
    "Style",
    "rgb",
]  # fmt: skip

Color = tuple[int, int, int]

#: Left, top, width and height of a part of a frame.
Box = tuple[float, float, float, float]

#: Colours by name, on light and on dark screens; pictures are light.
PALETTE = {
    "paper": ("#f3f1ec", "#16191d"),
    "card": ("#ffffff", "#1f2329"),
    "ink": ("#262a30", "#e9e7e1"),
    "faint": ("#5c636b", "#a3aab2"),
    "line": ("#dedbd3", "#3a4048"),
    "link": ("#12609f", "#7db9ea"),
    "halo": ("#ffffff", "#16191d"),
    "map-road": ("#b3b5b8", "#5d646d"),
    "query": ("#e4572e", "#ff7a50"),
    "agree": ("#008080", "#4ecdc4"),
    "match": ("#1b263b", "#fff3d6"),
    "frame": ("#1f6fb4", "#5aa9e6"),
    "other": ("#8e24aa", "#d694e8"),
    "arrow": ("#a3107c", "#ff6ac1"),
    "good": ("#17693d", "#6fcf97"),
    "fair": ("#8a5300", "#f0b45a"),
    "bad": ("#ab2317", "#ff8a7d"),
}


def rgb(color: str) -> Color:
    """Return red, green and blue of a colour, "#rrggbb" or one in the palette, as on light screens."""
    red, green, blue = bytes.fromhex(PALETTE.get(color, (color,))[0].removeprefix("#"))
    return red, green, blue


@dataclass(frozen=True)
class Style:
    """How a layer looks.

    Attributes
    ----------
    color : str
        Name in `PALETTE`.
    width_px : float
        Width of lines, and diameter of dots, on a screen.
    width_m : float
        Width on the ground, of lines drawn to scale where that can be seen; 0 for the same width at every scale.
    fill : float
        Opacity inside rings.
    dash : str
        Lengths of dashes and gaps, pixels of a screen.
    """

    color: str
    width_px: float
    width_m: float = 0.0
    fill: float = 0.0
    dash: str = ""


#: Styles by the names of layers.
STYLES = {
    "ground": Style("halo", 0.0, fill=1.0),
    "map-roads": Style("map-road", 4.0, width_m=9.0),
    "query-roads": Style("query", 1.7),
    "agreeing-roads": Style("agree", 1.7),
    "branches": Style("arrow", 1.2),
    "footprint": Style("frame", 3.0),
    "edge": Style("frame", 2.0),
    "matches": Style("match", 7.0),
    "unmatched": Style("faint", 5.0),
    "residuals": Style("arrow", 1.6),
    "sigma": Style("frame", 1.6, dash="4 4"),
    "runner-up": Style("other", 3.0),
    "now": Style("ink", 3.0, fill=0.22),
    "streets": Style("ink", 0.8),
    "way": Style("ink", 1.6, dash="5 3"),
    **{name: Style("good", 2.0, fill=0.15) for name in ("located", "right")},
    **{name: Style("fair", 2.0, fill=0.15) for name in ("ambiguous", "chosen", "predicted")},
    **{name: Style("bad", 2.0, fill=0.15) for name in ("wrong", "lost")},
    "tracked": Style("frame", 2.0, fill=0.15),
    "not_located": Style("faint", 2.0, fill=0.15),
}


@dataclass(frozen=True)
class Lines:
    """Polylines (V, 2)."""

    lines: Sequence[FloatArray]


@dataclass(frozen=True)
class Dots:
    """Points (K, 2), filled or hollow."""

    points: FloatArray
    hollow: bool = False


@dataclass(frozen=True)
class Ring:
    """A closed outline (K, 2); `up` marks its first side, the image's top, by a triangle.

    On pages `title` is shown under the pointer, `link` is followed, and scripts find it by `number`.
    """

    corners: FloatArray
    up: bool = False
    title: str = ""
    link: str = ""
    number: int | None = None


@dataclass(frozen=True)
class Bitmap:
    """A picture (h, w, 4) uint8, red, green, blue, alpha, stretched to a box.

    On a page it takes at most `max_bytes`; a drawing is coded `lossless`.
    """

    image: AnyArray
    box: Box
    max_bytes: int = 300_000
    lossless: bool = False


@dataclass(frozen=True)
class Arrows:
    """Arrows at points (K, 2) along steps (K, 2), which pages enlarge."""

    at: FloatArray
    steps: FloatArray


@dataclass(frozen=True)
class Circles:
    """Circles about points (K, 2) with radii (K,), which pages enlarge, and their texts."""

    centers: FloatArray
    radii: FloatArray
    texts: Sequence[str]


@dataclass(frozen=True)
class Cross:
    """A cross with a text at a point (2,)."""

    at: FloatArray
    text: str


Mark = Lines | Dots | Ring | Bitmap | Arrows | Circles | Cross


@dataclass(frozen=True)
class Layer:
    """Marks that are shown or hidden together; `label` stands in the legend, and without one it has none there."""

    name: str
    label: str
    marks: Sequence[Mark] = field(default=())
    shown: bool = True
