"""From a road mask to a road graph: clean, thin, trace, prune.

All lengths scale with the mask's own road width, so that options hold for masks of any resolution. Wide roads are
thinned on a grid reduced to roads a few pixels wide; centre lines are then placed between its pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo.errors import MaskError
from roadgeo.graph import RoadGraph
from roadgeo.grid import RoadMask, pixel_to_plane
from roadgeo.kernels.thinning import GROUND, ROAD, SIMPLE, SOLID, rethin, thin
from roadgeo.kernels.tracing import smooth_chains, trace
from roadgeo.typing import AnyArray, BoolArray, Float32Array, FloatArray, Int32Array, IntArray

__all__ = ["Vectorization", "VectorizeOptions", "road_width", "vectorize"]

#: Bands of rows that `road_width` looks at first, and how many road pixels they must hold.
_BAND_ROWS, _BAND_STEP, _BAND_MIN_ROAD = 64, 256, 2000


@dataclass(frozen=True)
class VectorizeOptions:
    """How a mask is cleaned and traced. Names ending in `_widths` count road widths, `_areas` squared road widths."""

    working_width_px: float = 6.0  # wide roads are reduced to about this before thinning
    closing_widths: float = 0.35  # gaps up to this are closed
    opening_widths: float = 0.3  # threads up to this are cut
    hole_areas: float = 1.2  # smaller holes are filled
    speck_areas: float = 4.0  # smaller pieces are dropped
    spur_widths: float = 1.0  # free ends that reach less than this beyond the road's edge are dropped
    smoothing_widths: float = 0.4  # standard deviation of the smoothing along a road
    vertex_spacing_px: float = 2.0


@dataclass(frozen=True)
class Vectorization:
    """What was traced from a mask.

    Attributes
    ----------
    graph : RoadGraph
        In the query plane (see `roadgeo.grid`), pixels, N nodes.
    road_width_px : float
        Median road width.
    is_open : (N,) bool
        Nodes where a road leaves the frame or the observed ground: ends of what was seen, not of the road.
    """

    graph: RoadGraph
    road_width_px: float
    is_open: BoolArray


def vectorize(mask: RoadMask, options: VectorizeOptions | None = None) -> Vectorization:
    """Trace the centre lines of a mask's roads.

    Parameters
    ----------
    mask : RoadMask
    options : VectorizeOptions, optional

    Returns
    -------
    Vectorization

    Raises
    ------
    MaskError
        When the mask shows no road.
    """
    options = options or VectorizeOptions()
    width = road_width(mask)
    factor = max(1, round(width / options.working_width_px))
    states = _clean(_reduce(mask, factor), width / factor, options)
    distance = cv2.distanceTransform((states != GROUND).view(np.uint8), cv2.DIST_L2, 5)
    depth = 0.25 * width / factor  # half of a road half as wide as most
    pixels = thin(states, distance, max(depth, 1.0), SIMPLE)
    if len(pixels) == 0:
        raise MaskError(
            f"{mask.name or 'mask'}: no road is left after cleaning; is it a road mask with roads as non-zero?"
        )
    width_px = max(2.0 * float(np.median(distance.ravel()[pixels])) - 0.5, 1.0)
    skeleton = _prune(states, distance, pixels, options.spur_widths * width_px)
    graph, is_open = _to_graph(skeleton, distance, factor, width_px, options)
    return Vectorization(graph, width_px * factor, is_open)


def road_width(mask: RoadMask) -> float:
    """Estimate the usual road width of a mask in pixels: four times the median depth of a road pixel.

    Depths within a straight road are spread evenly between 0 and half its width.

    Raises
    ------
    MaskError
        When the mask shows no road.
    """
    roads = mask.roads.view(np.uint8)
    bands = [roads[top : top + _BAND_ROWS] for top in range(0, len(roads), _BAND_STEP)]
    if sum(int(cv2.countNonZero(band)) for band in bands) < _BAND_MIN_ROAD:
        bands = [roads]
    depths = [cv2.distanceTransform(np.ascontiguousarray(band), cv2.DIST_L2, 3)[band > 0] for band in bands]
    depth = np.concatenate(depths)
    if len(depth) == 0:
        raise MaskError(f"{mask.name or 'mask'}: no road pixel; expected a mask with roads as non-zero pixels")
    return float(max(4.0 * (np.median(depth) - 0.5), 1.0))


def _reduce(mask: RoadMask, factor: int) -> AnyArray:
    """Return the mask's states (GROUND, ROAD, SOLID) on a grid `factor` times coarser, with a ring of SOLID around."""
    roads = mask.roads.view(np.uint8)
    observed = None if mask.observed is None else mask.observed.view(np.uint8)
    if factor > 1:
        roads = _shrink(roads, factor)
        observed = None if observed is None else _shrink(observed, factor)
    states = np.full((roads.shape[0] + 2, roads.shape[1] + 2), SOLID, np.uint8)
    states[1:-1, 1:-1] = roads
    if observed is not None:
        states[1:-1, 1:-1][observed == 0] = SOLID
    return states


def _shrink(flags: AnyArray, factor: int) -> AnyArray:
    """Reduce 0/1 flags: 1 where at least half of the factor x factor pixels are."""
    height, width = flags.shape
    rows, columns = -(-height // factor), -(-width // factor)
    fill = (0, rows * factor - height, 0, columns * factor - width)
    padded = cv2.copyMakeBorder(flags, *fill, cv2.BORDER_REPLICATE) * np.uint8(254)
    mean = cv2.resize(padded, (columns, rows), interpolation=cv2.INTER_AREA)
    return (mean >= 127).view(np.uint8)


def _clean(states: AnyArray, width: float, options: VectorizeOptions) -> AnyArray:
    """Close gaps, fill holes, cut threads and drop specks."""
    filled = (states != GROUND).view(np.uint8)
    filled = _morph(filled, cv2.MORPH_CLOSE, options.closing_widths * width)
    _fill_holes(filled, options.hole_areas * width**2)
    filled = _morph(filled, cv2.MORPH_OPEN, options.opening_widths * width)
    _drop_specks(filled, options.speck_areas * width**2)
    filled[states == SOLID] = SOLID
    return filled


def _morph(flags: AnyArray, operation: int, diameter: float) -> AnyArray:
    """Open or close with a disc; nothing happens below a diameter of 1.5 px."""
    size = 2 * round(diameter / 2 - 0.25) + 1
    if size < 3:
        return flags
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(flags, operation, disc))


def _fill_holes(filled: AnyArray, area: float) -> None:
    """Fill holes smaller than `area` in place."""
    contours, hierarchy = cv2.findContours(filled, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if hierarchy is None:
        return
    holes = [
        contours[i] for i in np.flatnonzero(hierarchy[0, :, 3] >= 0).tolist() if cv2.contourArea(contours[i]) < area
    ]
    cv2.drawContours(filled, holes, -1, ROAD, cv2.FILLED)


def _drop_specks(filled: AnyArray, area: float) -> None:
    """Clear pieces whose outline encloses less than `area`, in place."""
    contours, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    specks = [contour for contour in contours if cv2.contourArea(contour) < area]
    cv2.drawContours(filled, specks, -1, GROUND, cv2.FILLED)


@dataclass(frozen=True)
class _Skeleton:
    """What `trace` returns: see there."""

    xy: FloatArray
    is_open: BoolArray
    edges: Int32Array
    chain: IntArray
    offsets: IntArray

    def lengths(self) -> FloatArray:
        """(E,) straight distance between the nodes or pixels on the way, whichever is longer."""
        a, b = self.xy[self.edges[:, 0]], self.xy[self.edges[:, 1]]
        return np.maximum(np.diff(self.offsets) + 1.0, np.hypot(*(a - b).T))


def _prune(states: AnyArray, distance: Float32Array, pixels: IntArray, reach: float) -> _Skeleton:
    """Drop free ends that reach less than `reach` beyond the road they leave, shortest first; two stay at a node."""
    no_end = np.zeros(states.shape, np.bool_)
    flat = states.ravel()
    while True:
        skeleton = _Skeleton(*trace(states, pixels))
        spurs = _spurs(skeleton, distance, reach)
        if len(spurs) == 0:
            return skeleton
        for e in spurs:
            flat[skeleton.chain[skeleton.offsets[e] : skeleton.offsets[e + 1]]] = GROUND
        degree = np.bincount(skeleton.edges.ravel(), minlength=len(skeleton.xy))
        tips = skeleton.xy[skeleton.edges[spurs]][degree[skeleton.edges[spurs]] == 1]
        columns, rows = np.rint(tips).astype(int).T
        states[rows, columns] = GROUND
        pixels = rethin(states, pixels, ~no_end, SIMPLE)


def _spurs(skeleton: _Skeleton, distance: Float32Array, reach: float) -> IntArray:
    """Return the edges to drop in one round."""
    degree = np.bincount(skeleton.edges.ravel(), minlength=len(skeleton.xy))
    is_tip = (degree == 1) & ~skeleton.is_open
    tips = is_tip[skeleton.edges]
    columns, rows = np.rint(skeleton.xy).astype(int).T
    foot = np.where(tips[:, 0], skeleton.edges[:, 1], skeleton.edges[:, 0])
    excess = skeleton.lengths() - distance[rows, columns][foot]
    short = np.flatnonzero((tips[:, 0] != tips[:, 1]) & (degree[foot] >= 3) & (excess < reach))
    budget = degree - 2
    drop = []
    for e in short[np.argsort(excess[short], kind="stable")]:
        if budget[foot[e]] > 0:
            budget[foot[e]] -= 1
            drop.append(e)
    return np.array(drop, np.int64)


def _to_graph(
    skeleton: _Skeleton, distance: Float32Array, factor: int, width: float, options: VectorizeOptions
) -> tuple[RoadGraph, BoolArray]:
    """Smooth the chains and take them to the query plane; `width` in reduced pixels."""
    edges, xy, is_open = skeleton.edges, skeleton.xy, skeleton.is_open
    passes = max(1, round(2.0 * (options.smoothing_widths * width) ** 2))  # each pass adds a variance of 1/2
    spacing = max(1, round(options.vertex_spacing_px / factor))
    coords, offsets = smooth_chains(
        distance, skeleton.chain, skeleton.offsets, xy[edges[:, 0]], xy[edges[:, 1]], passes, spacing
    )
    coords, xy = _to_plane(coords, factor), _to_plane(xy, factor)
    keep = skeleton.lengths() > width  # loops and links shorter than a road is wide are no roads
    keep |= ~is_open[edges].any(axis=1) & (edges[:, 0] != edges[:, 1])
    polylines = [coords[offsets[e] : offsets[e + 1]] for e in np.flatnonzero(keep)]
    return _compact(RoadGraph.from_polylines(xy, edges[keep], polylines), is_open)


def _to_plane(reduced: FloatArray, factor: int) -> FloatArray:
    """Take (column, row) of reduced, ringed pixel centres to the query plane."""
    return np.asarray(pixel_to_plane((reduced - 0.5) * factor))


def _compact(graph: RoadGraph, is_open: BoolArray) -> tuple[RoadGraph, BoolArray]:
    """Drop nodes without edges."""
    used = graph.degree() > 0
    number = np.cumsum(used) - 1
    edges = number[graph.edges].astype(np.int32).reshape(-1, 2)
    return RoadGraph(graph.xy[used], edges, graph.coords, graph.offsets), is_open[used]
