"""Radial distortion: there and back, directions and derivatives against differences."""

import numpy as np
import pytest

from roadgeo.geometry.lens import Lens

SIZE = (1500, 1000)


def seen_points(lens):
    """Points that the lens shows: nothing beyond where a barrel folds over."""
    straight = np.random.default_rng(3).uniform((0, 0), SIZE, (200, 2))
    return lens.bend(straight), straight


@pytest.mark.parametrize("k1", [-0.2, -0.12, -0.01, 0.0, 0.05, 0.2])
def test_straightening_undoes_bending(k1):
    lens = Lens.of(k1, SIZE)
    seen, straight = seen_points(lens)
    assert lens.straighten(seen) == pytest.approx(straight, abs=1e-6)


def test_a_barrel_draws_corners_towards_the_middle_and_leaves_the_middle():
    lens = Lens.of(-0.12, (1000, 1000))
    points = lens.bend(np.array([[500.0, 500.0], [1000.0, 500.0], [1000.0, 1000.0]]))
    assert points == pytest.approx(np.array([[500, 500], [940, 500], [880, 880]]))


@pytest.mark.parametrize("k1", [-0.15, 0.1])
def test_directions_are_those_of_small_steps(k1):
    lens = Lens.of(k1, SIZE)
    seen, _ = seen_points(lens)
    angles = np.random.default_rng(4).uniform(0, np.pi, len(seen))
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    step = lens.straighten(seen + 1e-3 * directions) - lens.straighten(seen)
    turned = lens.straighten_directions(seen, directions)
    assert turned == pytest.approx(step / np.linalg.norm(step, axis=1, keepdims=True), abs=1e-5)


def test_nothing_is_seen_beyond_where_a_barrel_folds_over():
    lens = Lens.of(-0.12, SIZE)
    far = lens.straighten(np.array([[-4000.0, 500.0]]))
    assert np.isfinite(far).all()
    assert (lens.bend(far) > -100).all()
