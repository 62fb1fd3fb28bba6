"""How strongly a place is supported, against chance on this very map.

Three kinds of evidence are counted, each once: intersections of the query that meet one of the map with agreeing
branches (those that made the hypothesis left out), road points of the query that lie on a road of the map, and roads of
the map inside the footprint that the query shows. What chance would give is measured at hand: the same query is laid
over the same map at many shifted positions, and the best of those is the null. In a city of equal blocks a shift by one
block fits almost as well, and then even a good fit is weak evidence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.point_matching import count_matches, match_all
from roadgeo.kernels.roads import backward_agreement, forward_distances, shares_near_roads
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene

__all__ = [
    "Agreement",
    "VerifyOptions",
    "agreement",
    "chance_agreement",
    "least_chance",
    "log10_odds",
    "map_agreement",
    "tolerance_m",
]

#: So many places tell what chance reaches at least elsewhere on the map.
_ENOUGH_PLACES = 4
_OPEN_GROUND = (0.05, 0.2, 0.05)


@dataclass(frozen=True)
class VerifyOptions:
    """Tolerances and the null model.

    Attributes
    ----------
    map_sigma_m : float
        Usual distance between a mapped road and the road.
    pixel_sigma_px : float
        Usual error of a traced road in pixels.
    n_shifts : int
        Shifted positions of the null model.
    n_anchors : int
        So many intersections of the map, nearest to the middle of the frame, are also shifted onto those around them,
        at most `n_shifts` times: in a lattice only shifts by whole blocks fit as well as the place itself, and a spiral
        misses most of them.
    saturation : float
        However many intersections or roads agree, they count as fewer than so many independent trials: chance varies
        from place to place by more than a binomial law allows, and no number of trials helps against that.
    least_rates : (float, float, float)
        At the true place at least so much agrees, of intersections, of the query's roads and of the map's; of worse
        masks a little evidence is lost. Where a piece of a mask fits and the rest does not, that tells against it.
        Of 511 searches in eight cities for masks without a place, none scored above 0.8 with these and `saturation`.
    statement_m : float
        So much of the map's roads is one independent statement, if they are fewer than those of the query. At 328 right
        places of masks of all kinds the map had 62 m and more of road for each statement of the query; at a wrong one,
        a frame of 180 m that a mask of main roads was laid on, 11 m.
    least_won : float
        Where less of the query's roads agree than `least_rates` says, so much of all roads must lie where most of them
        agree, of the frame cut into sixteenths: a place that loses more is none, however well the rest fits. At the 8
        of 1,142 right places where that was asked it is 0.55 and more; at a wrong one that had 10^8, 0.47.
    promising : float
        Log10 odds that a place must reach against the least chance seen so far, raised as far as they may be, before a
        null of its own is measured.
        They are an upper bound: below 1 a place is neither located (3.5) nor within the margin (2.0) of one that is.
    plain : float
        Where so much of the query's roads and of the map's agrees at first sight, chance is measured wholly at once.
    finer : tuple of float
        Shares of the tolerance within which roads and intersections are compared as well (see `exactness`).
    most_raised : float
        That what agrees does so exactly raises log10 odds by no more. In a lattice blocks differ by metres: a place
        that was fitted to them agrees more exactly than its shifted copies, wherever it lies (a mask of Chicago that
        was turned over: 0.4, and 22 within a third of the tolerance).
    whole_rates, whole_statement_m : (float, float, float), float
        As `least_rates` and `statement_m`, of a whole mask: one that shows nearly all that the map shows, and little
        else (see `exactness`).
    least_whole : float
        Where less of the query's roads or of the map's agree within the finest tolerance, the mask is not whole. At
        the best 1,809 wrong places of 305 masks 6 had more; at 100 of 108 right ones of few intersections or half of
        the frame it is so.
    foreground : float
        Of a steep view the ground whose pixels are at most so many times coarser than at the middle is also compared
        with the map by itself (see `foreground`).
    """

    map_sigma_m: float = 1.8
    pixel_sigma_px: float = 1.0
    max_turn_deg: float = 25.0
    ray_tolerance_deg: float = 25.0
    backward_step_m: float = 12.0
    shift_m: tuple[float, float] = (30.0, 320.0)
    n_shifts: int = 150
    n_null_points: int = 150
    n_anchors: int = 3
    saturation: float = 250.0
    statement_m: float = 50.0
    least_rates: tuple[float, float, float] = (0.2, 0.5, 0.5)
    least_won: float = 0.5
    promising: float = 1.0
    plain: float = 0.8
    finer: tuple[float, ...] = (0.6, 0.35)
    most_raised: float = 1.5
    whole_rates: tuple[float, float, float] = (0.2, 0.85, 0.85)
    whole_statement_m: float = 25.0
    least_whole: float = 0.65
    foreground: float = 1.6

    def within(self, share: float) -> VerifyOptions:
        """Return the options with a share of the tolerance."""
        return replace(self, map_sigma_m=share * self.map_sigma_m, pixel_sigma_px=share * self.pixel_sigma_px)

    @property
    def ray_cos(self) -> float:
        """Cosine of the angle within which branches agree."""
        return math.cos(math.radians(self.ray_tolerance_deg))


@dataclass(frozen=True)
class Agreement:
    """Hits and trials of the three kinds of evidence."""

    matched: int
    tested: int
    forward: float
    backward: float
    n_seen: int

    @property
    def rate(self) -> float:
        """Share of intersections matched."""
        return self.matched / max(self.tested, 1)

    @property
    def mean(self) -> float:
        """Mean of the shares of intersections, of the query's roads and of the map's roads that agree."""
        return (self.rate + self.forward + self.backward) / 3


def tolerance_m(gsd_m: float, options: VerifyOptions) -> float:
    """Three standard deviations of a road's place, map and mask together, in metres."""
    return 3.0 * math.hypot(options.map_sigma_m, options.pixel_sigma_px * gsd_m)


def _bounds(matrix: FloatArray, scene: Scene) -> FloatArray:
    ground = Homography(matrix).everywhere(scene.corners)
    return np.concatenate([ground.min(axis=0), ground.max(axis=0)])


def agreement(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    gsd_m: float,
    seeds: IntArray,
    options: VerifyOptions,
) -> tuple[Agreement, IntArray, FloatArray]:
    """Compare query and map under `matrix`.

    `seeds` are query intersections that made the hypothesis: they are matched but not counted.

    Returns
    -------
    Agreement
    matched : (N,) int64
        Map intersection of each query intersection, or -1.
    distance : (N,) float64
        Metres between them.
    """
    tolerance = tolerance_m(gsd_m, options)
    found = scene.intersections
    matched = np.empty(len(found), np.int64)
    distance = np.empty(len(found))
    match_all(
        matrix, found.xy, scene.branches, 1.5 * tolerance, options.ray_cos, 0.0, 0.0, True,
        index.point_buckets, matched, distance,
    )  # fmt: skip
    counted = np.ones(len(found), bool)
    counted[seeds] = False
    out = np.empty(len(scene.points))
    min_cos = math.cos(math.radians(options.max_turn_deg))
    roads = index.road_buckets
    forward_distances(matrix, scene.points, scene.directions, tolerance, min_cos, 0.0, 0.0, roads, out)
    forward = float(np.average(np.isfinite(out), weights=scene.weights)) if scene.weights.any() else 0.0
    seen, shown = map_agreement(matrix, scene, index, gsd_m, options)
    result = Agreement(
        int((matched[counted] >= 0).sum()), int(counted.sum()),
        forward, shown / max(seen, 1), seen,
    )  # fmt: skip
    return result, matched, distance


def map_agreement(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, gsd_m: float, options: VerifyOptions
) -> tuple[int, int]:
    """Return how many points of the map's roads lie where the scene is observed, and how many of them it shows."""
    return backward_agreement(
        np.asarray(np.linalg.inv(matrix), float), _bounds(matrix, scene), options.backward_step_m,
        tolerance_m(gsd_m, options), 0.0, 0.0, index.road_buckets, scene.field, scene.field_scale, scene.observed,
    )  # fmt: skip


def chance_agreement(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    gsd_m: float,
    options: VerifyOptions,
    every: int = 1,
    n_best: int = 1,
    near: tuple[float, float, float] | None = None,
) -> tuple[float, float, float]:
    """Return the rates (intersections, forward, backward) that the best shifted positions reach.

    Shifts lie on a sunflower spiral between the two radii of `shift_m`, so that all directions and distances are met
    evenly, and where intersections of the map come to lie on others, unless that takes the middle of the frame out of
    the circle `near` = (x, y, radius), plane metres. Of only `every` n-th of them the best cannot be better than of
    all: that is a quick lower bound. Of a place that nobody chose by this query the best of all shifts is too hard a
    rival: the mean of the `n_best` best is taken.
    """
    tolerance = tolerance_m(gsd_m, options)
    found = scene.intersections
    thin = max(1, len(scene.points) // options.n_null_points)
    points, directions, weights = (
        np.ascontiguousarray(array[::thin]) for array in (scene.points, scene.directions, scene.weights)
    )
    min_cos = math.cos(math.radians(options.max_turn_deg))
    roads = index.road_buckets
    inverse, bounds = np.asarray(np.linalg.inv(matrix), float), _bounds(matrix, scene)
    options = _with_shifts_beyond(tolerance, options)
    shifts = np.concatenate((_spiral(options), _onto_neighbours(matrix, scene, index, options, near)))
    shifts = np.ascontiguousarray(shifts[::every])
    rates = np.empty((len(shifts), 3))
    counts = np.empty(len(shifts), np.int64)
    count_matches(
        matrix, found.xy, scene.branches, 1.5 * tolerance, options.ray_cos, shifts,
        index.point_buckets, counts,
    )  # fmt: skip
    rates[:, 0] = counts / max(len(found), 1)
    shares = np.empty(len(shifts))
    shares_near_roads(matrix, points, directions, weights, tolerance, min_cos, shifts, roads, shares)
    rates[:, 1] = shares
    best = np.argsort(-rates[:, 1])[: 12 if n_best == 1 else 4 * n_best]
    for i in best:
        dx, dy = shifts[i]
        seen, shown = backward_agreement(
            inverse, bounds, 2 * options.backward_step_m, tolerance, dx, dy, roads,
            scene.field, scene.field_scale, scene.observed,
        )  # fmt: skip
        rates[i, 2] = shown / max(seen, 1)
    return _mean_of_best(rates[:, 0], n_best), _mean_of_best(rates[:, 1], n_best), _mean_of_best(rates[best, 2], n_best)


def least_chance(chances: Sequence[FloatArray]) -> FloatArray:
    """Return the least rates (3,) that chance reached at places seen before: what is no place against these is none.

    A few places say little of others: before there are enough it is a guess, of open ground.
    """
    return np.asarray(np.min(chances, axis=0)) if len(chances) >= _ENOUGH_PLACES else np.array(_OPEN_GROUND)


def _mean_of_best(rates: FloatArray, count: int) -> float:
    return float(rates.max()) if count == 1 else float(np.sort(rates)[-count:].mean())


def _with_shifts_beyond(tolerance: float, options: VerifyOptions) -> VerifyOptions:
    """Return the options with shifts that are no shorter than three times what roads may be apart, and agree.

    Where a pixel is 10 m, those within 30 m are the place itself: all of its roads agree there, too.
    """
    low, high = options.shift_m
    wider = max(1.0, 3.0 * tolerance / low)
    return replace(options, shift_m=(wider * low, wider * high))


def _spiral(options: VerifyOptions) -> FloatArray:
    """Return shifts (n_shifts, 2) in metres on a sunflower spiral: all directions and distances are met evenly."""
    k = np.arange(options.n_shifts)
    low, high = options.shift_m
    radius = np.sqrt(low**2 + (high**2 - low**2) * (k + 0.5) / options.n_shifts)
    angle = k * math.pi * (3.0 - math.sqrt(5.0))
    return np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1)


def _onto_neighbours(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    options: VerifyOptions,
    within: tuple[float, float, float] | None,
) -> FloatArray:
    """Return shifts (M, 2) in metres that lay an intersection of the map near the frame's middle on others around it.

    In a lattice only a shift by whole blocks fits as well as the place itself.
    """
    low, high = options.shift_m
    middle = Homography(matrix)(scene.center)
    near = index.within(middle, 2.0 * high)
    if not len(near):
        return np.empty((0, 2))
    anchors = near[np.argsort(((near - middle) ** 2).sum(axis=1))[: options.n_anchors]]
    shifts = (near - anchors[:, None]).reshape(-1, 2)
    length = np.hypot(*shifts.T)
    possible = (length > low) & (length < high)
    if within is not None:
        possible &= np.hypot(*(middle + shifts - within[:2]).T) <= within[2]
    shifts, length = shifts[possible], length[possible]
    return np.asarray(shifts[np.argsort(length)[: options.n_shifts]])


def _information(rate: float, chance: float, least: float) -> float:
    """Return the log-likelihood ratio in nats per trial of a rate: the true place against chance.

    At the true place the rate is what it is here, but at least `least`; the ratio is negative where the rate is below
    that of chance.
    """
    # Rates and chance are bounded alike: what agrees wholly, where chance agrees wholly, tells nothing.
    rate, chance = (min(max(share, 0.02), 0.98) for share in (rate, chance))
    nats = math.copysign(_divergence(rate, chance), rate - chance)
    return nats - _divergence(rate, max(rate, least))


def _divergence(rate: float, expected: float) -> float:
    """Return the Kullback-Leibler divergence of two rates, in nats per trial."""
    return rate * math.log(rate / expected) + (1.0 - rate) * math.log((1.0 - rate) / (1.0 - expected))


def log10_odds(
    found: Agreement, chance: Sequence[float] | FloatArray, n_roads: float, n_candidates: int, options: VerifyOptions
) -> float:
    """Log10 odds of a place against chance, corrected for the candidates tried.

    Log-likelihood ratios of the three rates, the true place against chance, times the number of independent trials,
    less the logarithm of the number of places tried.
    """

    def independent(trials: float) -> float:
        return trials / (1.0 + trials / options.saturation)

    rates = (found.rate, found.forward, found.backward)
    intersections, forward, backward = map(_information, rates, chance, options.least_rates)
    nats = independent(found.tested) * intersections
    # Forward and backward agreement are two views of the same roads: each counts half. In favour of a place the map
    # states no more than it has roads in the frame: a few that meet some of the many roads of a mask are no proof.
    n_shown = found.n_seen * options.backward_step_m / options.statement_m if backward > 0.0 else n_roads
    nats += independent(0.5 * n_roads) * forward + independent(0.5 * min(n_roads, n_shown)) * backward
    return (nats - math.log(max(n_candidates, 1))) / math.log(10.0)
