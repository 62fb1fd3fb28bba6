"""Proposals and growth by roads, on made-up towns with known homographies."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from naive import road_votes as naive
from worlds.scenes import Sight, camera, estimator_of, look, mapped, random_network, scene_of, search

from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.homography import Homography
from roadgeo.matching import road_search
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.index import build_index
from roadgeo.matching.road_search import (
    COARSE_PIXEL_M,
    RADIUS_M,
    RING_STEP,
    RoadGrower,
    RoadSearch,
    Voter,
    make_raster,
    ring_of,
    scales,
)
from roadgeo.matching.search import SearchOptions
from roadgeo.matching.triples import WITHOUT_ROADS
from roadgeo.roads.graph import RoadGraph

SCALE = (0.2, 5.0)
TRUTH = camera((2100, 1900), (1000, 1000), 1.0, 10.0, 20.0, 70.0)
#: A mask that shows half of the roads, and a fifth as many false ones.
BROKEN = Sight(0.8, missing=0.5, false=0.2)


@pytest.fixture(scope="module")
def broken(town):
    return scene_of(look(town[0], TRUTH, sight=BROKEN, seed=4))


def everywhere(index):
    return np.arange(len(index))


def corner_gap(matrix, scene, truth=TRUTH):
    return np.hypot(*(mapped(matrix, scene.corners) - mapped(truth, scene.corners)).T).max()


def best_votes(scene, index, anchors, scale=SCALE, heading=(0.0, math.pi)):
    voter = Voter(scene, index, scale, heading, everywhere(index))
    return [voter.votes(int(a)) for a in anchors]


def test_the_right_place_leads_the_votes_of_some_intersections(town, broken):
    index = town[1]
    right = 0
    for votes in best_votes(broken, index, range(0, len(broken.intersections), 2)):
        assert (np.diff(votes.ratio) <= 0).all()
        at = mapped(TRUTH, broken.intersections.xy[[votes.anchor]])[0]
        away = np.hypot(*(index.xy[votes.reference[:3]] - at).T)
        right += bool((away < 15).any())
    assert right >= 4


@pytest.mark.parametrize("up", [0.0, 2.9])
def test_limits_on_scale_and_turn_are_kept(town, broken, up):
    (votes,) = best_votes(broken, town[1], [0], (0.8, 1.2), (up, 0.5))
    assert len(votes.reference)
    scale = np.hypot(votes.affine[:, 0], votes.affine[:, 2])
    assert (scale > 0.8 * 0.95).all()
    assert (scale < 1.2 * 1.05).all()
    heading = np.arctan2(votes.affine[:, 1], votes.affine[:, 3])
    assert (np.abs(np.remainder(heading - up + math.pi, 2.0 * math.pi) - math.pi) < 0.5 + 0.11).all()


def test_on_a_coarse_map_small_pixels_are_not_looked_for():
    low, high = scales(CameraOptions(gsd_m=(0.1, 12.0)), 4.0, 6.0)
    assert (low, high) == (6.0 * COARSE_PIXEL_M, 12.0)
    assert 1.5 < low < 3.0  # for roads six times as far apart as a city's
    assert scales(CameraOptions(gsd_m=(0.1, 0.5)), 4.0, 6.0)[0] > 0.5


def test_an_intersection_far_from_all_roads_has_no_votes(town, broken):
    alone = replace(broken, dense_points=broken.dense_points[:0], dense_directions=broken.dense_directions[:0])
    (votes,) = best_votes(alone, town[1], [0])
    assert len(votes.reference) == 0


def test_a_rough_proposal_grows_to_the_truth(town, broken):
    index = town[1]
    grower = RoadGrower(broken, index, CameraOptions())
    gaps = []
    for anchor, at in enumerate(mapped(TRUTH, broken.intersections.xy)):
        j = int(np.argmin(np.hypot(*(index.xy - at).T)))
        if np.hypot(*(index.xy[j] - at)) > 5:
            continue
        ahead = mapped(TRUTH, broken.intersections.xy[anchor] + np.eye(2)) - at
        turn, scale = math.radians(3.0), 1.03  # off by as much as the steps of a vote
        c, s = scale * math.cos(turn), scale * math.sin(turn)
        affine = np.array([[c, -s], [s, c]]) @ ahead.T
        grown = grower.grow(anchor, np.array([j]), affine.reshape(1, 4))
        gaps.append(corner_gap(grown[0].matrix, broken) if grown else np.inf)
    assert np.median(gaps) < 8


@pytest.mark.parametrize("seed", range(3))
def test_finds_a_broken_mask_that_triples_do_not(town, seed):
    network, index = town
    scene = scene_of(look(network, TRUTH, sight=Sight(0.8, missing=0.6, false=0.3), seed=seed))
    limits = SearchOptions(time_limit_s=60.0)
    quick = search(estimator_of(scene, index, MatchOptions(roads=False, without_roads=WITHOUT_ROADS[:2])), limits)
    assert quick.score < 3.5
    full = search(estimator_of(scene, index, MatchOptions()), limits)
    assert full.score > 6
    assert corner_gap(full.best.refined.matrix, scene) < 6
    assert full.best.by_roads


@pytest.mark.parametrize(("turned", "is_kept"), [(0.0, True), (0.5, True), (0.85, False)])
def test_a_proposal_is_given_up_where_most_of_its_roads_lie_on_no_road(town, turned, is_kept):
    network, index = town
    scene = scene_of(look(network, TRUTH))
    anchor = int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))
    (at,) = mapped(TRUTH, scene.intersections.xy[[anchor]])
    directions, some = scene.directions.copy(), np.random.default_rng(1).random(len(scene.points)) < turned
    directions[some] = directions[some] @ np.array([[0.6, 0.8], [-0.8, 0.6]])  # as hardly a road runs
    grower = RoadGrower(replace(scene, directions=directions), index, CameraOptions())
    nearest = np.argmin(np.hypot(*(index.xy - at).T), keepdims=True)
    grown = grower.grow(anchor, nearest, Homography(TRUTH).jacobian(scene.intersections.xy[anchor]).reshape(1, 4))
    assert bool(grown) is is_kept


@pytest.mark.parametrize(("n_points", "least", "most"), [(75, 13, 27), (110, 6, 11), (300, 5, 7)])
def test_fewer_and_fewer_proposals_of_an_intersection_grow_on(town, n_points, least, most):
    """Of sixty alike; the number of points is that of the stages."""
    network, index = town
    scene = scene_of(look(network, TRUTH))
    some = slice(0, None, len(scene.points) // n_points + 1)
    thin = replace(scene, points=scene.points[some], directions=scene.directions[some])
    anchor = int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))
    (at,) = mapped(TRUTH, scene.intersections.xy[[anchor]])
    affine = Homography(TRUTH).jacobian(scene.intersections.xy[anchor]).reshape(1, 4)
    affines = affine * (1.0 + 1e-3 * np.arange(60)[:, None] / 60)
    nearest = np.full(60, np.argmin(np.hypot(*(index.xy - at).T)))
    assert least <= len(RoadGrower(thin, index, CameraOptions()).grow(anchor, nearest, affines)) <= most


def test_an_intersections_own_branches_do_not_vote_as_far_as_a_block_or_two():
    """They agree by construction; roads beyond, and those that run otherwise, do vote."""
    ends = [np.array([[500.0, -500.0], [500.0 + x, -500.0 + y]]) for x, y in ((450, 0), (-450, 0), (0, 450), (0, -450))]
    cross = RoadGraph.from_polylines(
        np.array([[500.0, -500.0], *(end[1] for end in ends)]), np.array([[0, k] for k in range(1, 5)]), ends
    )
    around = road_search._look_around(scene_of(cross), 0, (1.0, 1.0), 1.0)
    marked = naive.bits_of(around.rings[0]).any(axis=(0, 2))
    radii = RADIUS_M * RING_STEP ** (np.arange(len(marked)) + 0.5 - len(marked))
    assert not marked[radii < 110.0].any()
    assert marked[radii > 190.0].all()


def test_votes_are_weighed_against_half_as_many_roads_again_as_the_map_has_there(town):
    """Roads crowd around intersections; and at the right place a little more than half of the points meet roads."""
    scene = scene_of(look(town[0], TRUTH))
    voter = Voter(scene, town[1], (0.95, 1.05), (0.0, math.pi), everywhere(town[1]))
    anchor = int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))
    votes, points = voter.votes(anchor), road_search._look_around(scene, anchor, (0.95, 1.05), 1.0).points
    each = math.log(0.55 / (1.5 * voter.places.density[votes.reference[0]]))
    assert 0.9 * each < votes.ratio[0] / np.diff(points.starts).max() <= each


@pytest.mark.parametrize("off_deg", [-6.0, -3.0, 3.0, 6.0])
def test_a_turn_that_branches_tell_some_degrees_wrong_is_put_right(town, off_deg):
    scene, index = scene_of(look(town[0], TRUTH)), town[1]
    anchor = int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))
    own = scene.intersections
    turned = replace(scene, intersections=replace(own, rays=own.rays + np.float32(math.radians(off_deg))))
    (votes,) = best_votes(turned, index, [anchor], (0.95, 1.05))
    (at,) = mapped(TRUTH, own.xy[[anchor]])
    best = votes.affine[np.flatnonzero(votes.reference == np.argmin(np.hypot(*(index.xy - at).T)))[0]].reshape(2, 2)
    expected = Homography(TRUTH).jacobian(own.xy[anchor])
    turn = math.atan2(best[1, 0], best[0, 0]) - math.atan2(expected[1, 0], expected[0, 0])
    assert abs(math.degrees(turn)) < 1.4


@pytest.mark.parametrize("scale", [0.962, 1.04])
def test_a_scale_between_those_tried_is_put_right(town, scale):
    scene, index = scene_of(look(town[0], camera((2100, 1900)))), town[1]
    anchor = int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))
    (votes,) = best_votes(scene, index, [anchor], (scale, scale))
    (at,) = mapped(camera((2100, 1900)), scene.intersections.xy[[anchor]])
    best = votes.affine[np.flatnonzero(votes.reference == np.argmin(np.hypot(*(index.xy - at).T)))[0]]
    assert np.hypot(best[0], best[2]) == pytest.approx(1.0, abs=0.012)


def test_the_best_hundreds_of_proposals_are_judged_anew(town):
    votes = max(best_votes(scene_of(look(town[0], TRUTH)), town[1], range(20, 30)), key=lambda votes: votes.n_tried)
    assert votes.n_tried > 700
    assert 250 < len(votes.reference) < 650


@pytest.mark.parametrize(("off_m", "is_kept"), [(11.0, True), (25.0, False)])
def test_roads_lie_on_roads_that_are_off_by_some_metres(town, off_m, is_kept):
    network, index = town
    scene = scene_of(look(network, TRUTH))
    anchor = int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))
    (at,) = mapped(TRUTH, scene.intersections.xy[[anchor]])
    side = np.random.default_rng(1).choice([-off_m, off_m], (len(scene.points), 1))  # no fit is better
    points = scene.points + side * scene.directions[:, ::-1] * (-1.0, 1.0)
    grower = RoadGrower(replace(scene, points=points), index, CameraOptions())
    nearest = np.argmin(np.hypot(*(index.xy - at).T), keepdims=True)
    grown = grower.grow(anchor, nearest, Homography(TRUTH).jacobian(scene.intersections.xy[anchor]).reshape(1, 4))
    assert bool(grown) is is_kept


def test_near_restricts_where_votes_are_cast(town, broken):
    index = town[1]
    everything = RoadSearch(broken, index, CameraOptions())
    around = RoadSearch(broken, index, CameraOptions(gsd_m=(0.8, 1.2)), (500.0, 500.0, 100.0))
    assert len(everything.voter.candidates) == len(index)
    assert 0 < len(around.voter.candidates) < len(index) / 2
    nowhere = RoadSearch(broken, index, CameraOptions(), (9e6, 9e6, 100.0))
    assert all(n == 0 and not grown for _, _, n, grown in nowhere.rounds())


def test_a_known_heading_leaves_few_turns_to_try_whichever_way_it_points(town, broken):
    """Fewer proposals of other places go on beside those of the right one, and less of the time limit is spent."""

    def grown_from(camera):
        roads = RoadSearch(broken, town[1], camera)
        rounds = list(roads.rounds())
        gap = min(corner_gap(place.matrix, broken) for a_round in rounds for place in a_round.grown)
        return sum(a_round.n_tried for a_round in rounds), gap

    (n_blind, _), (n_told, gap) = map(grown_from, (CameraOptions(), CameraOptions(heading_deg=(70.0, 5.0))))
    assert n_told < n_blind / 3
    assert gap < 20.0


def test_twenty_or_so_intersections_vote(town, broken):
    """Not half as many, which may all be false, nor twice as many, which take twice as long."""
    whole = scene_of(look(town[0], camera((2100, 1900), (1600, 1600))), (1600, 1600))
    hints = CameraOptions(gsd_m=(0.9, 1.1), heading_deg=(0.0, 5.0))
    n = len(list(RoadSearch(whole, town[1], hints).rounds()))
    assert len(whole.intersections) > 40
    assert 13 < n < 30
    assert len(list(RoadSearch(broken, town[1], hints).rounds())) == len(broken.intersections) < n


def test_proposals_far_less_likely_than_the_best_do_not_grow(town, broken, monkeypatch):
    def first_round():
        return next(RoadSearch(broken, town[1], CameraOptions()).rounds())

    votes = RoadSearch(broken, town[1], CameraOptions()).voter.votes(first_round().anchor)
    likely = int((votes.ratio >= 0.5 * votes.ratio[0]).sum())
    assert 1 <= likely < 80 < len(votes.ratio)
    assert first_round().n_proposed == likely
    with monkeypatch.context() as patch:
        patch.setattr(road_search, "_LIKELY", -math.inf)
        assert 50 < first_round().n_proposed < 120  # however likely all are
    monkeypatch.setattr(road_search, "_MAX_GROWN", 3)
    assert first_round().n_proposed == min(likely, 3)


def test_parts_of_a_map_share_what_an_intersection_sees(town, broken):
    index = town[1]
    parts = [RoadSearch(broken, index, CameraOptions(), among=np.arange(k, len(index), 2)) for k in range(2)]
    before = road_search._look_around.cache_info()
    for part in parts:
        part.voter.votes(0)
    after = road_search._look_around.cache_info()
    assert after.misses - before.misses <= 1
    assert after.hits > before.hits


def test_a_raster_in_use_is_not_drawn_again(town, monkeypatch):
    monkeypatch.setattr(road_search, "_MOST_BYTES", 0)
    drawn = make_raster(town[1])
    other = make_raster(build_index(random_network(7, 400.0)))
    assert make_raster(town[1]) is drawn
    assert drawn is not other


def test_the_raster_is_made_once_and_has_a_rim(town):
    drawn = make_raster(town[1])
    assert make_raster(town[1]) is drawn
    assert 64 * drawn.raster.cell > RADIUS_M * 1.08
    assert drawn.radii[-1] < 63
    cells = drawn.cells(town[1].xy)
    rows, columns = np.array(drawn.raster.tile_of.shape) * 64
    assert cells.min() >= 64 - 1e-6
    assert cells[:, 0].max() <= columns - 64
    assert cells[:, 1].max() <= rows - 64
    assert not drawn.raster.bits[0].any()


def test_roads_are_drawn_some_8_m_to_either_side(town):
    """Cells are 6 m wide: half of their diagonal is 4.2 m."""
    drawn, xy = make_raster(town[1]), np.random.default_rng(1).uniform(500, 3500, (4000, 2))
    away_m = shapely.distance(shapely.points(xy), shapely.multilinestrings(town[1].segments.reshape(-1, 2, 2)))
    columns, rows = drawn.cells(xy).astype(int).T
    tiles = drawn.raster.tile_of[rows // 64, columns // 64]
    marked = drawn.raster.bits[tiles, rows % 64, columns % 64] > 0
    assert marked[away_m < 3.7].all()
    assert not marked[(away_m > 12.3) & (away_m < 20.0)].any()


def test_rings_are_drawn_where_they_are_asked_for(town):
    drawn = road_search._draw(town[1])
    cells = drawn.cells(town[1].xy)
    drawn.draw_rings_of(cells, np.array([3, 1]))
    assert np.flatnonzero(drawn.has_rings).tolist() == [1, 3]
    first = drawn.rings[[1, 3]].copy()
    assert first.any()
    drawn.rings[1] = 0  # what is there is not drawn again
    drawn.draw_rings_of(cells, np.arange(5))
    assert not drawn.rings[1].any()
    assert (drawn.rings[3] == first[1]).all()
    assert drawn.has_rings[:5].all()


def test_distances_lie_in_rings():
    edges = RADIUS_M * RING_STEP ** np.arange(-32.0, 1.0)
    assert ring_of(edges[:-1] * 1.01).tolist() == list(range(32))
    assert ring_of(np.array([0.0, 0.99 * edges[0], 1.01 * edges[-1]])).tolist()[1:] == [-1, 32]
    assert ring_of(np.zeros(1)) < 0


def test_a_map_of_few_roads(broken):
    index = build_index(random_network(7, 400.0))
    result = search(estimator_of(broken, index, MatchOptions()))
    assert result.score < 2.5


def test_wide_roads_leave_out_scales_at_which_they_would_be_no_roads():
    camera = CameraOptions(gsd_m=(0.1, 12.0))
    assert scales(camera, math.nan) == (0.1, 12.0)
    assert scales(camera, 3.0) == (0.1, 12.0)
    assert scales(camera, 10.0) == pytest.approx((0.1, 7.5))
    assert scales(CameraOptions(gsd_m=(9.0, 12.0)), 10.0) == (9.0, 12.0)
