"""Votes of one intersection and the roads around it, against slow twins."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import road_votes as naive

from roadgeo.kernels.road_raster import DIRECTIONS, TILE, Raster
from roadgeo.kernels.road_votes import (
    BLOCK,
    MAX_TURNS,
    NOWHERE,
    TURNS,
    LaidPoints,
    Places,
    RoadPoints,
    Trial,
    chance_rates,
    draw_turns,
    find_turns,
    improve_votes,
    lay_points,
    vote,
)
from roadgeo.roads.intersections import unpack_branches

TOLERANCE = math.radians(20)
TRIAL = Trial(0.6, 3.0)
angles = st.lists(st.floats(-math.pi, math.pi), min_size=2, max_size=5)


def packed(directions, columns=8):
    """Directions of the branches of one intersection as an index keeps them, (1, columns) float32."""
    out = np.zeros((1, columns, 2), np.int8)
    for i, a in enumerate(directions):
        out[0, i] = round(127 * math.cos(a)), round(127 * math.sin(a))
    return unpack_branches(out)


def turns_of(rays, stored):
    room = np.full(MAX_TURNS, np.nan)
    return room[: find_turns(np.asarray(rays, float), stored, 0, TOLERANCE, room)]


class TestFindTurns:
    @given(angles, angles)
    def test_like_the_twin(self, rays, directions):
        stored = packed(directions)
        expected = naive.find_turns(rays, stored[0, : len(directions)].astype(float), TOLERANCE)[:MAX_TURNS]
        found = turns_of(rays, stored)
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


def world(seed, n_places=30):
    """A raster of random words, places on it, and points to test at three scales."""
    rng = np.random.default_rng(seed)
    words = rng.integers(0, 2**16, (5, TILE, TILE), np.uint16)  # half of all bits: many places have a vote
    words[0] = 0
    tile_of = np.array([[0, 1, 2, 0], [3, 4, 0, 1], [1, 2, 3, 4], [0, 1, 4, 2]], np.int32)
    directions = np.concatenate([packed(rng.uniform(-3, 3, 3)) for _ in range(n_places)])
    places = Places(rng.uniform(64, 192, (n_places, 2)), directions, rng.uniform(0.05, 0.2, n_places))
    offsets = rng.uniform(-60, 60, (90, 2))
    scales = np.array([1.0, 2.0, 3.0])
    points = RoadPoints(scales, np.array([0, 40, 40, 90]), offsets, rng.uniform(0, 2 * DIRECTIONS, 90))
    return Raster(tile_of, words, 5.0), places, points, rng.uniform(-3, 3, 3)


def laid(points, cell):
    """The points, turned and scaled beforehand."""
    counts = np.diff(points.starts)
    words = np.full((TURNS, -(-counts.max() // BLOCK) * len(counts) * BLOCK), NOWHERE, np.uint32)
    lay_points(points, cell, words)
    return LaidPoints(points.scales, counts, words)


def expected_votes(raster, places, points, rays, chance, max_turn=9.0):
    out = []
    for j, (x, y) in enumerate(places.cells):
        room = np.empty(MAX_TURNS)
        for turn in room[: find_turns(rays, places.directions, j, TOLERANCE, room)]:
            best = (0.0, None)
            for s, scale in enumerate(points.scales):
                level = int(min(chance[s] * places.density[j], 0.99) * 128)
                rate = min(max((level + 0.5) / 128, 0.03), 0.8 * TRIAL.hit_rate)
                met = naive.laid_hits(points, s, x, y, turn, raster, TURNS)
                if met and abs(turn) <= max_turn:
                    best = max(best, (naive.ratio(met, rate, TRIAL, BLOCK), scale))
            if best[1] is not None:
                out.append((best[0], j, turn, best[1]))
    return sorted(out, reverse=True)


class TestVote:
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("max_turn", [math.pi, 0.8])
    def test_like_the_twin(self, seed, max_turn):
        raster, places, points, rays = world(seed, 300)
        chance = np.array([1.0, 2.0, 0.5])
        expected = expected_votes(raster, places, points, rays, chance, max_turn)
        assert len(expected) > 6  # more than are kept
        found = np.empty((len(expected) // 2 + 1, 5))
        everywhere = np.arange(len(places.cells))
        kept, tried, ready = 0, 0, laid(points, raster.cell)
        for some in (everywhere[:11], everywhere[11:]):  # a part of the map after the other
            kept, n = vote(some, rays, TOLERANCE, max_turn, ready, places, raster, chance, TRIAL, found, kept)
            tried += n
        assert kept == min(len(found), len(expected))
        assert tried >= len(expected)
        assert max_turn < 3 or tried == sum(len(turns_of(rays, places.directions[j : j + 1])) for j in everywhere)
        best = found[np.argsort(-found[:kept, 3])]
        assert np.allclose(best[:, 3], [e[0] for e in expected[:kept]])
        known = {(j, round(turn, 9)): (ratio, scale) for ratio, j, turn, scale in expected}
        for j, turn, scale, ratio, _ in best:
            assert (ratio, scale) == pytest.approx(known[int(j), round(turn, 9)])

    def test_points_are_laid_where_they_lie(self):
        """Within the steps of the turn and of a place: half of 1/128 of a turn, half of 1/8 of a cell."""
        raster, _, points, _ = world(8)
        ready = laid(points, raster.cell)
        for k, turn in enumerate(2 * math.pi * np.arange(TURNS) / TURNS):
            for s, scale in enumerate(points.scales):
                for q, i in enumerate(range(points.starts[s], points.starts[s + 1])):
                    word = int(ready.words[k, (q // BLOCK * len(points.scales) + s) * BLOCK + q % BLOCK])
                    at = np.array([word & 2047, word >> 11 & 2047]) / 8 - TILE
                    turned = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
                    assert np.abs(at - turned @ points.offsets[i] * scale / raster.cell).max() < 0.063
                    assert word >> 22 == math.floor(points.angles[i] + turn * DIRECTIONS / math.pi) % DIRECTIONS

    def test_improving_looks_at_all_steps(self):
        raster, places, points, _ = world(5)
        votes = np.array([[3, 0.4, 1.0, -5.0, 0.1], [7, -1.0, 2.9, 2.0, 0.2]])
        turns, factors = np.array([-0.1, 0.0, 0.1]), np.array([0.9, 1.0])
        before = votes.copy()
        improve_votes(votes, turns, factors, points, places, raster, TRIAL)
        for was, now in zip(before, votes, strict=True):
            x, y = places.cells[int(was[0])]
            s = int(np.argmin(np.abs(np.log(points.scales / was[2]))))
            ratios = {}
            for turn in was[1] + turns:
                for scale in was[2] * factors:
                    met = naive.hits(points, s, x, y, turn, scale, raster)
                    ratios[turn, scale] = naive.ratio(met, was[4], Trial(TRIAL.hit_rate, 1e9), 6)
            assert now[3] == pytest.approx(max(ratios.values()))
            assert ratios[now[1], now[2]] == pytest.approx(now[3])

    @pytest.mark.parametrize("most", [5, 400])
    def test_draws_like_the_twin(self, most):
        _, places, _, rays = world(7, 300)
        rng = np.random.default_rng(1)
        candidates, draws = rng.permutation(300), rng.random(300)
        sample, turns = np.empty(most, np.int64), np.empty(most)
        n = draw_turns(candidates, draws, rays, TOLERANCE, places, sample, turns)
        expected = naive.draw_turns(candidates, draws, rays, TOLERANCE, places.directions, most)
        assert n == len(expected) == min(most, n)
        assert sample[:n].tolist() == [j for j, _ in expected]
        assert np.allclose(np.cos(turns[:n]), np.cos([turn for _, turn in expected]))

    def test_chance_is_the_share_over_the_density(self):
        raster, places, points, _ = world(6)
        sample, turns = np.array([2, 9, 9]), np.array([0.1, -2.0, 1.0])
        out = np.empty(3)
        chance_rates(sample, turns, points, places, raster, out)
        for s in (0, 2):
            shares = [
                np.mean(naive.hits(points, s, *places.cells[j], turn, points.scales[s], raster)) / places.density[j]
                for j, turn in zip(sample, turns, strict=True)
            ]
            assert out[s] == pytest.approx(np.mean(shares))
        assert out[1] == 0.0
