"""Parts are swept together: an intersection of the query on all of them, and the best of what it proposes goes on."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from worlds.scenes import Sight, camera, look, mapped, random_network, scene_of

from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.homography import Homography
from roadgeo.location import Seconds
from roadgeo.matching import growing
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.events import Ledger
from roadgeo.matching.growing import SharedSweeps, grow_proposals, screen_proposals
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.parts import Whole
from roadgeo.matching.place import Place
from roadgeo.matching.rivals import Rivals
from roadgeo.matching.scene import Query
from roadgeo.matching.search import Search, SearchOptions, search_together
from roadgeo.matching.triples import WITHOUT_ROADS, Proposals, Sweep, TripleOptions, cut_to_units, n_units


@dataclass(eq=False)
class Part:
    """Proposes places with so many neighbours placed; what grows of each is supported as it was placed."""

    placed: list[list[int]]
    index: object = None
    screened: list[int] = field(default_factory=list)
    whole: list[Place] = field(default_factory=list)

    def allow(self, proposals):
        return np.ones(len(proposals.placed), bool)

    def screen(self, proposals, allowed, most):
        self.screened.append(most)
        return np.arange(most)

    def follow_up(self, proposals, chosen):
        for item in proposals.placed[chosen]:
            yield Place(None, self.index, np.eye(3), float(item))

    def enough(self):
        return False


class Shard:
    """Of a map of which all others are."""

    def is_shard_beside(self, other):
        return True


class Plan:
    """Proposes what the parts hold, an anchor after another."""

    def __init__(self, parts):
        self.parts = parts

    def proposals(self, scene, indexes, scale, min_ratio, ahead):
        for anchor, rows in enumerate(zip(*(part.placed for part in self.parts), strict=True)):
            yield [proposals_of(anchor, placed) for placed in rows]


def proposals_of(anchor, placed):
    n = len(placed)
    return Proposals(anchor, np.arange(n), np.zeros((n, 2), int), np.zeros((n, 4)), np.array(placed, int), 1, n, n)


def swept(parts):
    sweeps = SharedSweeps(None, CameraOptions())
    sweeps.members += parts
    return sweeps, Plan(parts)


def supports(hypotheses):
    return [hypothesis.support for hypothesis in hypotheses]


def test_the_best_of_all_parts_are_verified_each_where_it_grew(monkeypatch):
    monkeypatch.setattr(growing, "MAX_VERIFIED", 3)
    parts = [Part([[5, 3], [2]]), Part([[9, 1], [8]]), Part([[4], []])]
    sweeps, sweep = swept(parts)
    found = [[supports(item) for item in sweeps.rounds(part, sweep)] for part in parts]
    assert found == [[[5.0], [2.0]], [[9.0], [8.0]], [[4.0], []]]


@pytest.mark.parametrize(("most", "shares"), [(100, [4, 2, 1]), (3, [1, 2, 0]), (5, [2, 2, 1]), (1, [0, 1, 0])])
def test_the_best_placed_are_screened_and_of_equals_each_part_gives_one_in_turn(most, shares, monkeypatch):
    monkeypatch.setattr(growing, "MAX_SCREENED", most)
    parts = [Part([[3, 3, 3, 3]]), Part([[4, 3]]), Part([[3]])]
    sweeps, sweep = swept(parts)
    for part in parts:
        list(sweeps.rounds(part, sweep))
    assert [part.screened for part in parts] == [[share] for share in shares]


def test_what_lies_on_roads_grows_in_even_shares(monkeypatch):
    monkeypatch.setattr(growing, "MAX_GROWN", 6)
    monkeypatch.setattr(growing, "MAX_VERIFIED", 100)
    parts = [Part([[3] * 8]), Part([[3] * 4])]
    sweeps, sweep = swept(parts)
    assert [len(next(sweeps.rounds(part, sweep))) for part in parts] == [4, 2]


@pytest.mark.parametrize("n_parts", [1, 4])
def test_of_an_anchors_proposals_some_hundreds_are_screened_fewer_grow_and_few_are_verified(n_parts):
    """Not half as many, which may lose the right one, nor twice as many, which take twice as long."""
    parts = [Part([[3] * (1600 // n_parts)]) for _ in range(n_parts)]
    sweeps, sweep = swept(parts)
    grown = []
    for part in parts:
        part.follow_up = lambda proposals, chosen, part=part: (
            grown.append(len(chosen)) or Part.follow_up(part, proposals, chosen)
        )
    verified = sum(len(next(sweeps.rounds(part, sweep))) for part in parts)
    assert 400 < sum(sum(part.screened) for part in parts) < 900
    assert 100 < sum(grown) < 220
    assert 3 <= verified <= 5


def test_each_part_takes_what_grew_on_it_in_its_own_time():
    parts = [Part([[5], [6]]), Part([[7], [8]])]
    sweeps, sweep = swept(parts)
    first = sweeps.rounds(parts[0], sweep)
    assert [supports(next(first)), supports(next(first))] == [[5.0], [6.0]]
    assert [supports(item) for item in sweeps.rounds(parts[1], sweep)] == [[7.0], [8.0]]


def test_a_place_on_ground_that_shards_share_is_verified_once(monkeypatch):
    monkeypatch.setattr(growing, "MAX_VERIFIED", 4)

    monkeypatch.setattr(Place, "same", lambda one, other: one.support // 10 == other.support // 10)
    parts = [Part([[31, 19]]), Part([[52, 45, 18]]), Part([[60, 11]])]
    for part in parts:
        part.index = Shard()
    parts[2].whole.append(Place(None, parts[2].index, np.eye(3), 50.0))
    sweeps, sweep = swept(parts)
    found = [sorted(supports(next(sweeps.rounds(part, sweep)))) for part in parts]
    assert found == [[19.0, 31.0], [45.0], [60.0]]


# --- with real parts --------------------------------------------------------------------------------------------------

TRUTH = camera((1000, 1000), (1000, 1000), 1.0, 10.0, 20.0, 130.0)


@pytest.fixture(scope="module")
def towns():
    networks = [random_network(seed, 2000.0) for seed in (11, 12, 13, 14)]
    return networks, [build_index(network) for network in networks]


def search_all(scene, indexes, options=None):
    ledger, sweeps = Ledger(sum(map(len, indexes))), SharedSweeps(scene, CameraOptions())
    estimators = [TripleEstimator(sweeps, index, options, ledger=ledger) for index in indexes]
    parts = {Search(estimator): estimator for estimator in estimators}
    search_together(list(parts), SearchOptions(time_limit_s=60.0), Rivals(parts, ledger, 3.5))
    return list(parts)


def test_a_place_is_found_on_any_of_many_towns(towns):
    networks, indexes = towns
    for k, network in enumerate(networks):
        parts = search_all(scene_of(look(network, TRUTH)), indexes)
        assert [part.stopped for part in parts] == ["accepted" if n == k else "elsewhere" for n in range(4)]


def test_a_twin_on_another_part_is_met(towns):
    networks, indexes = towns
    twin = replace(indexes[1], meta={**indexes[1].meta, "origin": [400_000.0, 4_690_000.0]})
    parts = search_all(
        scene_of(look(networks[1], TRUTH)),
        [*indexes, twin],
        MatchOptions(without_roads=WITHOUT_ROADS[:2], roads=False),
    )
    assert "accepted" not in [part.stopped for part in parts]
    assert min(parts[1].score, parts[4].score) > 8.0


def test_many_parts_take_as_many_places_as_one(towns, monkeypatch):
    """Of one anchor's proposals on all parts as many are screened and verified as on one map."""
    _, indexes = towns
    stranger = scene_of(look(random_network(3, 2000.0), TRUTH))
    monkeypatch.setattr(growing, "MAX_SCREENED", 50)
    options = MatchOptions(without_roads=(Sweep(TripleOptions(), 1),), roads=False)
    parts = search_all(stranger, indexes, options)
    assert sum(part.estimator.n_screened for part in parts) <= 3 * 50
    assert sum(part.estimator.n_verified for part in parts) <= 3 * growing.MAX_VERIFIED


def is_screened(towns, change):
    """Whether a true proposal passes once `change` moved and turned the roads, nearest to the anchor first."""
    networks, indexes = towns
    scene, index = scene_of(look(networks[0], TRUTH)), indexes[0]
    anchor = int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))
    (there,) = mapped(TRUTH, scene.intersections.xy[[anchor]])
    nearest = np.argmin(np.hypot(*(index.xy - there).T), keepdims=True)
    proposals = replace(
        proposals_of(anchor, [2]),
        reference=nearest,
        affine=Homography(TRUTH).jacobian(scene.intersections.xy[anchor]).reshape(1, 4),
    )
    order = np.argsort(np.hypot(*(scene.points - scene.intersections.xy[anchor]).T))
    points, directions = scene.points[order], scene.directions[order]
    change(points, directions)
    scene = replace(scene, points=points, directions=directions)
    return len(screen_proposals(scene, index, proposals, np.array([0]))) == 1


@pytest.mark.parametrize(("turned", "is_kept"), [(0.0, True), (0.3, True), (0.5, False), (0.7, False)])
def test_a_proposal_grows_where_more_than_half_of_the_roads_around_lie_on_roads(towns, turned, is_kept):
    def turn(points, directions):
        some = np.arange(len(points)) % 10 < 10 * turned
        directions[some] = directions[some] @ np.array([[0.6, 0.8], [-0.8, 0.6]])  # as hardly a road runs

    assert is_screened(towns, turn) is is_kept


@pytest.mark.parametrize(("n_right", "is_kept"), [(15, False), (28, True)])
def test_some_forty_points_around_decide(towns, n_right, is_kept):
    def turn(points, directions):
        directions[n_right:] = directions[n_right:] @ np.array([[0.6, 0.8], [-0.8, 0.6]])

    assert is_screened(towns, turn) is is_kept


@pytest.mark.parametrize(("off_m", "is_kept"), [(8.0, True), (15.0, False)])
def test_roads_around_lie_on_roads_that_are_off_by_some_metres(towns, off_m, is_kept):
    def shift(points, directions):
        points += off_m * directions[:, ::-1] * (-1.0, 1.0)

    assert is_screened(towns, shift) is is_kept


def grown_from_the_middle(town, change):
    """The place that grows from a true proposal for the intersection in the middle, once `change` moved the others.

    It is given the query's places, (N, 2) metres, and those of them that are no seeds, outwards from the middle.
    """
    network, index = town
    truth = camera((1000, 1000), (1600, 1600))
    scene = scene_of(look(network, truth, (1600, 1600)), (1600, 1600))
    own, outwards = scene.intersections, np.argsort(np.hypot(*(scene.intersections.xy - scene.center).T))
    anchor = int(outwards[0])
    matched = Place(scene, index, truth).matched
    partners = matched[scene.neighbours[anchor][:6]]
    others = outwards[1:][~np.isin(outwards[1:], scene.neighbours[anchor][:6])]
    xy = own.xy.copy()
    change(xy, others)
    proposals = replace(
        proposals_of(anchor, [6]),
        reference=matched[[anchor]],
        affine=Homography(truth).jacobian(own.xy[anchor]).reshape(1, 4),
        partners=partners[None],
    )
    moved = replace(scene, intersections=replace(own, xy=xy))
    return grow_proposals(moved, index, proposals, np.array([0]), CameraOptions()), others


@pytest.mark.parametrize(("off_m", "least", "most"), [(0.0, 0.9, 1.0), (7.0, 0.8, 1.0), (14.0, 0.0, 0.4)])
def test_intersections_match_where_they_are_off_by_some_metres(towns, off_m, least, most):
    def shake(xy, others):
        turn = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(others))
        xy[others[::3]] += off_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)[::3]

    (place,), others = grown_from_the_middle([own[0] for own in towns], shake)
    assert least <= (place.grown[others[::3]] >= 0).mean() <= most


@pytest.mark.parametrize(("n_lost", "is_kept"), [(20, True), (36, False)])
def test_a_proposal_is_given_up_where_few_of_the_nearest_intersections_match(towns, n_lost, is_kept):
    def lose(xy, others):
        xy[others[:n_lost]] += np.array([37.0, 29.0])  # some meet others by chance

    grown, _ = grown_from_the_middle([own[0] for own in towns], lose)
    assert bool(grown) is is_kept


def test_a_match_counts_more_than_three_intersections_without_one(towns):
    """At the right place a little less than half of them match, by chance one in twelve."""

    def lose(xy, others):
        xy[others[::5]] += np.array([37.0, 29.0])

    (place,), others = grown_from_the_middle([own[0] for own in towns], lose)
    n = int((place.grown[others] >= 0).sum())
    assert place.support == pytest.approx(n * np.log(0.45 / 0.08) + (len(others) - n) * np.log(0.55 / 0.92))


# --- each unit of a part that is searched alone -----------------------------------------------------------------------


@pytest.mark.parametrize(("n", "units"), [(1, 1), (22_000, 1), (23_000, 2), (45_000, 3), (160_000, 11)])
def test_a_large_map_is_cut_to_compact_units_of_a_citys_size(n, units):
    xy = np.random.default_rng(5).uniform(0.0, 1000.0, (n, 2)) * (3.0, 1.0)
    unit = cut_to_units(xy)
    sizes = np.bincount(unit)
    assert (len(sizes), n_units(n)) == (units, units)
    assert sizes.max() - sizes.min() <= units
    areas = sum(float(np.prod(np.ptp(xy[unit == k], axis=0))) for k in range(units))
    assert areas <= 3.0e6  # they do not overlap
    assert max(float(np.ptp(xy[unit == k], axis=0).max()) for k in range(units)) <= 1.2 * 3000.0 / units**0.5


def test_a_broken_mask_is_found_in_company_as_it_is_alone(towns):
    networks, indexes = towns
    graph = look(networks[2], TRUTH, (1000, 1000), Sight(1.0, missing=0.45, false=0.3))
    scene = scene_of(graph)
    query = Query("broken", scene, graph, Seconds())
    alone, company = (
        search_references(query, [Whole(index) for index in some], LocateOptions(), 60.0)
        for some in (indexes[2:3], indexes)
    )
    assert [one.stopped == "accepted" for one in company] == [False, False, True, False]
    assert company[2].places[0].score > 0.9 * alone[0].places[0].score > 3.5


def test_where_nothing_stands_out_each_map_says_when_its_turn_comes(towns):
    graph = look(random_network(15, 2000.0), TRUTH, (600, 600), Sight(1.0, missing=0.3))
    scene = scene_of(graph)
    said, query = [], Query("elsewhere", scene, graph, Seconds())
    parts = [
        Whole(replace(index, meta={**index.meta, "name": name})) for index, name in zip(towns[1], "aabc", strict=True)
    ]
    search_references(query, parts, LocateOptions(), 60.0, say=lambda text, _=None: said.append(text))
    assert said == [f"searching each map alone, map {k} of 3" for k in (1, 2, 3)]
