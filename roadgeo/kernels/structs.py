"""Values that travel together through kernels, as NamedTuples.

Planes are in metres (reference) or pixels, y up (query). See `kernels.buckets` for `grid` and `shape`.
"""

from typing import NamedTuple

from roadgeo.kernels.arrays import (
    Bools1,
    Floats1,
    Floats2,
    Int8s2,
    Int8s3,
    Int32s1,
    Int32s2,
    Ints1,
    Ints2,
    Singles2,
    UInt64s1,
)

__all__ = [
    "AdjustLimits",
    "GrowthLimits",
    "GrowthQuery",
    "Held",
    "Hits",
    "Met",
    "Plane",
    "PointBuckets",
    "PointPairs",
    "RoadBuckets",
    "RoadSamples",
    "TripleLimits",
    "TripleMap",
    "TripleQuery",
]


class RoadBuckets(NamedTuple):
    """The roads of the map (see `kernels.roads`)."""

    segments: Singles2  # (S, 4)
    starts: Int32s1  # (B + 1,)
    ids: Int32s1
    grid: tuple[float, float, float]
    shape: tuple[int, int]


class PointBuckets(NamedTuple):
    """The intersections of the map, sorted by bucket (see `kernels.buckets`)."""

    xy: Floats2  # (N, 2)
    branches: Int8s3  # (N, R, 2), as in `rays_agree`
    starts: Int32s1  # (B + 1,)
    grid: tuple[float, float, float]
    shape: tuple[int, int]


# --- triples ----------------------------------------------------------------------------------------------------------


class TripleQuery(NamedTuple):
    """Intersections whose triples are looked up."""

    xy: Floats2  # (N, 2)
    branches: Int8s3  # (N, R, 2), as in `rays_agree`
    tangents: Singles2  # (N, T) radians, NaN behind the last
    sides: Int8s2  # (N, T), as left by `find_sides`
    neighbours: Int32s2  # (N, K), -1 behind the last


class TripleMap(NamedTuple):
    """Intersections of the map, and the table of their triples' codes."""

    xy: Floats2  # (M, 2)
    branches: Int8s3  # (M, R, 2)
    neighbours: Int32s2  # (M, K)
    starts: Int32s1  # (TABLE + 1,)
    entries: UInt64s1


class TripleLimits(NamedTuple):
    """Limits of a look-up."""

    codes_per_vertex: int
    tolerance: int  # of angles, in units
    min_cos: float  # of the angle between branches
    scale: tuple[float, float]  # least and greatest root of the map's determinant
    min_ratio: float  # least ratio of its singular values


class Hits(NamedTuple):
    """Room for the hits of a look-up."""

    ids: Ints2  # (H, 5): A, slot of b, B, slot of c, C
    affine: Floats2  # (H, 4): the 2 x 2 map, row-major, from query to reference


# --- growth -----------------------------------------------------------------------------------------------------------


class GrowthQuery(NamedTuple):
    """The query as it is grown over from one anchor."""

    xy: Floats2  # (N, 2)
    branches: Int8s3  # (N, R, 2)
    neighbours: Int32s2  # (N, K)
    order: Ints1  # points by distance from the anchor: all of them, or the nearest
    half_size: float  # of the frame, pixels
    anchor: int


class GrowthLimits(NamedTuple):
    """Options of growth."""

    sigma: tuple[float, float]  # standard deviation of a matched intersection: metres of the map, pixels of the query
    radius: tuple[float, float]  # greatest search radius, likewise
    min_cos: float  # as in `rays_agree`
    perspective_sigma: float  # standard deviation of the two perspective parameters, a priori
    hit_rate: float  # share of points that meet a partner in the right place
    chance_rate: float  # and by chance
    patience: float  # nats


# --- adjustment -------------------------------------------------------------------------------------------------------


class Plane(NamedTuple):
    """Normalised coordinates of the reference: metres per unit, and the point (metres) of the normalised (0, 0)."""

    unit: float
    x: float
    y: float


class RoadSamples(NamedTuple):
    """Road points of the query, normalised."""

    xy: Floats2  # (S, 2)
    directions: Floats2  # (S, 2) unit vectors along the road
    cells: Ints1  # (S,) the cell of the frame that each lies in
    weight: float  # weight of a point, relative to an observation of standard deviation `AdjustLimits.sigma_m`
    half_side: float  # half of the frame's longer side: the unit of k1


class PointPairs(NamedTuple):
    """Matched intersections in query and reference, normalised."""

    query: Floats2  # (M, 2)
    reference: Floats2  # (M, 2)
    cells: Ints1  # (M,)
    weight: float


class Held(NamedTuple):
    """Points that hold an adjustment near its start while little else does, normalised."""

    query: Floats2  # (G, 2)
    reference: Floats2  # (G, 2)
    weight: float  # in the first step; half of it in the next, and so on


class Met(NamedTuple):
    """Roads that road points met, in S x n numbers for n parameters."""

    rows: Floats2  # (S, n) derivatives of the points' places across the roads
    residuals: Floats1  # (S,) metres across to the roads, NaN where no road is met
    sigmas: Floats1  # (S,) standard deviations of the residuals
    own: Floats1  # (S,) sigma at a known place, relative to its value in the middle of the frame
    searched: Bools1  # (S,) whether the place was sure enough


class AdjustLimits(NamedTuple):
    """Options of an adjustment.

    Where fewer than `least_share` of a cell's searched points meet a road, they meet it by chance, and the cell
    waits. The iteration ends when no parameter moves by more than `tolerance_m`.

    A pixel that reaches further on the ground shows it less exactly: standard deviations grow with it in tilted frames.
    """

    n_cells: int
    least_share: float
    max_radius: float  # metres, where a pixel reaches no further than in the middle of the frame
    min_cos: float  # as in `nearest_road`
    sigma_m: float  # standard deviation of a road point across the road in the middle of the frame
    map_sigma_m: float  # the map's part of it
    mask_sigma: float  # and the mask's, normalised units of the query
    prior: Floats1  # (9,) weights that hold parameters near zero
    n_iterations: int
    tolerance_m: float
