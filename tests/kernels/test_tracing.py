"""Tracing finds every node and every chain once."""

from collections import Counter

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from kernels.test_thinning import depth, framed, random_states, thin_all
from naive import tracing as naive

from roadgeo.kernels.thinning import ROAD, shallow_first, thin
from roadgeo.kernels.tracing import smooth_chains, trace

Traced = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def traced(states: np.ndarray) -> Traced:
    pixels = np.flatnonzero(states == ROAD).astype(np.int32)
    return trace(states, pixels, np.empty(states.size, np.int32))


@given(random_states())
def test_trace_equals_its_slow_twin(states: np.ndarray) -> None:
    thin_all(states, 1.0)
    xy, is_open, edges, chain, offsets = traced(states)
    nodes, chains = naive.trace(states)
    centres = {tuple(np.round(np.mean(list(node), axis=0)[::-1], 9)): node for node in nodes}
    assert {tuple(np.round(p, 9)) for p in xy.tolist()} == set(centres)
    of = [centres[tuple(np.round(p, 9))] for p in xy.tolist()]
    assert [nodes[node] for node in of] == is_open.tolist()
    found = []
    for e, (a, b) in enumerate(edges.tolist()):
        way = [divmod(p, states.shape[1]) for p in chain[offsets[e] : offsets[e + 1]].tolist()]
        found.append((frozenset(way), frozenset([of[a], of[b]])))
    assert Counter(found) == Counter(chains)


def test_a_crossing_has_one_node_and_four_chains() -> None:
    states = framed("...#... ...#... ...#... ####### ...#... ...#... ...#...")
    xy, is_open, edges, chain, offsets = traced(states)
    assert is_open.tolist() == [True] * 4 + [False] or sorted(is_open.tolist()) == [False] + [True] * 4
    centre = int(np.flatnonzero(~is_open)[0])
    np.testing.assert_array_equal(xy[centre], (4, 4))
    assert len(edges) == 4
    assert (edges == centre).any(axis=1).all()
    assert len(chain) == offsets[-1] == 4


def test_a_ring_gets_one_node() -> None:
    states = framed("..... ..#.. .#.#. ..#.. .....")
    xy, is_open, edges, chain, _ = traced(states)
    assert edges.tolist() == [[0, 0]]
    assert len(xy) == 1
    assert not is_open[0]
    assert len(chain) == 3


def test_nothing_to_trace() -> None:
    xy, is_open, edges, chain, offsets = traced(framed("..... ....."))
    assert len(xy) == len(is_open) == len(edges) == len(chain) == 0
    assert offsets.tolist() == [0]


@given(random_states(), st.integers(0, 4), st.integers(1, 4), st.integers(0, 9))
def test_smooth_chains_equals_its_slow_twin(states: np.ndarray, passes: int, spacing: int, trim: int) -> None:
    distance = np.minimum(depth(states), 100)
    thin(states, distance, shallow_first(states, distance), 1.0, True)
    xy, _, edges, chain, offsets = traced(states)
    trims = (np.arange(2 * len(edges)).reshape(-1, 2) * trim) % 5
    ends = xy[edges].reshape(-1, 4)
    coords, starts = smooth_chains(distance, chain, offsets, ends, trims, passes, spacing)
    for e in range(len(edges)):
        pixels = [divmod(p, states.shape[1]) for p in chain[offsets[e] : offsets[e + 1]].tolist()]
        expected = naive.smooth_chain(distance, pixels, ends[e, :2], ends[e, 2:], trims[e], passes, spacing)
        np.testing.assert_allclose(coords[starts[e] : starts[e + 1]], expected, atol=1e-5)
    assert starts[-1] == len(coords)


def test_an_even_road_is_centred_between_two_pixels() -> None:
    states = np.zeros((20, 40), np.uint8)
    states[6:12, 2:38] = ROAD
    distance = cv2.distanceTransform(states, cv2.DIST_L2, 5)
    thin(states, distance, shallow_first(states, distance), 1.0, True)
    xy, _, edges, chain, offsets = traced(states)
    coords, _ = smooth_chains(distance, chain, offsets, xy[edges].reshape(-1, 4), np.zeros((1, 2), np.int64), 0, 1)
    middle = coords[np.abs(coords[:, 0] - 20) < 10]
    np.testing.assert_allclose(middle[:, 1], 8.5)
