"""A figure of a result for papers: the mask and its place on the map, with axes, as PDF, SVG or PNG (by matplotlib)."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import OutputError, how_to_install
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.location import Location
from roadgeo.outputs.canvas import FRAME, MAP_ROAD, MATCH, QUERY_ROAD, Color, touching
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.subject import Subject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FigureOptions", "draw_figure", "has_matplotlib", "write_figure"]


@dataclass(frozen=True)
class FigureOptions:
    """Size of the figure.

    Attributes
    ----------
    width_in : float
        Inches: 7 is a page of two columns.
    dpi : int
        Resolution of rasters: the mask, and all of a PNG.
    margin : float
        Ground shown around the footprint, in lengths of its longer side.
    """

    width_in: float = 7.0
    dpi: int = 300
    margin: float = 0.12


def has_matplotlib() -> bool:
    """Whether matplotlib is installed, which is an extra of roadgeo."""
    return importlib.util.find_spec("matplotlib") is not None


def write_figure(path: Path, subject: Subject) -> None:
    """Write `draw_figure`; the suffix determines the format.

    Raises
    ------
    OutputError
        matplotlib is missing.
    """
    if not has_matplotlib():
        raise OutputError(f"{subject.location.query}: figures need matplotlib: {how_to_install('plot')}")
    figure = draw_figure(subject.location, subject.mask, subject.roads, subject.attribution)
    figure.savefig(path, metadata={"Creator": "roadgeo"} if path.suffix in {".pdf", ".svg"} else None)


def draw_figure(
    location: Location, mask: RoadMask, roads: FloatArray, attribution: str = "", options: FigureOptions | None = None
) -> Figure:
    """Draw the mask with its matched intersections on the left, and where it lies on the right.

    Parameters
    ----------
    roads : (S, 4) float64
        Segments x1, y1, x2, y2 of the reference's roads in the location's CRS; those far away are skipped.
    attribution : str
        Whom the map's licence asks to name.

    Raises
    ------
    OutputError
        The location has no place.
    """
    from matplotlib.figure import Figure

    options = options or FigureOptions()
    place = Placement.of(location)
    figure = Figure(figsize=(options.width_in, 0.56 * options.width_in), dpi=options.dpi, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(0.8, 1.0))
    _draw_mask(left, location, mask)
    _draw_map(right, location, place, roads, options.margin)
    if attribution:
        right.text(1.0, -0.17, f"Map: {attribution}", transform=right.transAxes, fontsize=5, ha="right", color="0.4")
    return figure


def _draw_mask(axes: Any, location: Location, mask: RoadMask) -> None:
    height, width = mask.shape
    axes.imshow(mask.roads, cmap="gray_r", extent=(0, width, height, 0), interpolation="antialiased")
    if location.evidence is not None:
        axes.plot(*plane_to_pixel(location.evidence.query_xy).T, ".", color=_rgb(QUERY_ROAD), markersize=3)
    axes.set_xlabel("column (px)", fontsize=7)
    axes.set_ylabel("row (px)", fontsize=7)
    axes.tick_params(labelsize=6)


def _draw_map(axes: Any, location: Location, place: Placement, roads: FloatArray, margin: float) -> None:
    from matplotlib.collections import LineCollection

    low, high = place.footprint.min(axis=0), place.footprint.max(axis=0)
    around = margin * float((high - low).max())
    low, high = low - around, high + around
    ends = roads.reshape(-1, 2, 2)
    near = touching(ends, low, high)
    # Kilometres from the corner: eastings and northings of seven digits are hard to read on an axis.
    axes.add_collection(LineCollection((ends[near] - low) / 1e3, colors=[_rgb(MAP_ROAD)], linewidths=1.6, label="map"))
    if location.evidence is not None:
        lines = [(line - low) / 1e3 for line in place.map_roads(location.evidence.query_graph)]
        axes.add_collection(LineCollection(lines, colors=[_rgb(QUERY_ROAD)], linewidths=0.7, label="mask"))
        matched = (location.evidence.reference_xy - low) / 1e3
        axes.plot(*matched.T, ".", color=_rgb(MATCH), markersize=3, label="matched")
    outline = (np.vstack((place.footprint, place.footprint[:1])) - low) / 1e3
    axes.plot(*outline.T, "-", color=_rgb(FRAME), linewidth=1, label="footprint")
    axes.set_xlim(0, (high - low)[0] / 1e3)
    axes.set_ylim(0, (high - low)[1] / 1e3)
    axes.set_aspect("equal")
    axes.set_xlabel(f"east of {low[0]:,.0f} m (km)", fontsize=7)
    axes.set_ylabel(f"north of {low[1]:,.0f} m (km)", fontsize=7)
    axes.tick_params(labelsize=6)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=6, frameon=False)


def _rgb(color: Color) -> tuple[float, float, float]:
    red, green, blue = (value / 255 for value in color)
    return red, green, blue
