"""The views of a page: layers that can be switched, moved about in and zoomed into."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence

from roadgeo._arrays import FloatArray
from roadgeo._text import in_html
from roadgeo.outputs.drawing.layers import Box, Layer
from roadgeo.outputs.drawing.svg import draw_layer, draw_marks, draw_sign
from roadgeo.outputs.drawing.views import Window

__all__ = ["draw_viewer"]

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
    shown: Box | Window,
    layers: Sequence[Layer],
    credit: str = "",
    *,
    width_px: float = 900,
    arrows: float = 0.0,
    homography: FloatArray | None = None,
) -> str:
    """Draw layers that can be zoomed into, with a legend that switches those that have a label: an HTML figure.

    Parameters
    ----------
    text : str
        Describes the view to those who cannot see it.
    shown : Box or Window
        All of an image, in its pixels; or a part of the map, in metres, with a scale bar.
    credit : str
        Stands in a corner.
    width_px : float
        Width that it is drawn for until the page's script knows better.
    arrows : float
        Screen pixels for a metre of residuals and of corners' circles, which are enlarged by a factor that is shown.
    homography : (3, 3), optional
        From the pixels of the page's image to the frame of the window.
    """
    box = shown.box if isinstance(shown, Window) else shown
    unit, notes = max(box[2:]) / width_px, ""
    data = {"style": f"--u:{unit:.4g};--k:{max(1.0, arrows * unit):.4g}", "data-frame": "mask"}
    if isinstance(shown, Window):
        data |= {"data-frame": "map", "data-west": f"{shown.west:.3f}", "data-north": f"{shown.north:.3f}"}
        notes = '<span class="scale"></span>'
    if homography is not None:
        data["data-homography"] = json.dumps(homography.tolist())
    if arrows:
        data["data-arrows"] = f"{arrows:.4g}"
        notes = f'<span>residuals, corners <span class="times">enlarged</span></span>{notes}'
    named = f'<span class="credit">{in_html(credit)}</span>' if credit else ""
    pad = 0.02 * max(box[2:])
    view = f"{box[0] - pad:.1f} {box[1] - pad:.1f} {box[2] + 2 * pad:.1f} {box[3] + 2 * pad:.1f}"
    given = "".join(f' {name}="{html.escape(value)}"' for name, value in data.items())
    groups = "".join(map(draw_layer, layers))
    legend = "".join(
        f'<label><input type="checkbox" data-toggles="{layer.name}"{" checked" if layer.shown else ""}>'
        f'<svg viewBox="0 0 26 14" aria-hidden="true" class="{layer.name}">{draw_sign(layer)}</svg>'
        f"{in_html(layer.label)}</label>"
        for layer in layers
        if layer.label and draw_marks(layer.marks[:1])
    )
    return (
        '<figure class="viewer"><div class="stage" tabindex="0" role="group" '
        'aria-label="Zoom with + and −, move with the arrow keys, 0 shows all">'
        f'<svg class="view" viewBox="{view}" role="img" aria-label="{in_html(text)}"{given}>{groups}{_MARKS}</svg>'
        f'{_BUTTONS}<div class="notes">{notes}<span class="position"></span></div>{named}</div>'
        f'<fieldset class="legend" aria-label="Layers">{legend}</fieldset></figure>'
    )
