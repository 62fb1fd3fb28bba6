"""A located mask on the map, for notebooks and papers: drawn as SVG or PNG."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from roadgeo._text import in_html
from roadgeo.errors import OutputError
from roadgeo.outputs.drawing.layers import Layer
from roadgeo.outputs.drawing.raster import Canvas, write_png
from roadgeo.outputs.drawing.svg import draw_layer, stylesheet
from roadgeo.outputs.drawing.views import STILL, Window, place_layers
from roadgeo.outputs.subject import Subject
from roadgeo.storage.files import replacing, write_text

__all__ = ["Plot", "draw_plot"]

_WIDTH_PX, _MARGIN = 900, 0.12


@dataclass(frozen=True)
class Plot:
    """Layers of a window of the map; notebooks show it.

    Attributes
    ----------
    width_m, height_m : float
        Ground that it shows.
    credit : str
        Whom the map's licence asks to name.
    """

    width_m: float
    height_m: float
    layers: Sequence[Layer]
    credit: str = ""

    def _repr_svg_(self) -> str:
        """Draw it as SVG, which needs no other file."""
        width, height = _WIDTH_PX, round(_WIDTH_PX * self.height_m / self.width_m)
        per_px = self.width_m / _WIDTH_PX
        at = f'x="{6 * per_px:.4g}" y="{self.height_m - 6 * per_px:.4g}"'
        credit = f'<text {at} style="font-size:{12 * per_px:.4g}px">{in_html(self.credit)}</text>'
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="0 0 {self.width_m:.1f} {self.height_m:.1f}" style="--u:{per_px:.4g};background:var(--paper)">'
            f"<style>{stylesheet()}</style>{''.join(map(draw_layer, self.layers))}{credit}</svg>"
        )

    def save(self, path: str | os.PathLike[str], width_px: int = 1400) -> None:
        """Write it as SVG or PNG, by the suffix of the path.

        Raises
        ------
        OutputError
            The suffix is another, or the file cannot be written.
        """
        target = Path(path)
        if target.suffix.lower() == ".svg":
            write_text(target, self._repr_svg_())
        elif target.suffix.lower() == ".png":
            canvas = Canvas.of((0.0, 0.0, self.width_m, self.height_m), 0, 0, width_px / self.width_m)
            canvas.draw(self.layers)
            with replacing(target) as temporary:
                write_png(temporary, canvas.image)
        else:
            raise OutputError(f"{target}: a plot is saved as .svg or .png; choose one of these names")


def draw_plot(subject: Subject) -> Plot:
    """Draw the footprint of a located mask, its roads and its matches over the roads of the map.

    Raises
    ------
    OutputError
        The location has no place.
    """
    window = Window.around(subject.place.footprint, _MARGIN)
    layers = [layer for layer in place_layers(subject, window) if layer.name in STILL]
    return Plot(window.width, window.height, layers, subject.attribution)
