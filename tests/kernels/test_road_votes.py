"""Votes of one intersection and the roads around it, against slow twins."""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import road_votes as naive

from roadgeo.kernels.road_raster import DIRECTIONS, TILE, Raster
from roadgeo.kernels.road_rings import BEARINGS, RINGS, WORDS, draw_rings, mark_rings
from roadgeo.kernels.road_votes import (
    MAX_TURNS,
    WHOLE_TURN,
    Places,
    RoadPoints,
    VoteRates,
    find_turns,
    improve_votes,
    vote,
)

TOLERANCE = math.radians(20)
TRIAL = VoteRates(0.6, 1.2)
angles = st.lists(st.floats(-math.pi, math.pi), min_size=2, max_size=5)


def whole(radians):
    """Angles as kernels take them."""
    return np.array([round(naive.wrapped(a) / (2 * math.pi) * WHOLE_TURN) for a in radians], np.int64)


def packed(directions, columns=8):
    """Directions of the branches of one intersection as an index keeps them: (1, columns) int32, and how many."""
    out = np.zeros((1, columns), np.int32)
    out[0, : len(directions)] = whole(directions).clip(-(2**31), 2**31 - 1)
    return out, np.array([len(directions)])


def turns_of(rays, stored, j=0):
    """Turns in radians."""
    room = np.empty(MAX_TURNS, np.int64)
    found = room[: find_turns(whole(rays), *stored, j, int(whole([TOLERANCE])[0]), room)]
    return found * (2 * math.pi / WHOLE_TURN)


def _any_tie(rays, directions, turns):
    """Whether two branches are equally far from where one should be, or two turns about as far apart as counts."""
    away = sorted(naive.wrapped(d - r) for d in directions for r in rays)
    gaps = [abs(abs(naive.wrapped(a - b)) - 0.17) for a in turns for b in turns if a is not b]
    mirrored = [
        abs(naive.wrapped(a - c) + naive.wrapped(b - c)) < 1e-6 and a != b for a in away for b in away for c in away
    ]
    return any(mirrored) or min(gaps, default=1) < 1e-6


class TestFindTurns:
    @given(angles, angles)
    def test_like_the_twin(self, rays, directions):
        expected = naive.find_turns(rays, directions, TOLERANCE)[:MAX_TURNS]
        near = [
            abs(abs(naive.wrapped(a - b - (c - d))) - TOLERANCE) < 1e-6
            for a in directions for b in rays for c in directions for d in rays
        ]  # fmt: skip
        found = turns_of(rays, packed(directions))
        if any(near) or _any_tie(rays, directions, expected):
            return  # rounding decides
        assert len(found) == len(expected)
        assert np.allclose(np.cos(found), np.cos(expected))
        assert np.allclose(np.sin(found), np.sin(expected))

    @given(angles, st.floats(-math.pi, math.pi))
    def test_a_turned_copy_is_recognised(self, rays, turn):
        # branches so close to another that the mean over pairs may mix them up are not asked for
        gaps = np.abs(np.subtract.outer(rays, rays))[~np.eye(len(rays), dtype=bool)]
        if (np.minimum(gaps, 2 * math.pi - gaps) < 2.2 * TOLERANCE).any():
            return
        found = turns_of(rays, packed([a + turn for a in rays]))
        assert min(abs(naive.wrapped(t - turn)) for t in found) < 0.2

    def test_one_branch_is_not_enough(self):
        assert len(turns_of([0.3], packed([0.3, 2.0]))) == 0
        assert len(turns_of([0.0, 1.0], packed([0.0, 2.0]))) == 0


@cache  # rings drawn by plain Python take most of the time
def world(seed, n_places=30):
    """A raster of random words, places on it, and points to test at three scales."""
    rng = np.random.default_rng(seed)
    words = rng.integers(0, 2**16, (5, TILE, TILE), np.uint16) & rng.integers(0, 2**16, (5, TILE, TILE), np.uint16)
    words &= rng.integers(0, 2**16, (5, TILE, TILE), np.uint16)
    words[0] = 0
    tile_of = np.array([[0, 1, 2, 0], [3, 4, 0, 1], [1, 2, 3, 4], [0, 1, 4, 2]], np.int32)
    branches = [packed(rng.uniform(-3, 3, 3)) for _ in range(n_places)]
    directions, counts = (np.concatenate(parts) for parts in zip(*branches, strict=True))
    cells, rings = rng.uniform(64, 192, (n_places, 2)), np.empty((n_places, WORDS), np.uint64)
    raster = Raster(tile_of, words, 5.0)
    draw_rings(cells, np.arange(n_places), np.geomspace(5, 60, RINGS), raster, rings)
    places = Places(cells, directions, counts, rng.uniform(0.05, 0.2, n_places), rings)
    offsets = rng.uniform(-60, 60, (90, 2))
    scales = np.array([1.0, 2.0, 3.0])
    points = RoadPoints(scales, np.array([0, 40, 40, 90]), offsets, rng.uniform(0, 2 * DIRECTIONS, 90))
    return raster, places, points, rng.uniform(-3, 3, 3)


class TestVote:
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize(("middle", "max_off"), [(0.0, math.pi), (0.0, 0.8), (3.0, 0.8)])
    def test_like_the_twin(self, seed, middle, max_off):
        _, places, _, rays = world(seed, 900)
        asked = range(300 if max_off > 3 else 900)
        rng = np.random.default_rng(seed)
        scales, marked = np.array([1.0, 1.1, 1.2]), np.zeros((3, WORDS), np.uint64)
        n = 150
        mark_rings(
            rng.integers(-2, RINGS, n), rng.uniform(-3, 3, n), rng.integers(0, 2, n), np.zeros(n, int), 0, marked
        )
        marked[1] = 0  # nothing in reach
        expected, tried_all, most_kept = [], 0, 20
        marks = {s: naive.bits_of(marked[s]) for s in (0, 2)}
        for j in asked:
            roads = naive.bits_of(places.rings[j])
            before = min(expected)[0] if len(expected) == most_kept else 0.0
            for turn in turns_of(rays, places[1:3], j):
                if abs(math.remainder(turn - middle, 2 * math.pi)) <= max_off:
                    tried_all += 1
                    back = round(turn / (2 * math.pi) * BEARINGS)
                    at = {s: naive.beyond_chance(points, roads, back, before / 4) for s, points in marks.items()}
                    s = max(at, key=at.get)
                    if at[s] > 0:
                        expected = sorted([*expected, (at[s], j, turn, scales[s])], reverse=True)[:most_kept]
        assert len(expected) == most_kept
        found = np.empty((most_kept, 4))
        tolerance, toward, most = (int(whole([a])[0]) for a in (TOLERANCE, middle, max_off - 1e-9))
        everywhere = np.array(asked)
        with np.errstate(over="ignore"):  # bits are counted by a product of which the uppermost digits count
            kept, tried = vote(everywhere, whole(rays), tolerance, toward, most, scales, marked, 15, places, found)
        assert (kept, tried) == (most_kept, tried_all)
        best = found[np.argsort(-found[:, 3])]
        assert np.allclose(best[:, 3], [e[0] for e in expected])
        known = {(j, round(turn, 6)): (z, scale) for z, j, turn, scale in expected}
        for j, turn, scale, z in best:
            assert (z, scale) == pytest.approx(known[int(j), round(turn, 6)])

    def test_improving_looks_at_all_steps(self):
        raster, places, points, _ = world(5)
        votes = np.array([[3, 0.4, 1.0, -5.0], [7, -1.0, 2.9, 2.0]])
        turns, factors = np.array([-0.1, 0.0, 0.1]), np.array([0.9, 1.0])
        before = votes.copy()
        improve_votes(votes, turns, factors, points, places, raster, TRIAL)
        for was, now in zip(before, votes, strict=True):
            x, y = places.cells[int(was[0])]
            s = int(np.argmin(np.abs(np.log(points.scales / was[2]))))

            def ratio(turn, scale, s=s, x=x, y=y, density=places.density[int(was[0])]):
                met = naive.hits(points, s, x, y, turn, scale, raster)
                return naive.ratio(met, TRIAL.hit_rate, TRIAL.chance * density)

            turn = max(was[1] + turns, key=lambda turn: ratio(turn, was[2]))
            scale = max([was[2], *(was[2] * factors)], key=lambda scale: ratio(turn, scale))
            assert (now[1], now[2]) == (turn, scale)
            assert now[3] == pytest.approx(ratio(turn, scale))
