"""Common parts of a report's views: layers of SVG that can be switched, moved about in and zoomed into."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

from roadgeo._arrays import FloatArray
from roadgeo.outputs.report.svg import draw_dots

__all__ = ["DOT_SIGN", "PICTURE_SIGN", "RING_SIGN", "Layer", "draw_rings", "draw_viewer", "pin", "ring_data"]


@dataclass(frozen=True)
class Layer:
    """Something that can be shown or not: `name` is its class in the style sheet, `sign` stands in the legend."""

    name: str
    label: str
    content: str
    sign: str = '<path d="M2 7h22"/>'
    shown: bool = True


DOT_SIGN = '<path class="halo" d="M13 7h.1"/><path d="M13 7h.1"/>'
RING_SIGN = '<path d="M13 7h.1"/><path class="core" d="M13 7h.1"/>'
PICTURE_SIGN = '<rect x="3" y="2" width="20" height="10"/>'
_BUTTONS = (
    '<div class="buttons"><button type="button" data-act="in" aria-label="Zoom in">+</button>'
    '<button type="button" data-act="out" aria-label="Zoom out">−</button>'
    '<button type="button" data-act="fit" aria-label="Show all">⤢</button></div>'
)
_MARKS = (
    '<g class="ring off"><g class="fixed"><circle r="11"/></g></g>'
    '<g class="cursor off"><path class="fixed" d="M-14 0h10m8 0h10M0-14v10m0 8v10"/></g>'
)


def draw_viewer(
    said: str,
    box: tuple[float, float, float, float],
    layers: Sequence[Layer],
    attributes: dict[str, str],
    *,
    scale: bool = False,
    enlarged: bool = False,
    credit: str = "",
) -> str:
    """Draw layers that can be zoomed into, with a legend that switches those that have a label: an HTML figure.

    Parameters
    ----------
    scale : bool
        Show a scale bar: the units are metres.
    enlarged : bool
        Show the factor by which residuals and circles are enlarged.
    credit : str
        Stands in a corner.
    """
    notes = '<span>residuals, corners <span class="times">enlarged</span></span>' if enlarged else ""
    notes += '<span class="scale"></span>' if scale else ""
    named = f'<span class="credit">{html.escape(credit)}</span>' if credit else ""
    pad = 0.02 * max(box[2:])
    view = f"{box[0] - pad:.1f} {box[1] - pad:.1f} {box[2] + 2 * pad:.1f} {box[3] + 2 * pad:.1f}"
    given = "".join(f' {name}="{html.escape(value)}"' for name, value in attributes.items())
    groups = "".join(f'<g class="{one.name}{"" if one.shown else " off"}">{one.content}</g>' for one in layers)
    legend = "".join(
        f'<label><input type="checkbox" data-toggles="{one.name}"{" checked" if one.shown else ""}>'
        f'<svg viewBox="0 0 26 14" aria-hidden="true" class="{one.name}">{one.sign}</svg>'
        f"{html.escape(one.label)}</label>"
        for one in layers
        if one.content and one.label
    )
    return (
        '<figure class="viewer"><div class="stage" tabindex="0" role="group" '
        'aria-label="Zoom with + and −, move with the arrow keys, 0 shows all">'
        f'<svg class="view" viewBox="{view}" role="img" aria-label="{html.escape(said)}"{given}>{groups}{_MARKS}</svg>'
        f'{_BUTTONS}<div class="notes">{notes}<span class="position"></span></div>{named}</div>'
        f'<fieldset class="legend" aria-label="Layers">{legend}</fieldset></figure>'
    )


def pin(at: FloatArray, content: str, text: str) -> str:
    """Put something that keeps its size on the screen at an SVG position."""
    said = f'<text x="13" y="5">{html.escape(text)}</text>'
    return f'<g transform="translate({at[0]:.2f} {at[1]:.2f})"><g class="fixed">{content}{said}</g></g>'


def ring_data(corners: FloatArray) -> str:
    """Path data of a closed ring (K, 2)."""
    return "M" + " ".join(f"{x:.1f},{y:.1f}" for x, y in corners.tolist()) + "z"


def draw_rings(points: FloatArray) -> str:
    """Draw intersections that do not match."""
    return draw_dots(points, ("", "core"))
