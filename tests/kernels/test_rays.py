"""Branches compared by products, against branches compared by angles."""

import numpy as np
import pytest
from naive import kernels as naive

from roadgeo.kernels.rays import rays_agree

IDENTITY = (1.0, 0.0, 0.0, 1.0)
TOLERANCE = np.radians(25)


def packed(*degrees, columns=8):
    """(1, R, 2) int8 branches of one intersection."""
    out = np.zeros((1, columns, 2), np.int8)
    angle = np.radians(np.array(degrees, float))
    out[0, : len(degrees)] = np.round(127 * np.stack([np.cos(angle), np.sin(angle)], -1)).reshape(-1, 2)
    return out


def agree(a, b, jacobian=IDENTITY, tolerance=TOLERANCE):
    return rays_agree(a, 0, b, 0, *jacobian, np.cos(tolerance))


@pytest.mark.parametrize(
    ("query", "reference", "expected"),
    [
        ((0, 90, 180), (0, 90, 180), True),
        ((0, 90, 180), (10, 80, -170), True),  # across the half turn
        ((0, 90, 180), (0, 90), True),  # the poorer side is served
        ((0, 90), (0, 90, 180, 270), True),
        ((0, 90, 180), (0, 60, 180), False),
        ((0, 90, 180), (0, 90, 270), False),
        ((0, 20, 180), (10, 120, 180), False),  # no partner serves two
        ((), (0, 90, 180), True),
        ((0, 90, 180), (), True),
        ((), (), True),
    ],
)
def test_pairs_of_intersections(query, reference, expected):
    assert agree(packed(*query), packed(*reference)) is expected


@pytest.mark.parametrize("turn", [0, 37, 120, 181, 359])
def test_the_jacobian_turns_branches(turn):
    c, s = 3 * np.cos(np.radians(turn)), 3 * np.sin(np.radians(turn))
    assert agree(packed(0, 100, 200), packed(turn, 100 + turn, 200 + turn), (c, -s, s, c))
    assert not agree(packed(0, 100, 200), packed(60 + turn, 150 + turn, 260 + turn), (c, -s, s, c))


def test_like_the_twin():
    rng = np.random.default_rng(1)
    decided = 0
    for _ in range(2000):
        query = packed(*rng.uniform(0, 360, rng.integers(0, 9)))
        reference = packed(*rng.uniform(0, 360, rng.integers(0, 9)))
        J = rng.normal(0, 1, (2, 2))
        tolerance = rng.uniform(0.35, 0.6)
        found = agree(query, reference, tuple(J.ravel()), tolerance)
        # Rounded to integers, branches are not equally long: a cosine is right to half a percent, an angle to a degree.
        strict, lax = (naive.rays_agree(query, 0, reference, 0, J, tolerance + e) for e in (-0.02, 0.02))
        if strict == lax:
            decided += 1
            assert found == strict
    assert decided > 1500


def test_a_full_intersection_uses_every_column():
    eight = packed(*range(0, 360, 45))
    assert agree(eight, eight)
