"""From a road mask to a road graph: clean, thin, trace, prune.

All lengths scale with the mask's own road width, so that limits hold for masks of any resolution. Wide roads are
thinned on a grid reduced to roads a few pixels wide; centre lines are then placed between its pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask, pixel_to_plane
from roadgeo.kernels.thinning import GROUND, ROAD, SOLID, shallow_first, thin
from roadgeo.kernels.tracing import smooth_chains, trace
from roadgeo.roads.graph import RoadGraph

__all__ = ["Vectorization", "road_width", "vectorize", "width_by_area"]

#: Bands of rows that `width_by_area` looks at first, and how many road pixels they must hold.
_BAND_ROWS, _BAND_STEP, _BAND_MIN_ROAD, _MAX_BAND_PIXELS = 48, 192, 2000, 1 << 24

#: Streets run together where the width by area exceeds that by length by the first factor; the second is usual.
_RUN_TOGETHER, _USUALLY_WIDER = 1.5, 1.16
#: Specks are less deep, pixels.
_SPECK_DEPTH = 3

_MAX_DEPTH = 1000  # of a road, pixels; the limit of the distance transform
_STRIP_PIXELS = 1 << 24  # large masks are processed in strips of this size

#: Rays in the fan before a free end (an odd number), and how many of their pixels may touch the end itself.
_BENDS, _NEAR = 11, 2

_MAX_ROUNDS = 3  # of pruning; later ones find too little for their time

#: Wide roads are reduced to about this width before thinning; larger masks further, at some loss: memory is bounded.
_WORKING_WIDTH_PX, _MAX_WORKING_PIXELS = 6.0, 64_000_000
#: A mask is noise and is refused where its outlines have more corners, before it is cleaned: real masks have up to 11
#: for a thousand pixels, 0.7 million where they are as large as can be. So it is where it falls into more pieces of
#: road: time and memory are bounded.
_MAX_CORNERS, _MAX_PIECES = 3_000_000, 300_000
#: And where roads of the lines' length and width would cover more of the frame: a dense town's roads cover 0.16.
_MAX_COVER = 1.0
#: Road widths: gaps up to this are closed, threads up to this are cut.
_CLOSING, _OPENING = 0.35, 0.3
#: Squared road widths: smaller holes are filled, smaller pieces are dropped.
_HOLE, _SPECK = 1.2, 1.0
#: Road widths: free ends are dropped that reach less beyond the edge of the road they leave, and roads that touch no
#: other and are shorter.
_SPUR, _PIECE = 1.3, 2.0
#: A road that ends, and points at another across a gap up to this number of road widths, is joined to it; it may bend
#: so far from its own direction to get there.
_BRIDGE, _BRIDGE_DEG = 1.0, 35.0
#: Road widths: so near a junction a skeleton is bent, and the road is drawn straight; standard deviation of the
#: smoothing along a road.
_BENT, _SMOOTHING = 0.4, 0.4
#: Distance between the vertices of a road.
_VERTEX_SPACING_PX = 2.0


@dataclass(frozen=True)
class Vectorization:
    """The roads traced from a mask.

    Attributes
    ----------
    graph : RoadGraph
        In the query plane (see `geometry.mask`), pixels, N nodes.
    road_width_px : float
        Median road width.
    is_open : (N,) bool
        Nodes where a road leaves the frame or the observed ground: the view ends there, not the road.
    """

    graph: RoadGraph
    road_width_px: float
    is_open: BoolArray


def vectorize(mask: RoadMask) -> Vectorization:
    """Trace the centre lines of a mask's roads.

    Parameters
    ----------
    mask : RoadMask

    Returns
    -------
    Vectorization

    Raises
    ------
    MaskError
        When the mask shows no road.
    """
    width_px = road_width(mask)
    crowded = np.ceil(np.sqrt(mask.roads.size / _MAX_WORKING_PIXELS))
    # Nothing wider than the frame is a road; a grid much coarser than the frame would be filled up to whole cells.
    factor = int(max(min(round(width_px / _WORKING_WIDTH_PX), *mask.shape), crowded, 1))
    width = max(width_px / factor, 1.0)
    states = _reduce(mask, factor, min(0.5, 0.45 * width_px / factor))
    _refuse_corners(states, mask.name or "mask")
    states = _clean(states, width)
    distance = cv2.distanceTransform((states != GROUND).view(np.uint8), cv2.DIST_L2, 5)
    skeleton = _skeletonize(states, distance, width)
    _refuse_noise(skeleton, width, states.size, mask.name or "mask")
    if len(skeleton.edges) == 0:
        raise MaskError(f"{mask.name or 'mask'}: no road is left after cleaning; expected roads as non-zero pixels")
    graph, is_open = _to_graph(skeleton, distance, factor, width)
    return Vectorization(graph, width_px, is_open)


def _refuse_corners(states: AnyArray, name: str) -> None:
    """Refuse what has outlines without number before they are walked along: each has a corner at its upper left."""
    n_corners = 0
    rows = max(_STRIP_PIXELS // states.shape[1], 2)
    for top in range(0, len(states) - 1, rows):
        roads = states[top : top + rows + 1] != GROUND
        here, left, above = roads[1:, 1:], roads[1:, :-1], roads[:-1, 1:]
        n_corners += int(np.count_nonzero((here != left) & (here != above)))
    if n_corners > _MAX_CORNERS:
        raise MaskError(
            f"{name}: its roads have {n_corners:,} corners, expected at most {_MAX_CORNERS:,}: this looks like "
            "noise; smooth it before it is thresholded, or reduce it"
        )


def _refuse_noise(skeleton: _Skeleton, width: float, area: int, name: str) -> None:
    """Refuse lines that cannot be roads, before all slow steps: hatching, halftones, noise."""
    n_pieces, covered = len(skeleton.edges), float(skeleton.lengths.sum()) * width / area
    counted = f"{n_pieces:,} pieces of road, expected at most {_MAX_PIECES:,}"
    if covered > _MAX_COVER:
        counted = f"{n_pieces:,} pieces of road that would cover {covered:.0%} of the frame"
    elif n_pieces <= _MAX_PIECES:
        return
    raise MaskError(
        f"{name}: falls into {counted}: this looks like noise; smooth it before it is thresholded, or reduce it"
    )


def road_width(mask: RoadMask) -> float:
    """Estimate the usual road width of a mask in pixels: by area (see `width_by_area`).

    Where wide streets run together over more ground than all distinct ones cover, as towards the horizon of a steep
    view, it is the width of most roads by their length.

    Raises
    ------
    MaskError
        When the mask shows no road.
    """
    depths = _sample_depths(mask)
    by_area = _width_by_area(mask, depths)
    if by_area <= _BAND_ROWS / 3:
        return by_area
    by_length = _USUALLY_WIDER * _width_of_half(depths, by_area)
    return by_length if by_area > _RUN_TOGETHER * by_length else by_area


def width_by_area(mask: RoadMask) -> float:
    """Estimate how wide roads are that make up a mask, in pixels: four times the mean depth of a road pixel.

    Depths within a straight road are spread evenly between 0 and half its width. Pixels much deeper than the median
    are no road and count as little as a road can.

    Raises
    ------
    MaskError
        When the mask shows no road.
    """
    return _width_by_area(mask, _sample_depths(mask))


def _width_by_area(mask: RoadMask, depths: IntArray) -> float:
    """Return the result of `width_by_area`, given depths; wide roads are looked at again in a smaller picture."""
    roads, width = mask.roads.view(np.uint8), _width(depths)
    factor = min(int(width / 8), min(roads.shape) // 16)
    if width <= _BAND_ROWS / 3 or factor < 2:
        return max(width, 1.0)
    return float(factor) * width_by_area(RoadMask(_shrink(roads, factor, 0.5).view(np.bool_), name=mask.name))


def _sample_depths(mask: RoadMask) -> IntArray:
    """Return the depths (see `_count_depths`) of a mask's road pixels in some bands, in all where these hold few."""
    roads = mask.roads.view(np.uint8)
    step = max(_BAND_STEP, _BAND_ROWS * roads.size // _MAX_BAND_PIXELS)
    counts = _count_depths(roads, _BAND_ROWS, step)
    if counts.sum() < _BAND_MIN_ROAD:
        rows = max(_STRIP_PIXELS // roads.shape[1], _BAND_ROWS)
        counts = _count_depths(roads, rows, rows)
    if counts.sum() == 0:
        raise MaskError(f"{mask.name or 'mask'}: no road pixel; expected a mask with roads as non-zero pixels")
    return counts


def _count_depths(roads: AnyArray, rows: int, step: int) -> IntArray:
    """Return how many road pixels lie how many eighths of a pixel from their road's edge, in bands of rows."""
    counts = np.zeros(8 * _MAX_DEPTH + 1, np.int64)
    for top in range(0, len(roads), step):
        band = np.ascontiguousarray(roads[top : top + rows])
        # A road's edge lies half a pixel before the centre of the next pixel, or less where it slants.
        depth = cv2.distanceTransform(band, cv2.DIST_L2, 3)[band > 0] - 0.4
        counts += np.bincount((8 * np.minimum(depth, _MAX_DEPTH)).astype(np.int64), minlength=len(counts))
    return counts


def _width(counts: IntArray) -> float:
    """Return the road width that such counts of depths belong to."""
    depth = (np.arange(len(counts)) + 0.25) / 8
    median = depth[np.searchsorted(np.cumsum(counts), counts.sum() / 2)]
    return float(4.0 * (counts @ np.minimum(depth, 2.0 * median + 1.0)) / max(counts.sum(), 1))


def _width_of_half(counts: IntArray, width: float) -> float:
    """Return the width that half of all roads have at most, by length; lines much narrower than `width` are no roads.

    At a depth there are as many pixels as the roads that reach it are long, twice.
    """
    at_depth = counts[: 8 * _MAX_DEPTH].reshape(-1, 8).sum(axis=1)
    first = min(int(width / 16), _SPECK_DEPTH)
    half = at_depth[first : first + 2].max() / 2
    k = first + int(np.argmax(at_depth[first:] < half))
    before, after = at_depth[max(k - 1, 0)], at_depth[k]
    return float(2 * k - 1 + 2 * (before - half) / (before - after)) if before > after else width


def _reduce(mask: RoadMask, factor: int, share: float) -> AnyArray:
    """Return the mask's states (GROUND, ROAD, SOLID) on a grid `factor` times coarser, with a ring of SOLID around.

    A pixel is ROAD where at least `share` of the pixels it stands for are.
    """
    roads = mask.roads.view(np.uint8)
    observed = None if mask.observed is None else mask.observed.view(np.uint8)
    if factor > 1:
        roads = _shrink(roads, factor, share)
        observed = None if observed is None else _shrink(observed, factor, 0.5)
    states = np.full((roads.shape[0] + 2, roads.shape[1] + 2), SOLID, np.uint8)
    states[1:-1, 1:-1] = roads
    if observed is not None:
        states[1:-1, 1:-1][observed == 0] = SOLID
    return states


def _shrink(flags: AnyArray, factor: int, share: float) -> AnyArray:
    """Reduce 0/1 flags: 1 where at least `share` of factor x factor pixels are. Strip by strip, to save memory."""
    height, width = flags.shape
    rows, columns = -(-height // factor), -(-width // factor)
    reduced = np.empty((rows, columns), np.uint8)
    step = max(_STRIP_PIXELS // (width * factor), 1)
    for top in range(0, rows, step):
        strip: AnyArray = flags[top * factor : (top + step) * factor] * np.uint8(254)
        fill = (-len(strip) % factor, columns * factor - width)
        if any(fill):
            strip = cv2.copyMakeBorder(strip, 0, fill[0], 0, fill[1], cv2.BORDER_REPLICATE)
        mean = cv2.resize(strip, (columns, len(strip) // factor), interpolation=cv2.INTER_AREA)
        reduced[top : top + step] = mean >= max(int(254 * share), 1)
    return reduced


def _clean(states: AnyArray, width: float) -> AnyArray:
    """Close gaps, fill holes, drop specks and cut threads."""
    cleaned = (states != GROUND).view(np.uint8)
    cleaned = _morph(cleaned, cv2.MORPH_CLOSE, _CLOSING * width)
    # As a list: finding which hole lies in which piece takes OpenCV time with the square of their number.
    contours, _ = cv2.findContours(cleaned, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    oriented = np.array([cv2.contourArea(contour, True) for contour in contours])
    areas, is_hole = np.abs(oriented), oriented > 0  # pieces run the other way round, or enclose nothing
    small = np.where(is_hole, areas < _HOLE * width**2, areas < _SPECK * width**2)
    for inside, value in ((is_hole, ROAD), (~is_hole, GROUND)):
        chosen = [contours[i] for i in np.flatnonzero(small & inside).tolist()]
        cv2.drawContours(cleaned, chosen, -1, value, cv2.FILLED)
    cleaned = _morph(cleaned, cv2.MORPH_OPEN, _OPENING * width)
    cleaned[states == SOLID] = SOLID
    return cleaned


def _morph(flags: AnyArray, operation: int, diameter: float) -> AnyArray:
    """Open or close with a disc; nothing happens below a diameter of 1.5 px."""
    size = 2 * round(diameter / 2 - 0.25) + 1
    if size < 3:
        return flags
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(flags, operation, disc))


@dataclass(frozen=True)
class _Skeleton:
    """The result of `trace`; see there."""

    xy: FloatArray
    is_open: BoolArray
    edges: Int32Array
    chain: Int32Array
    offsets: IntArray

    @property
    def degree(self) -> IntArray:
        """(N,) chain ends at each node."""
        return np.bincount(self.edges.ravel(), minlength=len(self.xy)).astype(np.int64)

    @property
    def pixel(self) -> tuple[IntArray, IntArray]:
        """(N,) row and column of the pixel nearest to each node."""
        columns, rows = np.rint(self.xy).astype(np.int64).T
        return rows, columns

    @property
    def tips(self) -> BoolArray:
        """(E, 2) whether an end of a chain is a free end."""
        return np.asarray(((self.degree == 1) & ~self.is_open)[self.edges])

    @property
    def lengths(self) -> FloatArray:
        """(E,) straight distance between the nodes or pixels on the way, whichever is longer."""
        a, b = self.xy[self.edges[:, 0]], self.xy[self.edges[:, 1]]
        return np.maximum(np.diff(self.offsets) + 1.0, np.hypot(*(a - b).T))


def _skeletonize(states: AnyArray, distance: Float32Array, width: float) -> _Skeleton:
    """Thin, then prune and bridge until nothing is left to do. `states` is changed; lengths in its pixels."""
    room = np.empty(states.size, np.int32)
    pixels, least_end = shallow_first(states, distance), max(0.25 * width, 1.0)  # of roads half as wide as most
    bridged = False
    for round_ in range(_MAX_ROUNDS + 1):
        pixels = thin(states, distance, pixels, 0.0 if round_ else least_end, round_ == 0)
        skeleton = _Skeleton(*trace(states, pixels, room))
        if round_ == _MAX_ROUNDS or len(skeleton.edges) > _MAX_PIECES:
            break
        drop = _spurs(skeleton, distance, _SPUR * width) | _pieces(skeleton, _PIECE * width)
        _erase(states, skeleton, drop)
        bridges = np.empty(0, np.int32)
        if not bridged and (round_ > 0 or not drop.any()):
            bridges = _bridges(states, distance, skeleton, ~drop, width)
            bridged = True
        if bridged and not drop.any() and len(bridges) == 0:
            break
        pixels = np.concatenate((pixels, bridges))
    return skeleton


def _spurs(skeleton: _Skeleton, distance: Float32Array, reach: float) -> BoolArray:
    """Return (E,) which chains end free less than `reach` beyond the road they leave; two chains stay at a node."""
    tips, degree = skeleton.tips, skeleton.degree
    foot = np.where(tips[:, 0], skeleton.edges[:, 1], skeleton.edges[:, 0])
    excess = skeleton.lengths - distance[skeleton.pixel][foot]
    short = np.flatnonzero((tips[:, 0] != tips[:, 1]) & (degree[foot] >= 3) & (excess < reach))
    short = short[np.lexsort((excess[short], foot[short]))]  # node by node, the shortest first
    rank = np.arange(len(short)) - np.searchsorted(foot[short], foot[short])
    drop = np.zeros(len(tips), np.bool_)
    drop[short[rank < degree[foot[short]] - 2]] = True
    return drop


def _pieces(skeleton: _Skeleton, least: float) -> BoolArray:
    """Return (E,) which chains touch nothing and are shorter than `least`."""
    return np.asarray(skeleton.tips.all(axis=1) & (skeleton.lengths < least))


def _erase(states: AnyArray, skeleton: _Skeleton, drop: BoolArray) -> None:
    """Clear the pixels of (E,) some chains and of their free ends."""
    states.ravel()[skeleton.chain[np.repeat(drop, np.diff(skeleton.offsets))]] = GROUND
    rows, columns = skeleton.pixel
    ends = skeleton.edges[drop][skeleton.tips[drop]]
    states[rows[ends], columns[ends]] = GROUND


def _bridges(
    states: AnyArray,
    distance: Float32Array,
    skeleton: _Skeleton,
    stands: BoolArray,
    width: float,
) -> Int32Array:
    """Return pixels that join free ends of the chains that stand, (E,), to the roads they point at; mark them as ROAD.

    From every free end rays fan out; the shortest (weighed by its bend) that meets another line is taken, if the road
    is not interrupted for longer than allowed on the way.
    """
    flat, stride = states.ravel(), states.shape[1]
    edge, side = np.nonzero(skeleton.tips & (stands & (skeleton.lengths >= width))[:, None])
    tip = skeleton.xy[skeleton.edges[edge, side]]
    at = _fans(states.shape, tip, _headings(skeleton, edge, side, tip, 2.0 * width, stride), width)
    met = cv2.dilate((states == ROAD).view(np.uint8), np.ones((3, 3), np.uint8)).ravel()[at]
    met[flat[at] == SOLID] = SOLID
    met[..., :_NEAR] = GROUND  # the road's own end
    first = np.argmax(met != GROUND, axis=2)[..., None]
    missing = np.take_along_axis(np.cumsum(distance.ravel()[at] == 0, axis=2), first, axis=2)
    good = (np.take_along_axis(met, first, axis=2) == ROAD) & (missing <= _BRIDGE * width + 0.5)
    bend = np.linspace(-1, 1, _BENDS)[:, None]
    cost = np.where(good, (first + 1) * (1 + bend**2), np.inf)[..., 0]
    best = np.argmin(cost, axis=1)
    least = cost[np.arange(len(cost)), best]
    bridges: list[Int32Array] = []
    for i in np.argsort(least)[: np.isfinite(least).sum()]:
        column, row = np.rint(tip[i]).astype(int)
        if np.count_nonzero(states[row - 1 : row + 2, column - 1 : column + 2]) > 2:
            continue  # a bridge from the other side has come
        path = at[i, best[i], : first[i, best[i], 0] + 1]
        path = path[flat[path] == GROUND]
        flat[path] = ROAD
        bridges.append(path)
    return np.concatenate(bridges).astype(np.int32) if bridges else np.empty(0, np.int32)


def _headings(
    skeleton: _Skeleton, edge: IntArray, side: IntArray, tip: FloatArray, length: float, stride: int
) -> FloatArray:
    """Return the directions in which chains run over the last `length` pixels before their free ends."""
    back = np.minimum(np.diff(skeleton.offsets)[edge] - 1, round(length))
    behind = np.where(side == 0, skeleton.offsets[edge] + back, skeleton.offsets[edge + 1] - 1 - back)
    rows, columns = np.divmod(skeleton.chain[behind], stride)
    return np.asarray(np.arctan2(tip[:, 1] - rows, tip[:, 0] - columns))


def _fans(shape: tuple[int, int], tip: FloatArray, heading: FloatArray, width: float) -> IntArray:
    """Return flat indices (tips, bends, steps) of the pixels on rays that fan out from free ends."""
    limit = np.radians(_BRIDGE_DEG)
    steps = np.arange(1, int((_BRIDGE + 1.5) * width) + 3)  # the gap, and half a road at either side
    angle = (heading[:, None] + np.linspace(-limit, limit, _BENDS))[..., None]
    columns = np.rint(tip[:, 0, None, None] + steps * np.cos(angle)).astype(np.int64).clip(0, shape[1] - 1)
    rows = np.rint(tip[:, 1, None, None] + steps * np.sin(angle)).astype(np.int64).clip(0, shape[0] - 1)
    return np.asarray(rows * shape[1] + columns)


def _to_graph(skeleton: _Skeleton, distance: Float32Array, factor: int, width: float) -> tuple[RoadGraph, BoolArray]:
    """Smooth the chains and take them to the query plane; `width` in reduced pixels."""
    skeleton = _part_open_ends(skeleton)
    keep = skeleton.lengths > width  # loops, and links along the frame, that are shorter than a road is wide
    keep |= ~skeleton.is_open[skeleton.edges].any(axis=1) & (skeleton.edges[:, 0] != skeleton.edges[:, 1])
    edges, xy = skeleton.edges, skeleton.xy
    passes = max(1, round(2.0 * (_SMOOTHING * width) ** 2))  # each adds a variance of 1/2
    spacing = max(1, round(_VERTEX_SPACING_PX / factor))
    ends = np.concatenate((xy[edges[:, 0]], xy[edges[:, 1]]), axis=1)
    bent = np.where(skeleton.degree >= 3, round(_BENT * width), 0)
    coords, offsets = smooth_chains(distance, skeleton.chain, skeleton.offsets, ends, bent[edges], passes, spacing)
    coords, xy = _to_plane(coords, factor), _to_plane(xy, factor)
    polylines = [coords[offsets[e] : offsets[e + 1]] for e in np.flatnonzero(keep)]
    used = np.bincount(edges[keep].ravel(), minlength=len(xy)) > 0
    number = np.cumsum(used, dtype=np.int32) - 1
    return RoadGraph.from_polylines(xy[used], number[edges[keep]], polylines), skeleton.is_open[used]


def _part_open_ends(skeleton: _Skeleton) -> _Skeleton:
    """Give every chain that ends at the frame its own node there: roads do not meet at a frame."""
    half_edges = skeleton.edges.ravel()
    at_frame = np.flatnonzero(skeleton.is_open[half_edges])
    apart = half_edges.copy()
    apart[at_frame] = len(skeleton.xy) + np.arange(len(at_frame))
    xy = np.concatenate((skeleton.xy, skeleton.xy[half_edges[at_frame]]))
    is_open = np.concatenate((np.zeros(len(skeleton.xy), bool), np.ones(len(at_frame), bool)))
    return _Skeleton(xy, is_open, apart.reshape(-1, 2), skeleton.chain, skeleton.offsets)


def _to_plane(reduced: FloatArray, factor: int) -> FloatArray:
    """Take (column, row) of reduced, ringed pixel centres to the query plane."""
    return np.asarray(pixel_to_plane((reduced - 0.5) * factor))
