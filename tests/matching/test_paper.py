"""The paper's matcher: kernels against slow twins, counts against the paper's formulas, scenes with known H."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from naive import paper as naive

from roadgeo.errors import IndexFormatError
from roadgeo.geometry.homography import Homography
from roadgeo.matching import paper
from roadgeo.matching.pairs import PairIndex, TupleOptions, build_pair_index, cross_ratios
from roadgeo.matching.paper import (
    PAPER,
    PairOptions,
    fit_pencils,
    match_pairs,
    query_draws,
    read_options,
    reference_draws,
)
from roadgeo.roads.intersections import MAX_BRANCHES, Intersections

FRAME = np.array([[0, 0], [1000, 0], [1000, -1000], [0, -1000]], float)


def intersections(xy, rays, tangents) -> Intersections:
    def padded(rows):
        return np.array([[*row, *[np.nan] * (MAX_BRANCHES - len(row))] for row in rows], np.float32)

    n = len(xy)
    return Intersections(
        np.array(xy, float).reshape(n, 2),
        padded(rays).reshape(n, MAX_BRANCHES),
        padded(tangents).reshape(n, MAX_BRANCHES),
        np.zeros(n, np.float32),
        np.arange(n, dtype=np.int32),
    )


def random_network(rng, n=300, side=4000.0, gap_deg=25.0) -> Intersections:
    """Intersections at random, 3 to 5 branches on 2 to 4 tangents at least `gap_deg` apart."""
    rays, tangents = [], []
    for _ in range(n):
        n_tangents = rng.choice([2, 3, 4], p=[0.6, 0.3, 0.1])
        free = math.pi - n_tangents * math.radians(gap_deg)
        gaps = rng.dirichlet(np.ones(n_tangents)) * free + math.radians(gap_deg)
        lines = np.sort((rng.uniform(0, math.pi) + np.cumsum(gaps)) % math.pi)
        n_branches = max(3, n_tangents + rng.integers(2))
        tangents.append(lines)
        rays.append(np.sort([*lines, *(lines[: n_branches - n_tangents] - math.pi)]))
    return intersections(rng.uniform(0, side, (n, 2)), rays, tangents)


def camera(rng, center, tilt_deg=0.0, gsd=1.0) -> Homography:
    """Query plane to reference plane for a pinhole camera of any heading over `center`; w > 0 over FRAME."""
    tilt, azimuth, heading = math.radians(tilt_deg), rng.uniform(0, 2 * math.pi), rng.uniform(0, 2 * math.pi)

    def turn(a):
        return np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])

    lean = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    rays = (
        turn(heading) @ turn(azimuth) @ lean @ turn(-azimuth) @ np.array([[1, 0, -500], [0, 1, 500], [0, 0, -1000.0]])
    )
    H = np.diag([1000 * gsd, 1000 * gsd, -1.0]) @ rays
    shift = np.array([[1, 0, center[0]], [0, 1, center[1]], [0, 0, 1]])
    return Homography(shift @ H).facing(np.array([500.0, -500.0]))


def view(reference, homography, rng=None) -> tuple[Intersections, np.ndarray]:
    """What an image sees: the intersections inside FRAME, tangents by the Jacobian, shuffled; and their numbers."""
    back = Homography(np.linalg.inv(homography.matrix))
    mapped = np.column_stack([reference.xy, np.ones(len(reference))]) @ back.matrix.T
    xy = mapped[:, :2] / mapped[:, 2:]
    seen = np.flatnonzero((xy > [0, -1000]).all(axis=1) & (xy < [1000, 0]).all(axis=1))
    if rng is not None:
        seen = rng.permutation(seen)
    J = back.jacobian(reference.xy[seen])
    tangents = reference.tangents[seen].astype(float)
    directions = np.einsum("nij,nrj->nri", J, np.stack([np.cos(tangents), np.sin(tangents)], axis=-1))
    turned = np.sort(np.arctan2(directions[..., 1], directions[..., 0]) % math.pi, axis=1)
    return replace(
        reference,
        xy=xy[seen],
        rays=reference.rays[seen],
        tangents=turned.astype(np.float32),
        residual=reference.residual[seen],
        node=seen.astype(np.int32),
    ), seen


@pytest.fixture(scope="module")
def reference() -> Intersections:
    return random_network(np.random.default_rng(1))


@pytest.fixture(scope="module")
def index(reference) -> PairIndex:
    return build_pair_index(reference, TupleOptions())


def corner_error(match, homography) -> float:
    assert match.homography is not None, match.reason
    return float(np.abs(Homography(match.homography)(FRAME) - homography(FRAME)).max())


# Sampling counts


@pytest.mark.parametrize(
    ("lambda_", "lambda_1", "p_query", "expected"),
    [
        (0.01, 0.05, 0.1, 47),  # log 0.01 / log 0.905 = 46.13
        (0.01, 0.05, 0.01, 483),  # log 0.01 / log 0.9905 = 482.45
        (0.1, 0.5, 0.5, 9),  # log 0.1 / log 0.75 = 8.004
    ],
)
def test_query_draws_follow_equation_16(lambda_, lambda_1, p_query, expected):
    assert query_draws(lambda_, lambda_1, p_query) == expected


@pytest.mark.parametrize(
    ("n_match", "lambda_1", "expected"),
    [(0, 0.05, 0), (1, 0.05, 1), (2, 0.05, 5), (10, 0.05, 29), (10, 0.5, 7)],  # 4.32, 28.43, 6.58
)
def test_reference_draws_follow_equation_15(n_match, lambda_1, expected):
    assert reference_draws(n_match, lambda_1) == expected


# Tuples and their index


def crossing(x, y, *tangents_deg):
    lines = np.radians(sorted(tangents_deg))
    return (x, y), np.sort([*(lines - math.pi), *lines]), lines


@pytest.mark.parametrize(
    ("second", "options", "expected"),
    [
        (crossing(100, 100, 0, 90), PairOptions(), 1),
        (crossing(100, 0, 0, 90), PairOptions(), 0),  # along a street: eq. 7
        (crossing(100, 26, 0, 90), PairOptions(), 0),  # 14.6 degrees off the street
        (crossing(100, 28, 0, 90), PairOptions(), 1),  # 15.6 degrees
        (crossing(100, 100, 45, 90), PairOptions(), 0),  # only the second end is degenerate
        (crossing(100, 100, 90), PairOptions(), 0),  # one tangent cannot carry a homography
        (crossing(100, 100, 0, 90), PairOptions(d_max_m=141), 0),  # eq. 8
        (crossing(100, 100, 0, 90), PairOptions(d_max_m=142), 1),
        (crossing(0, 0, 0, 90), PairOptions(), 0),  # the same place
    ],
)
def test_tuples_pass_equations_7_and_8(second, options, expected):
    index = build_pair_index(intersections(*zip(crossing(0, 0, 0, 90), second, strict=True)), options)
    assert len(index) == expected


def test_types_put_the_lesser_end_first():
    found = intersections(*zip(crossing(0, 0, 0, 60, 120), crossing(100, 100, 0, 90), strict=True))
    index = build_pair_index(found, TupleOptions())
    assert {key: item.pairs.tolist() for key, item in index.tuples.items()} == {
        (16 * 4 + 2) * 256 + 16 * 6 + 3: [[1, 0]]
    }


def test_pairs_match_their_twin(reference, index):
    expected = naive.list_pairs(reference.xy, reference.tangents, 1000.0, math.radians(15))
    assert {frozenset(p) for item in index.tuples.values() for p in item.pairs.tolist()} == expected
    assert len(index) == len(expected)
    for key, entry in index.tuples.items():
        assert (16 * reference.n_branches[entry.pairs] + reference.n_tangents[entry.pairs] == divmod(key, 256)).all()


def test_descriptors_match_their_twin(reference, index):
    for pairs, tree in index.tuples.values():
        if tree is not None:
            expected = naive.describe_pairs(pairs, reference.xy, reference.tangents)
            np.testing.assert_allclose(tree.data, np.log(expected), rtol=1e-5, atol=1e-6)
            assert (tree.data > 0).all()


def test_four_symmetric_lines_are_harmonic():
    assert cross_ratios(np.array([[1.0, 0.0, -1.0]])).tolist() == [[2.0]]


def test_candidates_are_those_within_the_relative_error(reference, index):
    """Equation 6, cross ratio by cross ratio."""
    rng = np.random.default_rng(3)
    query, _ = view(reference, camera(rng, (2000, 2000), 20), rng)
    search = searching(query, index, PairOptions(), rng)
    checked = 0
    for (a, b), key in search.draw_query_tuples()[:60]:
        pairs, tree = index.tuples[key]
        for correspondence in search.correspondences(a, b, key) if tree is not None else []:
            d_c = naive.describe_pairs([correspondence.ends], query.xy, query.tangents)[0]
            expected = pairs[(np.abs(np.exp(tree.data) - d_c) < 0.3 * d_c).all(axis=1)]
            np.testing.assert_array_equal(correspondence.candidates, expected)
            checked += len(expected)
    assert checked > 100


@pytest.mark.parametrize("n", [0, 1])
def test_hardly_any_reference_is_no_place(n):
    few = intersections(*zip(*[crossing(0, 0, 0, 90)][:n], strict=True)) if n else intersections([], [], [])
    query = random_network(np.random.default_rng(3), n=40, side=900.0)
    match = match_pairs(replace(query, xy=query.xy - [0, 950]), build_pair_index(few, TupleOptions()), FRAME)
    assert match.homography is None
    assert match.n_samples == 0
    assert "no such place" in match.reason


# Hypotheses


def searching(query, index, options, rng):
    return paper._Search(query, index, FRAME, options, rng)


def test_matches_are_the_nearest_of_their_type(reference, index):
    rng = np.random.default_rng(2)
    query, _ = view(reference, camera(rng, (2000, 2000), 20), rng)
    H = camera(rng, (1900, 2100), 20).matrix
    for radius in (5.0, 150.0, 1e5):
        search = searching(query, index, PairOptions(inlier_distance_m=radius, one_to_one=False), rng)
        mapped = Homography(H).everywhere(query.xy)
        expected = naive.nearest_of_type(mapped, search.codes, reference.xy, index.codes, radius)
        found = np.full(len(query), -1)
        found[search.matches(H)[:, 0]] = search.matches(H)[:, 1]
        np.testing.assert_array_equal(found, expected)


def test_of_two_that_come_near_one_the_nearer_matches_it(reference, index):
    truth = camera(np.random.default_rng(2), (2000, 2000))
    query, seen = view(reference, truth)
    twice = query.only(np.r_[0, np.arange(len(query))])
    twice.xy[0] += 3.0
    matched = searching(twice, index, PairOptions(), None).matches(truth.matrix)
    np.testing.assert_array_equal(matched, np.column_stack([1 + np.arange(len(seen)), seen]))


@pytest.mark.parametrize("is_last", [False, True])
def test_more_than_the_share_must_match(reference, index, is_last):
    """Whether those that miss are judged first or last."""
    truth = camera(np.random.default_rng(2), (2000, 2000))
    query, _ = view(reference, truth)
    for n in (len(query), len(query) - 1):
        some = query.only(np.arange(n))
        judged = searching(some, index, PairOptions(), None).judges[:: -1 if is_last else 1]
        for lost, row in (((n + 1) // 2, -1), ((n - 1) // 2, 0)):
            xy = some.xy.copy()
            xy[judged[:lost]] += 1e6
            search = searching(replace(some, xy=xy), index, PairOptions(), None)
            assert search.count(truth.matrix[None], search.best)[1] == row


def test_rare_types_come_first_and_equal_ends_are_tried_both_ways(reference, index):
    rng = np.random.default_rng(4)
    search = searching(view(reference, camera(rng, (2000, 2000), 20), rng)[0], index, PairOptions(), rng)
    drawn = search.draw_query_tuples()
    counts = [len(index.tuples[key].pairs) for _, key in drawn]
    assert counts == sorted(counts)
    (a, b), key = next((ends, key) for ends, key in drawn if key == PLAIN)
    assert [way.ends.tolist() for way in search.correspondences(a, b, key)] == [[a, b], [b, a]]


def evaluate(search, correspondence, row, least=-1):
    """The inlier count and homography of one candidate."""
    search.options = replace(search.options, one_to_one=False)
    models = search.models(correspondence, correspondence.candidates[row : row + 1])
    count, _ = search.count(models, least)
    return count, models[0] if len(models) else None


#: Three branches on two tangents, at both ends.
PLAIN = (16 * 3 + 2) * 257


@pytest.mark.parametrize("orders", ["++", "all"])
def test_hypotheses_match_their_twin(reference, index, orders):
    """Tuples with two tangents at each end: the closed form is the direct linear transformation of all five lines."""
    rng = np.random.default_rng(4)
    query, _ = view(reference, camera(rng, (2000, 2000), 20), rng)
    options = PairOptions(orders=orders, inlier_distance_m=60.0)
    search = searching(query, index, options, rng)
    codes = search.codes
    a, b = np.flatnonzero(codes == 16 * 3 + 2)[:2]
    candidates = index.tuples[PLAIN].pairs[:150]
    for correspondence in search.correspondences(a, b, PLAIN)[:: 1 if orders == "++" else 4]:
        expected, models = naive.evaluate_pairs(
            (query.xy, query.tangents, codes),
            correspondence.ends,
            (reference.xy, reference.tangents, index.codes),
            candidates,
            FRAME,
            60.0,
            orders == "++",
        )
        for row in range(len(candidates)):
            count, model = evaluate(search, correspondence, row)
            assert count == expected[row]
            if model is not None:
                model = model / (model[2] @ [*query.xy[correspondence.ends[0]], 1.0])
                np.testing.assert_allclose(model, models[row], rtol=1e-4, atol=1e-6 * np.abs(models[row]).max())
        assert (expected > 0).any()


def test_more_tangents_give_the_least_geometric_error():
    """The fit of a pencil of four lines is the minimum of the Sampson error over (alpha, beta)."""
    from scipy.optimize import minimize

    rng = np.random.default_rng(7)
    r = np.radians([25, 60, 100, 150])
    image = np.arctan2(1, 1.3 / np.tan(r) + 0.2) + rng.normal(0, 0.02, 4)
    query, found = 1 / np.tan(r), 1 / np.tan(image)

    def sampson(p):
        error = found - p[0] * query - p[1]
        return np.sum(error**2 / ((1 + found**2) ** 2 + (p[0] * (1 + query**2)) ** 2))

    fitted = [float(fit_pencil[0]) for fit_pencil in fit_pencils(query, found[None])]
    best = minimize(sampson, (1.0, 0.0), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-15})
    assert sampson(fitted) <= best.fun * 1.01
    np.testing.assert_allclose(fitted, best.x, atol=2e-3)


# Scenes with known H


@pytest.mark.parametrize("tilt_deg", [0, 15, 30])
@pytest.mark.parametrize("seed", range(4))
def test_known_homography_is_recovered(reference, index, tilt_deg, seed):
    rng = np.random.default_rng([seed, tilt_deg])
    truth = camera(rng, (2000, 2000), tilt_deg, gsd=rng.uniform(1.8, 2.5))
    query, seen = view(reference, truth, rng)
    match = match_pairs(query, index, FRAME, seed=seed)
    assert corner_error(match, truth) < 1e-6
    np.testing.assert_array_equal(match.matches, np.column_stack([np.arange(len(seen)), seen]))
    assert match.inlier_ratio == 1.0
    assert np.linalg.det(match.homography) > 0
    assert match.homography[2] @ [500, -500, 1] == pytest.approx(1.0)
    assert match.reason.startswith(f"{len(seen)} of {len(seen)} intersections (100%) match")


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_clutter_are_survived(reference, index, seed):
    rng = np.random.default_rng([seed, 77])
    truth = camera(rng, (2000, 2000), 20, gsd=2.2)
    query, _ = view(reference, truth, rng)
    clutter = random_network(rng, n=len(query) // 4, side=1000.0)
    noisy = intersections(
        np.concatenate([query.xy + rng.normal(0, 0.5, query.xy.shape), clutter.xy - [0, 1000]]),
        [row[np.isfinite(row)] for row in np.concatenate([query.rays, clutter.rays])],
        [
            np.sort((row[np.isfinite(row)] + rng.normal(0, 0.01, np.isfinite(row).sum())) % math.pi)
            for row in np.concatenate([query.tangents, clutter.tangents])
        ],
    )
    match = match_pairs(noisy, index, FRAME, seed=seed)
    assert corner_error(match, truth) < 8.0
    assert 0.5 < match.inlier_ratio < 0.95


@pytest.mark.parametrize("kind", ["mirrored", "horizon", "mirrored horizon"])
def test_unphysical_orders_are_found_on_request_only(kind):
    network = random_network(np.random.default_rng(8), n=120, side=1400.0)
    index = build_pair_index(network, TupleOptions())
    truth = np.diag([1.4, 1.4, 1.0]) @ np.array([[1, 0, 0], [0, 1, 1000], [0, 0, 1.0]])
    if "horizon" in kind:  # between the left third of the frame and the rest
        truth = np.array([[200.0, 0, 0], [0, 200, 100000], [1, 0, -300]])
        network = random_network(np.random.default_rng(8), n=600, side=1400.0)
        index = build_pair_index(replace(network, xy=network.xy - 700), TupleOptions())
        network = replace(network, xy=network.xy - 700)
    if "mirrored" in kind:
        truth = truth @ np.array([[1, 0, 0], [0, -1, -1000], [0, 0, 1.0]])
    query, _ = view(network, Homography(truth), np.random.default_rng(0))
    options = PairOptions(time_limit_s=60, inlier_distance_m=2.0)
    match = match_pairs(query, index, FRAME, replace(options, p_query=0.2))
    assert match.homography is None
    match = match_pairs(query, index, FRAME, replace(options, orders="all"))
    assert match.homography is not None
    np.testing.assert_allclose(match.homography, truth / (truth[2] @ [500, -500, 1]), rtol=1e-5, atol=1e-5)


def test_same_seed_same_answer(reference, index):
    rng = np.random.default_rng(9)
    query, _ = view(reference, camera(rng, (1500, 1500), 20, gsd=2.0), rng)
    first, again = (match_pairs(query, index, FRAME, seed=4) for _ in range(2))
    np.testing.assert_array_equal(first.homography, again.homography)
    assert replace(first, homography=None, matches=None, seconds=0) == replace(
        again, homography=None, matches=None, seconds=0
    )


# No such place


def test_elsewhere_is_no_such_place(reference, index):
    rng = np.random.default_rng(10)
    query, _ = view(random_network(rng), camera(rng, (2000, 2000), gsd=2.0), rng)
    options = PairOptions(p_query=0.2)
    match = match_pairs(query, index, FRAME, options)
    assert match.homography is None
    assert len(match.matches) == match.inlier_ratio == 0
    assert match.n_samples == query_draws(0.01, 0.05, 0.2)
    assert match.candidates >= match.hypotheses > 0
    assert match.confidence >= 1 - 0.01
    assert match.reason.startswith("no such place (confidence 0.99")


def test_sampled_subsets_claim_no_more_than_they_tested(reference, index):
    rng = np.random.default_rng(11)
    query, _ = view(random_network(rng), camera(rng, (2000, 2000), gsd=2.0), rng)
    match = match_pairs(query, index, FRAME, PairOptions(p_query=0.3, lambda_1=0.6, orders="all"))
    assert match.hypotheses < 0.7 * match.candidates
    assert 1 - 0.01 <= match.confidence < 1 - 0.7**match.n_samples


def test_few_intersections_are_not_searched(reference, index):
    few = random_network(np.random.default_rng(12), n=29)
    match = match_pairs(few, index, FRAME)
    assert match.reason == "only 29 intersections, 30 are needed"
    assert match.confidence == 0.0


@pytest.mark.parametrize("limit", ["work", "time"])
def test_limits_stop_the_search(reference, index, limit):
    rng = np.random.default_rng(13)
    query, _ = view(reference, camera(rng, (2000, 2000), gsd=2.0), rng)
    match = match_pairs(query, index, FRAME, replace(PairOptions(), **{f"{limit}_limit_s": 0.0}))
    assert match.homography is None
    assert (match.n_samples, match.hypotheses) == (1, 0)
    assert match.stopped == limit
    assert match.reason.startswith("stopped a")


def test_the_answer_does_not_depend_on_the_load(reference, index, monkeypatch):
    """However slowly the machine gets on: the limit is work, which is counted."""
    rng = np.random.default_rng(10)
    query, _ = view(random_network(rng), camera(rng, (2000, 2000), gsd=2.0), rng)
    options = PairOptions(work_limit_s=0.05, time_limit_s=math.inf)
    once = match_pairs(query, index, FRAME, options)
    seconds = iter(range(0, 10**9, 30))
    monkeypatch.setattr(paper.time, "perf_counter", lambda: next(seconds))
    again = match_pairs(query, index, FRAME, options)
    assert once.stopped == "work"
    assert 0.05 <= once.work_s < 0.1
    assert replace(again, matches=None, seconds=0.0) == replace(once, matches=None, seconds=0.0)


def test_large_queries_form_tuples_of_a_sample(reference, index, monkeypatch):
    monkeypatch.setattr(paper, "MAX_COSTLY", 40)
    rng = np.random.default_rng(14)
    truth = camera(rng, (2000, 2000), gsd=2.5)
    query, _ = view(reference, truth, rng)
    match = match_pairs(query, index, FRAME)
    assert corner_error(match, truth) < 1e-6
    assert match.inlier_ratio == 1.0


def test_a_map_that_is_forged_to_fill_the_memory_is_refused():
    """All intersections of a city within a kilometre."""
    forged = random_network(np.random.default_rng(3), n=400, side=900.0)
    crowd = forged.only(np.arange(14_000) % 400)
    shifted = replace(crowd, xy=crowd.xy + np.random.default_rng(4).normal(0, 20, (14_000, 2)))
    with pytest.raises(IndexFormatError, match="the paper's method does not fit it"):
        build_pair_index(shifted, TupleOptions())


def test_query_shrunk_onto_a_few_places_is_no_match():
    """Equation 10 to the letter counts any number of intersections at one place."""
    rng = np.random.default_rng(15)
    spots = random_network(rng, n=12, side=60.0, gap_deg=40.0)
    query = random_network(rng, n=60, side=900.0, gap_deg=40.0)
    query = replace(query, xy=query.xy - [0, 950])
    index = build_pair_index(spots, TupleOptions())
    options = PairOptions(inlier_distance_m=40.0, p_query=0.05, orders="++")
    assert match_pairs(query, index, FRAME, options).homography is None
    assert match_pairs(query, index, FRAME, replace(options, one_to_one=False)).homography is not None


# Options


def test_thresholds_are_read_by_the_papers_symbols():
    given = ["delta=0.2", "lambda=0.05", "n_px=20", "orders=all", "one_to_one=no", "d_max_m=1500"]
    expected = PairOptions(delta=0.2, lambda_=0.05, n_px=20, orders="all", one_to_one=False, d_max_m=1500.0)
    assert read_options(given, PairOptions()) == expected
    assert type(expected.n_px) is int


@pytest.mark.parametrize("wrong", ["delta", "delta=", "delta=nan", "delta=1", "n_px=1.5", "orders=+-", "gamma=1", ""])
def test_what_is_no_threshold_is_refused(wrong):
    with pytest.raises(ValueError, match=re.escape(repr(wrong)) + ", expected "):
        read_options([wrong], PAPER)
