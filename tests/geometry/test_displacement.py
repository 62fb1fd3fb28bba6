"""Displacements on frames that were moved by known amounts."""

import numpy as np
import pytest

from roadgeo.geometry.displacement import measure

FRAME = np.array([[0.0, 800.0], [1000.0, 800.0], [1000.0, 0.0], [0.0, 0.0]])


def moved(east: float, north: float, clockwise_deg: float, scale: float) -> np.ndarray:
    turn = -np.radians(clockwise_deg)
    rotation = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    middle = FRAME.mean(axis=0)
    return (FRAME - middle) @ rotation.T + middle + (east, north)


@pytest.mark.parametrize("given", [(0, 0, 0, 1), (12, -7, 0, 1), (-300, 250, 4.9, 0.98), (1, 2, -30, 1.3)])
def test_a_similarity_is_told_as_it_is(given: tuple[float, float, float, float]) -> None:
    found = measure(FRAME, moved(*given), np.eye(8))
    assert (found.east_m, found.north_m, found.turn_deg, found.scale) == pytest.approx(given, abs=1e-9)
    assert found.residual_m == pytest.approx(0.0, abs=1e-9)
    mapped = FRAME @ found.matrix[:2, :2].T + found.matrix[:2, 2]
    assert mapped == pytest.approx(moved(*given), abs=1e-9)


def test_what_is_no_similarity_is_left_over() -> None:
    bent = FRAME + np.array([[3, 0], [-3, 0], [3, 0], [-3, 0]])
    found = measure(FRAME, bent, np.eye(8))
    assert found.residual_m == pytest.approx(3.0)
    assert found.over(FRAME) == pytest.approx(0.0, abs=1e-9)


def test_its_covariance_is_that_of_many_trials() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(0, 0.5, (1500, 4, 2))
    trials = [measure(FRAME, FRAME + error, np.eye(8) * 0.25) for error in errors]
    values = np.array([[t.east_m, t.north_m, -np.radians(t.turn_deg), t.scale] for t in trials])
    assert values.var(axis=0) == pytest.approx(np.diag(trials[0].covariance), rel=0.15)
    assert np.mean([t.significance for t in trials]) == pytest.approx(4.0, rel=0.1)


def test_how_far_it_moves_a_frame_is_the_mean_over_its_ground() -> None:
    found = measure(FRAME, moved(3.0, 4.0, 1.0, 1.0), np.eye(8))
    inside = np.random.default_rng(1).uniform((0, 0), (1000, 800), (20000, 2))
    gaps = inside @ found.matrix[:2, :2].T + found.matrix[:2, 2] - inside
    assert found.over(FRAME) == pytest.approx(np.sqrt(np.mean(np.sum(gaps**2, axis=1))), rel=0.02)
