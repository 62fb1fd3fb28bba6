"""The best other place, on a lattice: a block beside explains nearly as much, and what is missing there decides."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.lattices import beside, contest
from worlds.scenes import Sight, camera, estimator_of, look, scene_of

from roadgeo.geometry.camera import CameraFault, CameraOptions, pose, sampling
from roadgeo.geometry.homography import Homography
from roadgeo.matching import rivals
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.events import Ledger
from roadgeo.matching.evidence import Evidence
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.rivals import Rivals, log10_gap, mirrored_likelihood, similar_places
from roadgeo.matching.search import Search
from roadgeo.matching.shifts import Shift, move_about, shifted
from roadgeo.matching.triples import larger

NEEDED = LocateOptions().min_log10_odds


@pytest.fixture(scope="module")
def broken():
    """A view of the lattice, some blocks of which are not parted by a street."""
    return contest(0.8, (900, 700))


@pytest.fixture(scope="module")
def even():
    """The same, all blocks equal."""
    return contest(1.0)


def search_of(world, *matrices, near=None, match=None):
    """A search that met these places, and its estimator."""
    _, index, evidence = world
    estimator = estimator_of(evidence.scene, index, match, near)
    for matrix in matrices:
        estimator.settle(Place(evidence.scene, index, matrix))
    return Search(estimator), estimator


def stand(world, *matrices, n_reference=866, **options):
    """Compare the likeliest of some places with the best other one."""
    item, estimator = search_of(world, *matrices, **options)
    return Rivals({item: estimator}, Ledger(n_reference=n_reference), NEEDED).compare(item)


def test_a_place_that_explains_too_little_to_be_laid_has_places_nearby_too(even):
    """What would beat it may turn out to be none, and then it is compared."""
    truth, _, evidence = even
    middle = Homography(truth)(evidence.scene.center)
    wrong = move_about(middle, Shift(700.0, 300.0, 50.0, 1.0, 0.0)) @ truth
    _, estimator = search_of(even, truth, wrong)
    unlaid = estimator.verified[-1]
    assert unlaid.refined is None
    assert np.isfinite(estimator.nearby(unlaid))


def apart(world, matrix, other=None):
    """Metres between the middles of two places, the second the true one unless it is given."""
    truth, _, evidence = world
    middle = Homography(truth if other is None else other)(evidence.scene.center)
    return float(np.hypot(*(Homography(matrix)(evidence.scene.center) - middle)))


def test_the_place_leads_all_others_by_the_streets_that_are_missing_there(broken):
    item, estimator = search_of(broken, broken[0])
    place = Rivals({item: estimator}, Ledger(n_reference=866), NEEDED).compare(item)
    assert apart(broken, place.matrix) < 2.0
    assert apart(broken, place.rival.matrix) > 50.0
    assert place.score > NEEDED
    # The best other place lies further away than those nearby, by which the search judged.
    assert place.score < max(met.score for met in estimator.verified)


def test_a_rival_that_explains_more_takes_over(broken):
    """The search met a block beside only: that leads nothing, and what leads it is the place."""
    truth, _, evidence = broken
    place, direct = stand(broken, beside(truth, evidence)), stand(broken, truth)
    assert apart(broken, place.matrix) < 2.0
    assert place.refined is not None  # and it can be told like any that the search met
    assert place.score == pytest.approx(direct.score, abs=0.5)


def test_where_all_blocks_are_equal_nothing_leads(even):
    assert stand(even, even[0]).score < 0.5
    assert stand(even, even[0], beside(even[0], even[2])).score < 0.5


def test_a_place_known_to_the_search_is_a_rival_wherever_it_lies(broken, monkeypatch):
    """Also where nothing around the best place is looked at."""
    truth, _, evidence = broken
    monkeypatch.setattr(rivals, "similar_places", lambda *_: [])
    monkeypatch.setattr(TripleEstimator, "look_for_equals", lambda *_: None)
    far = move_about(Homography(truth)(evidence.scene.center), Shift(-550.0, 450.0, 0.0, 1.0, 0.0)) @ truth
    item, estimator = search_of(broken, truth)
    asked = Rivals({item: estimator}, Ledger(n_reference=866), NEEDED)
    alone = asked.compare(item)
    estimator.settle(Place(evidence.scene, broken[1], far))
    both = asked.compare(item)  # it was met after the place was compared
    assert alone.rival is None
    assert apart(broken, both.rival.matrix, far) < 5.0
    assert both.score <= alone.score


def test_on_a_large_map_a_lead_is_worth_less(broken):
    n = 15_000 * 10**4
    small, large = (stand(broken, broken[0], n_reference=count) for count in (866, n))
    assert small.score - large.score > np.log10(larger(n))  # by roads or by the picture, whichever leads more


def test_only_what_the_user_allows_is_a_rival(broken):
    truth, _, evidence = broken
    middle = Homography(truth)(evidence.scene.center)
    anywhere, here = stand(broken, truth), stand(broken, truth, near=(*middle, 30.0))
    assert here.rival is None
    assert here.score >= anywhere.score
    upright = camera(tuple(middle.tolist()), evidence.scene.size, 1.0)
    north = MatchOptions(camera=CameraOptions(north_up=True))
    _, estimator = search_of(broken, match=north)
    turned = move_about(middle, Shift(0.0, 0.0, 180.0, 1.0, 0.0)) @ upright
    assert estimator.may_be(upright)
    assert not estimator.may_be(turned)


def test_similar_places_lie_on_the_streets_around_as_large_as_the_place_and_not_mirrored(broken):
    truth, _, evidence = broken
    wrong = beside(truth, evidence)
    others = similar_places(Place(evidence.scene, broken[1], wrong), evidence.compared_with(wrong), MatchOptions())
    places = [other.place.matrix for other in others]
    assert 0 < len(places) <= rivals._AROUND.n_places
    assert min(apart(broken, place) for place in places) < 3.0  # the place itself is among them
    assert sum(apart(broken, place, wrong) > 500.0 for place in places) > 1
    size = evidence.scene.size
    for item in places:
        assert np.linalg.det(item) > 0.0
        assert sampling(item, size) == pytest.approx(sampling(wrong, size), rel=0.1)
        assert evidence.weigh(item) > 0.0
    assert [other.log10_likelihood for other in others] == pytest.approx([evidence.weigh(place) for place in places])


def test_similar_places_point_where_the_image_may(broken):
    """Those that a hint on the heading rules out would crowd out the others, and be compared in vain."""
    truth, _, evidence = broken
    up = pose(truth, evidence.scene.size).rotation_deg
    reported = MatchOptions(camera=CameraOptions(heading_deg=(up, 5.0)))
    compare = evidence.compared_with(truth)
    place = Place(evidence.scene, broken[1], truth)
    anywhere, there = (similar_places(place, compare, match) for match in (MatchOptions(), reported))

    def n_turned(others):
        away = [pose(other.place.matrix, evidence.scene.size).rotation_deg - up for other in others]
        return sum(abs((turn + 180.0) % 360.0 - 180.0) > 45.0 for turn in away)

    assert n_turned(anywhere) > 0
    assert n_turned(there) == 0
    assert len(there) >= len(anywhere) - n_turned(anywhere)


def test_places_around_are_looked_for_in_turns_by_a_right_angle_as_streets_repeat(broken, monkeypatch):
    truth, index, evidence = broken
    turns = []

    def search(turned, *_):
        turns.append(round(pose(turned, evidence.scene.size).rotation_deg - 15.0) % 360)  # its heading
        return []

    monkeypatch.setattr(rivals, "search_nearby", search)
    similar_places(Place(evidence.scene, index, truth), evidence.compared_with(truth), MatchOptions())
    assert sorted(turns) == [0, 90, 180, 270]


def test_of_the_places_met_the_likeliest_dozen_or_so_may_be_the_best(broken, monkeypatch):
    """Not half as many, which may all contradict roads, nor twice as many, which take twice as long."""
    truth, index, evidence = broken
    item, estimator = search_of(broken)
    met = [Place(evidence.scene, index, shifted(truth, 60.0 * k, 0.0), by=Weight(20.0 - k, 480.0)) for k in range(40)]
    estimator.verified.extend(met)
    asked = set()
    monkeypatch.setattr(rivals, "_penalty", lambda place: asked.add(id(place)) or 0.0)
    monkeypatch.setattr(Rivals, "_compare", lambda self, estimator, best, ranked: best)
    Rivals({item: estimator}, Ledger(n_reference=866), NEEDED)._by_roads(item)
    assert {id(place) for place in met[:8]} <= asked
    assert len(asked) < 18


def test_places_that_differ_by_little_everywhere_are_equal(broken):
    truth, _, evidence = broken
    compare, whole = evidence.compared_with(truth), evidence.weigh(truth)
    for away_m in (0.3, 0.6, 1.0):
        there, lead = compare(shifted(truth, away_m, 0.0))
        assert lead <= 1.5 * max(whole - there, 0.1), away_m
    there, lead = compare(shifted(truth, 60.0, 0.0))
    assert 3.0 < lead < whole - there


# --- how far the best of many leads by chance -------------------------------------------------------------------------


@pytest.mark.parametrize("n_places", [30, 3000])
def test_a_gap_by_chance_is_as_rare_as_it_says(n_places):
    drawn = np.sort(np.random.default_rng(5).exponential(2.0, (4000, n_places)), axis=1)
    gaps = np.array([log10_gap(float(row[-1]), row[:-1]) for row in drawn])
    for log10_odds in (0.5, 1.0, 2.0):
        assert 0.5 < (gaps >= log10_odds).mean() * 10.0**log10_odds < 1.6


def test_a_gap_needs_others_and_counts_against_what_explains_less():
    assert log10_gap(20.0, []) == 0.0
    assert log10_gap(20.0, [1.0, 2.0]) == 0.0
    assert log10_gap(20.0, [23.0, 2.0]) == -3.0
    few, crowd = np.linspace(1.0, 8.0, 21), np.linspace(7.5, 8.0, 21)
    assert log10_gap(10.0, crowd) > log10_gap(10.0, few) > 0.0


# --- streets that do not repeat ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(town):
    truth = camera((2000.0, 1900.0), (900, 700), 1.0, heading_deg=15.0)
    scene = scene_of(look(town[0], truth, (900, 700), Sight(1.0, missing=0.1, false=0.05)), (900, 700))
    return truth, town[1], Evidence(scene, town[1], 1.0)


def test_a_place_beyond_doubt_is_not_compared_further(plain, monkeypatch):
    monkeypatch.setattr(rivals, "similar_places", None)
    place = stand(plain, plain[0])
    assert place.rival is None
    assert place.score > rivals._CERTAIN


def test_what_explains_less_than_is_needed_is_not_compared(plain, monkeypatch):
    truth, _, evidence = plain
    monkeypatch.setattr(rivals, "similar_places", None)
    wrong = move_about(Homography(truth)(evidence.scene.center), Shift(700.0, 300.0, 50.0, 1.0, 0.0)) @ truth
    item, estimator = search_of(plain, wrong)
    asked = Rivals({item: estimator}, Ledger(1), NEEDED)
    place = asked.compare(item)
    assert place is None or place.score < NEEDED
    assert asked([item]) is None


def test_where_it_is_compared_it_leads_as_clearly(plain, monkeypatch):
    certain = rivals._CERTAIN
    monkeypatch.setattr(rivals, "_CERTAIN", np.inf)
    place = stand(plain, plain[0])
    assert apart(plain, place.matrix) < 2.0
    assert place.score > certain


def test_where_nothing_was_met_nothing_is_compared(plain):
    item, estimator = search_of(plain)
    asked = Rivals({item: estimator}, Ledger(1), NEEDED)
    assert asked.compare(item) is None
    assert asked([item]) is None


def test_a_search_ends_where_a_place_leads_by_twice_what_is_needed(broken):
    first, estimator = search_of(broken, broken[0])
    empty, other = search_of(broken)
    both = {empty: other, first: estimator}
    place = Rivals(both, Ledger(n_reference=866), 1.0).compare(first)
    half = 0.49 * place.score
    assert Rivals(both, Ledger(n_reference=866), half)([empty, first]) is first
    assert Rivals(both, Ledger(n_reference=15_000 * 10**4), half)([empty, first]) is None
    assert Rivals(both, Ledger(n_reference=866), 1.1 * half)([empty, first]) is None


@pytest.mark.parametrize("is_same", [False, True])
def test_a_place_on_another_part_is_a_rival_unless_it_is_the_same(broken, monkeypatch, is_same):
    both = dict(search_of(broken, broken[0]) for _ in range(2))
    asked = Rivals(both, Ledger(n_reference=866), 1.0)
    best = asked._by_roads(next(iter(both)))
    monkeypatch.setattr(asked, "_by_roads", lambda _: best)
    monkeypatch.setattr(Place, "same", lambda *_: is_same)
    proved = asked(list(both))
    assert (proved is not None) is is_same


@pytest.mark.parametrize(("lead", "shard_left", "stands"), [(1.1, "", True), (0.9, "", False), (1.1, "other", False)])
def test_a_map_that_was_searched_to_its_end_needs_no_double_lead(broken, monkeypatch, lead, shard_left, stands):
    """Nothing of it is left to hold a rival; where a shard of it is left, one may come."""
    (item, estimator), (beside_it, other) = search_of(broken, broken[0]), search_of(broken, broken[0])
    item.best = estimator.verified[0]
    monkeypatch.setattr(other, "index", replace(other.index, meta=dict(other.index.meta)))  # a map of its own
    if shard_left:
        for one in (estimator, other):
            monkeypatch.setitem(one.index.meta, "shard_of", "a large map")
    asked = Rivals({item: estimator, beside_it: other}, Ledger(n_reference=866), NEEDED)
    place = item.best.but(score=lead * NEEDED)
    monkeypatch.setattr(Rivals, "_among_equals", lambda self, part, compare: place)
    assert not asked.stands(item)  # it may go on
    item.stopped = "exhausted"
    assert asked.stands(item) == stands


def test_the_part_goes_on_whose_place_explains_most(broken, monkeypatch):
    pairs = [search_of(broken, broken[0]) for _ in range(3)]
    asked = Rivals(dict(pairs), Ledger(n_reference=866), NEEDED)
    for (_, estimator), likelihood in zip(pairs, (100.0, 99.0, 1.0), strict=True):
        estimator.verified = [estimator.verified[0].but(by=Weight(likelihood, 1.0))]
    assert [asked.may_go_on(part) for part, _ in pairs] == [True, False, False]
    for _, estimator in pairs:
        estimator.verified = []
    assert not any(asked.may_go_on(part) for part, _ in pairs)  # nothing promises anything


@pytest.mark.parametrize(
    ("by_roads", "by_picture", "is_compared"),
    [(0.1, 0.1, False), (0.9, 0.1, True), (0.1, 0.9, True), (0.7, 0.1, False), (0.78, 0.1, True)],
)
def test_where_a_place_ended_the_search_only_others_that_explain_nearly_as_much_are_compared(
    broken, monkeypatch, by_roads, by_picture, is_compared
):
    (first, estimator), (_, other) = pairs = [search_of(broken, broken[0]) for _ in range(2)]
    found = estimator.verified[0]
    found = found.but(scene=replace(found.scene, probability=np.ones((1, 1))))
    weight = Weight(found.log10_likelihood, found.statement_px)

    def weighed(place, share):
        return place.but(by=weight._replace(log10_likelihood=share * weight.log10_likelihood))

    other.verified = [weighed(other.verified[0], by_roads)]
    monkeypatch.setattr(
        rivals, "by_picture", lambda place, _: weighed(place, by_picture if place is other.verified[0] else 1.0)
    )
    monkeypatch.setattr(Place, "same", lambda *_: False)
    monkeypatch.setattr(Rivals, "compare", lambda _, part: found if part is first else other.verified[0])
    asked = Rivals(dict(pairs), Ledger(n_reference=866), 0.2 * weight.log10_likelihood)
    assert [place is not None for _, place in asked.compare_all()] == [True, True]  # it ended without an answer
    first.stopped = "accepted"
    assert [place is not None for _, place in asked.compare_all()] == [True, is_compared]


def test_a_place_is_compared_once_and_remembered(broken, monkeypatch):
    item, estimator = search_of(broken, broken[0])
    asked = Rivals({item: estimator}, Ledger(n_reference=866), NEEDED)
    first, spent = asked.compare(item), item.seconds
    assert spent > 0.0  # it is part of the search
    monkeypatch.setattr(rivals, "similar_places", None)
    assert asked.compare(item) is first


@pytest.mark.parametrize(("certain", "farther"), [(np.inf, [rivals._AROUND]), (0.0, [])])
def test_streets_around_are_looked_at_only_where_the_blocks_beside_leave_a_lead_that_may_be_lost(
    even, broken, monkeypatch, certain, farther
):
    """A block beside may be the place, whether or not the best one that was met leads."""
    looked = []
    monkeypatch.setattr(rivals, "_CERTAIN", certain)
    monkeypatch.setattr(rivals, "HARDLY", 0.0)
    monkeypatch.setattr(rivals, "similar_places", lambda *reported: looked.append((reported[0], *reported[3:])) or [])
    monkeypatch.setattr(TripleEstimator, "look_for_equals", lambda *_: None)
    stand(even, even[0], beside(even[0], even[2]))
    stand(broken, broken[0])
    (small, beside_small), (large, beside_large), *others = looked
    assert beside_small == rivals._NEARBY
    assert beside_small.reach_m > small.scene.half_size * small.gsd_m
    assert beside_large.reach_m == large.scene.half_size * large.gsd_m > rivals._NEARBY.reach_m
    assert [around for _, around in others] == farther


def test_beside_a_place_is_never_farther_than_around_it(broken):
    matrix, index, evidence = broken
    huge = Place(evidence.scene, index, np.diag([100.0, 100.0, 1.0]) @ matrix)
    beside_it, around = rivals._surroundings(huge)
    assert beside_it.reach_m == around.reach_m == rivals._AROUND.reach_m


# --- the mirrored query -----------------------------------------------------------------------------------------------


def mirror_image(evidence):
    """Return a query mirrored, left to right, as it would be traced, without its intersections."""
    scene, width = evidence.scene, evidence.scene.size[0]
    over, back = np.array([-1.0, 1.0]), np.array([width, 0.0])
    seen = {name: getattr(scene, name) * over + back for name in ("points", "dense_points")}
    along = {name: getattr(scene, name) * over for name in ("directions", "dense_directions")}
    return replace(scene, **seen, **along, field=scene.field[:, ::-1], observed=scene.observed[:, ::-1])


def test_the_mirror_image_of_a_query_explains_less(broken):
    truth, index, evidence = broken
    place = Place(evidence.scene, index, truth)
    assert mirrored_likelihood(place, MatchOptions()) < 0.8 * place.log10_likelihood


@pytest.mark.parametrize("heading", [None, 15.0])
def test_where_a_mirrored_query_seems_to_lie_its_mirror_image_explains_more(broken, heading):
    """Wherever the streets run that it was mirrored along, and whatever heading was told."""
    truth, index, evidence = broken
    scene, middle = mirror_image(evidence), Homography(truth)(evidence.scene.center)
    turned = (move_about(middle, Shift(0.0, 0.0, turn, 1.0, 0.0)) @ truth for turn in (-30.0, 30.0))
    wrong = max((Place(scene, index, matrix) for matrix in turned), key=lambda place: place.log10_likelihood)
    match = MatchOptions(camera=CameraOptions(heading_deg=heading and (heading, 5.0)))
    told = mirrored_likelihood(wrong, match)
    assert told > wrong.log10_likelihood
    assert told == pytest.approx(evidence.weigh(truth), rel=0.05)


@pytest.mark.parametrize(("score", "more", "is_mirrored"), [(4.0, 3.6, True), (4.0, 3.4, False), (13.0, 9.0, False)])
def test_a_place_where_the_mirrored_query_fits_better_is_none(plain, monkeypatch, score, more, is_mirrored):
    item, estimator = search_of(plain, plain[0])
    place = estimator.verified[0]
    monkeypatch.setattr(rivals, "mirrored_likelihood", lambda *_: place.agreement.log10_likelihood + more)
    monkeypatch.setattr(Rivals, "_by_roads", lambda *_: place.but(score=score, rival=None))
    found = Rivals({item: estimator}, Ledger(1), NEEDED).compare(item)
    assert found.score == pytest.approx(-more if is_mirrored else score)
    assert found.fault == (CameraFault.MIRRORED if is_mirrored else None)


# --- traced roads and the picture -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("by_roads", "explains", "by_picture", "is_same", "lead"),
    [
        (2.0, 0.6, 5.0, True, 5.8),  # the lesser lead counts by what the best rival leaves unexplained
        (5.0, 0.6, 2.0, True, 5.8),
        (5.0, 0.0, 2.0, True, 7.0),
        (5.0, 1.0, 2.0, True, 5.0),
        (2.0, 0.6, 5.0, False, 3.0),  # or against
        (-1.0, 0.6, 5.0, False, 5.0),
        (-1.0, 1.2, 5.0, True, 5.0),
        (13.0, 0.6, None, True, 13.0),  # beyond doubt: the picture is not asked
    ],
)
def test_traced_roads_and_a_soft_picture_count_together(
    plain, monkeypatch, by_roads, explains, by_picture, is_same, lead
):
    truth, index, evidence = plain
    soft = replace(evidence.scene, probability=np.full(evidence.scene.field.shape, 0.1, np.float32))
    elsewhere = move_about(Homography(truth)(soft.center), Shift(700.0, 300.0, 0.0, 1.0, 0.0)) @ truth
    estimator = estimator_of(soft, index)
    item = Search(estimator)
    here, there = (Place(soft, index, matrix) for matrix in (truth, truth if is_same else elsewhere))
    rival = here.but(by=Weight(explains * here.log10_likelihood, 1.0))
    monkeypatch.setattr(Rivals, "_by_roads", lambda *_: here.but(score=by_roads, rival=rival))
    monkeypatch.setattr(Rivals, "_by_picture", lambda *_: there.but(score=by_picture))
    monkeypatch.setattr(estimator, "look_for_equals", lambda *_: True)
    monkeypatch.setattr(rivals, "mirrored_likelihood", lambda *_: -np.inf)
    assert Rivals({item: estimator}, Ledger(1), NEEDED).compare(item).score == pytest.approx(lead)


def test_what_leads_only_by_the_picture_is_looked_up_elsewhere(plain, monkeypatch):
    truth, index, evidence = plain
    soft = replace(evidence.scene, probability=np.full(evidence.scene.field.shape, 0.1, np.float32))
    estimator, here = estimator_of(soft, index), Place(soft, index, truth)
    item, looked_for = Search(estimator), []

    def look_for_equals(place, *_):
        looked_for.append(place.score)
        return True

    monkeypatch.setattr(estimator, "look_for_equals", look_for_equals)
    monkeypatch.setattr(Rivals, "_by_roads", lambda *_: here.but(score=0.5 * NEEDED, rival=None))
    monkeypatch.setattr(Rivals, "_by_picture", lambda *_: here.but(score=NEEDED - 0.5 * len(looked_for)))
    found = Rivals({item: estimator}, Ledger(1), NEEDED).compare(item)
    assert looked_for == [pytest.approx(1.5 * NEEDED)]
    assert found.score == pytest.approx(1.5 * NEEDED - 0.5)


@pytest.mark.parametrize(("by", "n_compared"), [(-1.0, 1), (1.0, 1), (4.0, 2)])
def test_the_picture_takes_a_rival_that_leads_by_what_is_needed(plain, monkeypatch, by, n_compared):
    truth, index, evidence = plain
    soft = replace(evidence.scene, probability=np.full(evidence.scene.field.shape, 0.1, np.float32))
    estimator = estimator_of(soft, index)
    estimator.settle(Place(soft, index, truth))
    compared: list[Place] = []

    def compare(_, __, place, ___):
        compared.append(place)
        here, there = (place.but(by=Weight(likelihood, 250.0)) for likelihood in (5.0, 5.0 + by))
        return here.but(rival=there if len(compared) == 1 else None)

    monkeypatch.setattr(Rivals, "_compare_by_picture", compare)
    Rivals({Search(estimator): estimator}, Ledger(1), NEEDED)._by_picture(estimator)
    assert len(compared) == n_compared
