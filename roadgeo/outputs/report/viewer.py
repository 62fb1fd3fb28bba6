"""The views of a page: layers that can be switched, moved about in and zoomed into."""

from __future__ import annotations

import html
from collections.abc import Sequence

from roadgeo.outputs.drawing.layers import Box, Layer
from roadgeo.outputs.drawing.svg import draw_layer, draw_marks, draw_sign
from roadgeo.outputs.drawing.views import Window

__all__ = ["draw_viewer", "frame_data", "window_data"]

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
    text: str,
    box: Box,
    layers: Sequence[Layer],
    data: dict[str, str],
    *,
    scale: bool = False,
    enlarged: bool = False,
    credit: str = "",
) -> str:
    """Draw layers that can be zoomed into, with a legend that switches those that have a label: an HTML figure.

    Parameters
    ----------
    text : str
        Describes the view to those who cannot see it.
    data : dict
        Attributes of the SVG, for the page's script; see `frame_data`, `window_data`.
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
    given = "".join(f' {name}="{html.escape(value)}"' for name, value in data.items())
    groups = "".join(map(draw_layer, layers))
    legend = "".join(
        f'<label><input type="checkbox" data-toggles="{layer.name}"{" checked" if layer.shown else ""}>'
        f'<svg viewBox="0 0 26 14" aria-hidden="true" class="{layer.name}">{draw_sign(layer)}</svg>'
        f"{html.escape(layer.label)}</label>"
        for layer in layers
        if layer.label and draw_marks(layer.marks[:1])
    )
    return (
        '<figure class="viewer"><div class="stage" tabindex="0" role="group" '
        'aria-label="Zoom with + and −, move with the arrow keys, 0 shows all">'
        f'<svg class="view" viewBox="{view}" role="img" aria-label="{html.escape(text)}"{given}>{groups}{_MARKS}</svg>'
        f'{_BUTTONS}<div class="notes">{notes}<span class="position"></span></div>{named}</div>'
        f'<fieldset class="legend" aria-label="Layers">{legend}</fieldset></figure>'
    )


def frame_data(box: Box, width_px: float) -> dict[str, str]:
    """Return the attributes of a view of an image, drawn for a width in pixels until the page's script knows better."""
    return {"data-frame": "mask", "style": f"--u:{max(box[2:]) / width_px:.4g}"}


def window_data(window: Window, width_px: float) -> dict[str, str]:
    """Return the attributes of a view of the map."""
    return {
        "data-frame": "map",
        "data-west": f"{window.west:.3f}",
        "data-north": f"{window.north:.3f}",
        "style": f"--u:{window.width / width_px:.4g}",
    }
