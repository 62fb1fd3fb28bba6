"""Hypotheses from pairs of neighbouring intersections, a second source beside the triples of `estimator.Sweep`.

A pair proposes an affine map, not the homography of eq. 9, which hangs on four tangents without redundancy: on training
masks (`noisy`; pairs whose tangents fit an affine map) the upper quartile of the errors at the pair's neighbours is
30 % of their distance with eq. 9, and 13 % with the affine map.

Not among `MatchOptions.sweeps` unless asked for: after the triples, pairs found 3 more of 108 training queries and no
false place, but refusals took 32 % longer on average and 54 % in the median; in place of half the second sweep of
triples they found 2 fewer of 180, and before the triples none more, at four times the median time. For rare is mostly
wrong: of the rarest eighth of the pairs of `noisy` masks 2 % are right, of the commonest quarter 38 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from roadgeo._arrays import FloatArray, Int32Array
from roadgeo.kernels.neighbour_pairs import count_pairs, find_pairs, list_neighbour_pairs
from roadgeo.matching.index import ReferenceIndex, unpack_tangents
from roadgeo.matching.scene import Scene
from roadgeo.matching.triples import Proposals

__all__ = ["PairSweep"]


@dataclass(frozen=True)
class PairSweep:
    """One pass over the query's pairs of neighbouring intersections.

    Attributes
    ----------
    n_neighbours : int
        Neighbours of an intersection that form pairs with it.
    min_line_angle_deg : float
        Least angle between a tangent and the connecting line (eq. 7).
    angle_sigma_deg, max_angle_deg : float
        Standard deviation of a tangent, and the greatest root of the summed squared errors of four.
    ray_tolerance_deg : float
        Within which branches agree.
    reach_m, reach_share, max_reach_m : float
        How near to an intersection of the map a neighbour must be put: so many metres and this share of its distance.
    min_placed : int
        Neighbours that must be put on intersections.
    max_found, max_proposed : int
        Places kept for one pair, and those of them that place most neighbours and are proposed.
    max_alike : int
        After so many pairs of the map that look like one of the query no further pair is looked up: in sparse queries
        hardly any pair is rare, and looking them up takes seconds.
    n_sampled, overhead : int
        A pair's rarity is the number of pairs alike among so many of the map; its cost is that and the `overhead`.
    max_pairs : int
        Pairs looked up.
    """

    n_neighbours: int = 6
    min_line_angle_deg: float = 12.0
    angle_sigma_deg: float = 5.0
    max_angle_deg: float = 10.0
    ray_tolerance_deg: float = 25.0
    reach_m: float = 8.0
    reach_share: float = 0.15
    max_reach_m: float = 60.0
    min_placed: int = 3
    max_found: int = 5000
    max_proposed: int = 20
    max_alike: int = 150_000
    n_sampled: int = 1000
    overhead: int = 125
    max_pairs: int = 200

    def proposals(
        self, scene: Scene, index: ReferenceIndex, scale: tuple[float, float], min_ratio: float
    ) -> Iterator[Proposals]:
        """Yield the proposals of one pair after another, those first that are likely to be right and rare."""
        found = scene.intersections
        tangents = np.asarray(found.tangents, np.float64)
        min_sine = math.sin(math.radians(self.min_line_angle_deg))
        ends, pairs = _list_pairs(found.xy, tangents, scene.neighbours[:, : self.n_neighbours], min_sine)
        reference, table = _reference_pairs(index, min_sine)
        spread = self._spread(pairs)
        max_error = math.radians(self.max_angle_deg) ** 2
        step = max(1, len(table) // self.n_sampled)
        cost = np.array(
            [count_pairs(pair, width, max_error, table, step) for pair, width in zip(pairs, spread, strict=True)]
        )
        # The rarest are mostly errors: an intersection with more than two tangents is half as likely to be right.
        reliability = 0.5 ** (np.minimum(found.n_tangents, 6)[ends] - 2).sum(axis=1)
        order = np.argsort(-reliability / (cost + self.overhead), kind="stable")
        ids = np.empty((self.max_found, 1 + scene.neighbours.shape[1]), np.int64)
        affine = np.empty((self.max_found, 4))
        placed = np.empty(self.max_found, np.int64)
        n_alike = 0
        for row in order[: self.max_pairs]:
            if n_alike > self.max_alike:
                break
            a, b = (int(end) for end in ends[row])
            n, alike = find_pairs(
                found.xy, scene.branches, scene.neighbours, a, b, pairs[row], spread[row], max_error,
                scale, min_ratio, math.cos(math.radians(self.ray_tolerance_deg)),
                (self.reach_m, self.reach_share, self.max_reach_m), self.min_placed,
                index.xy, index.branches, index.point_starts, index.grid, index.shape, reference, table,
                ids, affine, placed,
            )  # fmt: skip
            n_alike += alike
            best = np.argsort(-placed[:n], kind="stable")[: self.max_proposed]
            yield Proposals(a, ids[best, 0], ids[best, 1:], affine[best], placed[best], 1, len(table), alike)

    def _spread(self, pairs: FloatArray) -> FloatArray:
        """(P,) greatest difference of the last number of a pair from that of its counterpart: two standard deviations.

        From d cot r = -(1 + cot^2 r) dr at each of the four tangents, on both sides.
        """
        cot = pairs[:, :4]
        gap = np.repeat(cot[:, 0::2] - cot[:, 1::2], 2, axis=1)
        sigma = math.radians(self.angle_sigma_deg) * np.sqrt(2.0 * (((1.0 + cot**2) / gap) ** 2).sum(axis=1))
        return np.asarray(np.minimum(2.0 * sigma, 3.0))


def _list_pairs(
    xy: FloatArray, tangents: FloatArray, neighbours: Int32Array, min_sine: float
) -> tuple[Int32Array, FloatArray]:
    """Return the ends (P, 2) and descriptions (P, 5) of all pairs of neighbours."""
    ends = np.empty((neighbours.size, 2), np.int32)
    pairs = np.empty((neighbours.size, 5))
    n = list_neighbour_pairs(xy, tangents, np.ascontiguousarray(neighbours), min_sine, ends, pairs)
    return ends[:n], pairs[:n]


@lru_cache(maxsize=2)
def _reference_pairs(index: ReferenceIndex, min_sine: float) -> tuple[Int32Array, FloatArray]:
    """Describe the map's pairs of neighbours: built when first needed, kept for a batch."""
    tangents = unpack_tangents(index.tangents).astype(np.float64)
    return _list_pairs(index.xy, tangents, index.neighbours, min_sine)
