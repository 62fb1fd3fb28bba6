"""Sources of hypotheses: pairs of neighbours, and several sources in one search."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from naive import neighbour_pairs as naive
from worlds.scenes import Sight, camera, look, mapped, random_network, scene_of

from roadgeo.kernels import neighbour_pairs as kernels
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.index import build_index
from roadgeo.matching.neighbour_pairs import PairSweep
from roadgeo.matching.search import SearchOptions, search

NAN = np.nan
SCALE, MIN_RATIO = (0.1, 10.0), 0.33
TRUTH = camera((2100, 1900), (1000, 1000), 1.0, 10.0, 20.0, 70.0)


@pytest.fixture(scope="module")
def scene(town):
    return scene_of(look(town[0], TRUTH, sight=Sight(0.8, missing=0.05)))


@pytest.fixture(scope="module")
def nothing(scene):
    """The same frame with no intersection in it."""
    found = scene.intersections
    empty = replace(
        found, xy=found.xy[:0], rays=found.rays[:0], tangents=found.tangents[:0], residual=found.residual[:0],
        node=found.node[:0],
    )  # fmt: skip
    return replace(scene, intersections=empty, branches=scene.branches[:0], neighbours=scene.neighbours[:0])


def pairs_of(xy, tangents, neighbours, min_sine=0.2):
    ends, pairs = np.empty((neighbours.size, 2), np.int32), np.empty((neighbours.size, 5))
    n = kernels.list_neighbour_pairs(xy, tangents, np.ascontiguousarray(neighbours), min_sine, ends, pairs)
    return ends[:n], pairs[:n]


class TestDescribePair:
    @pytest.mark.parametrize(
        ("first", "second", "expected"),
        [
            ([np.pi / 4, 3 * np.pi / 4], [np.pi / 4, np.pi / 2], [1, -1, 1, 0, np.log(2)]),
            ([0.0, np.pi / 4, 3 * np.pi / 4], [np.pi / 4, np.pi / 2, NAN], [1, -1, 1, 0, np.log(2)]),
            ([np.pi / 2, np.pi / 2 + 0.1, np.pi / 4], [np.pi / 4, np.pi / 2], [1, -np.tan(0.1), 1, 0, None]),
        ],
        ids=["two", "along the line", "of three the most open"],
    )
    def test_cotangents(self, first, second, expected):
        tangents = np.full((2, 3), NAN)
        tangents[0, : len(first)], tangents[1, : len(second)] = first, second
        out = np.empty(5)
        assert kernels.describe_pair(np.array([[0.0, 0.0], [5.0, 0.0]]), tangents, 0, 1, 0.2, out)
        assert out[:4] == pytest.approx(expected[:4], abs=1e-12)
        assert expected[4] is None or out[4] == pytest.approx(expected[4])

    @pytest.mark.parametrize("tangents", [[], [1.0], [0.05, 1.0], [1.0, 1.1], [0.0, np.pi - 0.01]])
    def test_too_few_tangents(self, tangents):
        both = np.full((2, 3), NAN)
        both[0], both[1, : len(tangents)] = [0.5, 1.5, 2.5], tangents
        assert not kernels.describe_pair(np.array([[0.0, 0.0], [5.0, 0.0]]), both, 0, 1, 0.2, np.empty(5))

    def test_list_against_its_twin(self, scene):
        found = scene.intersections
        tangents = found.tangents.astype(float)
        expected = {
            (a, b): pair
            for a in range(len(found))
            for b in scene.neighbours[a, :6].tolist()
            if b >= 0 and (pair := naive.describe_pair(found.xy, tangents, a, b, 0.2)) is not None
        }
        ends, pairs = pairs_of(found.xy, tangents, scene.neighbours[:, :6])
        assert len(ends) == len(expected) > 100
        for end, pair in zip(ends.tolist(), pairs, strict=True):
            assert pair == pytest.approx(expected[tuple(end)], abs=1e-9)


angles = st.lists(st.floats(0.3, np.pi - 0.3), min_size=2, max_size=2, unique=True)


@settings(deadline=None)
@given(angles, angles, st.floats(0.4, 2.5), st.floats(-1, 1))
def test_fit_pencils_recovers_an_affine_map(first, second, alpha, beta):
    cot = [sorted((1 / np.tan(r) for r in end), reverse=True) for end in (first, second)]
    assume(min(end[0] - end[1] for end in cot) > 0.1)
    query = np.array([*cot[0], *cot[1], 0.0])
    model = np.empty(2)
    assert kernels.fit_pencils(query, alpha * query + beta, model) == pytest.approx(0, abs=1e-9)
    assert model == pytest.approx((alpha, beta), rel=1e-5, abs=1e-5)


def test_fit_pencils_refuses_mirrors():
    query = np.array([3.0, 2.0, -2.0, -3.0, 0.0])
    assert kernels.fit_pencils(query, query[[2, 3, 0, 1, 4]], np.empty(2)) == kernels.MISFIT


@pytest.mark.parametrize(("spread", "max_error"), [(0.3, 0.01), (1.0, 0.1)])
def test_search_against_its_twin(town, scene, spread, max_error):
    index = town[1]
    reference = pairs_of(index.xy, np.where(index.tangents < 0, NAN, index.tangents * np.pi / 32767), index.neighbours)
    ends, pairs = (np.ascontiguousarray(part[::5]) for part in reference)
    found = scene.intersections
    k = scene.neighbours.shape[1]
    mine, described = pairs_of(found.xy, found.tangents.astype(float), scene.neighbours[:, :3])
    total = 0
    for (a, b), pair in list(zip(mine.tolist(), described, strict=True))[::20]:
        alike = [naive.is_alike(pair, other, spread, max_error) for other in pairs]
        assert kernels.count_pairs(pair, spread, max_error, pairs, 3) == sum(alike[::3])
        bounds = (spread, max_error, SCALE, MIN_RATIO, np.cos(np.radians(25)), (8.0, 0.15, 60.0), 2)
        expected = naive.find_pairs(scene, a, b, pair, *bounds, index, ends, pairs)
        ids, affine, placed = np.empty((500, 1 + k), np.int64), np.empty((500, 4)), np.empty(500, np.int64)
        n, n_alike = kernels.find_pairs(
            found.xy, scene.branches, scene.neighbours, a, b, pair, *bounds, index.xy, index.branches,
            index.point_starts, index.grid, index.shape, ends, pairs, ids, affine, placed,
        )  # fmt: skip
        assert n_alike == sum(alike)
        assert ids[:n].tolist() == [[i, *partners] for i, partners, _ in expected]
        assert affine[:n] == pytest.approx(np.array([m.ravel() for *_, m in expected]).reshape(n, 4), rel=1e-6)
        assert placed[:n].tolist() == [sum(p >= 0 for p in partners) for _, partners, _ in expected]
        total += n
    assert total > 3


class TestPairSweep:
    def test_proposes_the_truth(self, town, scene):
        index = town[1]
        right = []
        for proposals in PairSweep().proposals(scene, index, SCALE, MIN_RATIO):
            assert len(proposals.reference) <= PairSweep().max_proposed
            assert (np.diff(proposals.placed) <= 0).all()
            at = mapped(TRUTH, scene.intersections.xy[[proposals.anchor]])
            right.append((np.hypot(*(index.xy[proposals.reference] - at).T) < 8).any())
        assert np.mean(right) > 0.3

    @pytest.mark.parametrize("limit", [{"max_pairs": 3}, {"max_alike": 0}])
    def test_work_is_bounded(self, town, scene, limit):
        rounds = list(PairSweep(**limit).proposals(scene, town[1], SCALE, MIN_RATIO))
        assert len(rounds) == limit.get("max_pairs", 1)

    def test_nothing_to_propose(self, town, nothing):
        assert list(PairSweep().proposals(nothing, town[1], SCALE, MIN_RATIO)) == []


TRIPLES = MatchOptions().sweeps


class Nothing:
    """A source that proposes nothing."""

    def proposals(self, scene, index, scale, min_ratio):
        """No round."""
        return iter(())


class TestSources:
    @pytest.mark.parametrize(
        "sources", [(PairSweep(),), (PairSweep(max_pairs=5), *TRIPLES), (Nothing(), *TRIPLES, PairSweep())]
    )
    def test_any_mixture_finds_the_place(self, town, scene, sources):
        estimator = TripleEstimator(scene, town[1], MatchOptions(sweeps=sources))
        result = search(estimator, SearchOptions(time_limit_s=60.0))
        assert result.stopped == "accepted"
        corners = mapped(result.best.refined.matrix, scene.corners) - mapped(TRUTH, scene.corners)
        assert np.hypot(*corners.T).max() < 6

    def test_pairs_refuse_another_town(self, scene):
        estimator = TripleEstimator(scene, build_index(random_network(5)), MatchOptions(sweeps=(PairSweep(),)))
        result = search(estimator, SearchOptions(time_limit_s=60.0))
        assert result.stopped == "exhausted"
        assert result.score < 3

    def test_no_source(self, town, scene):
        result = search(TripleEstimator(scene, town[1], MatchOptions(sweeps=(Nothing(),))))
        assert (result.best, result.n_rounds, result.stopped) == (None, 0, "exhausted")
