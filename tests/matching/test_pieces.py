"""What each piece of a frame says of a place, on scenes with a known one."""

import itertools
import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import rankdata
from worlds.scenes import Sight, camera, look, random_network, scene_of

import roadgeo
from roadgeo.geometry.homography import Homography
from roadgeo.matching.local_search import Shift, move_about
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.pieces import PieceCounts, Pieces, log10_lead, sample_roads
from roadgeo.matching.verification import VerifyOptions
from roadgeo.reference.reference import Reference


@pytest.fixture(scope="module")
def seen(town):
    truth = camera((1900.0, 2000.0), (900, 700), 1.0, heading_deg=40.0)
    return truth, scene_of(look(town[0], truth, (900, 700), Sight(sigma_m=1.0, missing=0.2), 1), (900, 700))


def count(seen, index, matrix):
    scene = seen[1]
    pieces = Pieces(scene, index, 1.0, 60.0, VerifyOptions())
    ground = Homography(matrix)(scene.corners)
    return pieces.count(matrix, sample_roads(index, ground.min(axis=0), ground.max(axis=0), pieces.step_m))


def test_pieces_sum_up_to_the_roads(town, seen):
    truth, scene = seen
    found = count(seen, town[1], truth)
    assert found.drawn.sum() == pytest.approx(scene.road_length_px)
    assert found.agreeing.sum() > 0.9 * found.drawn.sum()
    assert 0.7 * found.mapped.sum() < found.shown.sum() < 0.9 * found.mapped.sum()  # a fifth is missing
    assert ((found.agreeing <= found.drawn) & (found.shown <= found.mapped)).all()


def test_a_place_beside_agrees_less(town, seen):
    truth, scene = seen
    beside = move_about(Homography(truth)(scene.center), Shift(60.0, 40.0, 0.0, 1.0, 0.0)) @ truth
    here, there = (count(seen, town[1], matrix) for matrix in (truth, beside))
    assert log10_lead(here.shares - there.shares) > 3.0
    assert log10_lead(there.shares - here.shares) == 0.0


def test_a_place_laid_small_agrees_within_as_many_pixels_not_metres(town, seen):
    """Within as many metres, its roads would agree wherever it is laid small enough."""
    truth, scene = seen
    small = move_about(Homography(truth)(scene.center), Shift(0.0, 0.0, 0.0, 0.2, 0.0)) @ truth
    ground = Homography(small)(scene.corners)
    pieces = Pieces(scene, town[1], 1.0, 60.0, VerifyOptions())
    samples = sample_roads(town[1], ground.min(axis=0), ground.max(axis=0), pieces.step_m)
    found, loose = (pieces.count(small, samples, scale) for scale in (0.2, 1.0))
    assert found.agreeing.sum() < 0.5 * loose.agreeing.sum()
    assert found.mapped.sum() == pytest.approx(5.0 * loose.mapped.sum())


def test_shares_of_few_numbers():
    counts = PieceCounts(*(np.array(row, float) for row in ([60, 0, 40], [60, 0, 10], [40, 0, 60], [20, 0, 60])))
    assert counts.shares.tolist() == [0.8, 0.5, 0.7]


def test_alike_places_lead_by_nothing():
    assert log10_lead(np.zeros(9)) == 0.0
    assert log10_lead(np.array([1.0, -1.0, 0.0])) == 0.0


@given(
    st.lists(st.floats(0.1, 1.0), min_size=1, max_size=10).flatmap(
        lambda sizes: st.tuples(
            st.just(sizes), st.lists(st.sampled_from([-1, 1]), min_size=len(sizes), max_size=len(sizes))
        )
    )
)
def test_a_lead_is_never_surer_than_all_ways_to_draw_the_signs_tell(drawn):
    sizes, signs = map(np.array, drawn)
    all_signs = np.array(list(itertools.product((-1, 1), repeat=len(sizes))))
    ranks = rankdata(sizes)
    as_much = np.mean(all_signs @ ranks >= (signs @ ranks) - 1e-9)
    assert 10.0 ** -log10_lead(signs * sizes) >= as_much - 1e-12


def test_one_piece_outweighs_no_others():
    told = np.append(np.linspace(1.0, 2.0, 30), -100.0)
    assert log10_lead(told) > log10_lead(told[:-1]) - 1.5 > 4.0


def test_a_long_lead_is_counted_without_end():
    assert 1000.0 < log10_lead(np.ones(10_000)) < 10_000 * math.log10(2.0)


def test_roads_are_sampled_where_they_touch_a_box(town):
    index = town[1]
    assert sample_roads(index, np.array([-9e5, -9e5]), np.array([-8e5, -8e5]), 12.0).shape == (0, 2)
    everywhere = sample_roads(index, np.array([-1e5, -1e5]), np.array([1e5, 1e5]), 12.0)
    lengths = np.hypot(*(index.segments[:, 2:] - index.segments[:, :2]).T)
    assert len(everywhere) == pytest.approx(lengths.sum() / 12.0, abs=1.0)


def drawn(network, matrix, size):
    """Draw what a camera sees, with all its roads."""
    graph = look(network, matrix, size, Sight(sigma_m=0.5), 1)
    mask = np.zeros(size[::-1], np.uint8)
    for k in range(len(graph.edges)):
        line = graph.coords[graph.offsets[k] : graph.offsets[k + 1]] * (1, -1)
        cv2.polylines(mask, [np.round(line).astype(np.int32)], False, 255, 9)
    return mask


@pytest.mark.slow
@pytest.mark.parametrize(("share", "located"), [(0.42, False), (0.75, True)])
def test_a_piece_that_fits_is_no_place_where_most_of_the_frame_does_not(town, share, located):
    """As in Porto Alegre, where a quarter is like its mirror image: turned over, a mask of it was located at 10^8."""
    truth, size = camera((1900.0, 2000.0), (1300, 1300), 1.0, heading_deg=40.0), (1300, 1300)
    mask, stranger = drawn(town[0], truth, size), drawn(random_network(2, 4000.0), truth, size)
    kept = int(share * size[0])
    mask[:, kept:] = stranger[:, kept:]
    found = roadgeo.locate(mask, Reference(town[1]), LocateOptions(effort="quick"))
    assert found.located == located
    assert located or found.log10_odds <= 0.0
