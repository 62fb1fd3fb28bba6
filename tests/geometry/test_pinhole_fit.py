"""A pinhole fitted to the corners of its frame, against scipy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import pinhole_fit as naive

from roadgeo.geometry.pose import SeenCorners, _place, fit_pinhole, pinhole_residuals

LOG_FOCAL = np.log(1100.0)
PIXELS = np.array([[-600.0, 450.0], [600.0, 450.0], [600.0, -450.0], [-600.0, -450.0]])


def corners_of(p, seed=0, spread=0.3, sigma=0.45):
    """What a pinhole sees, some tenths of a metre off, with weights that are not alike."""
    rng = np.random.default_rng(seed)
    nothing = SeenCorners(PIXELS, np.zeros((4, 2)), np.eye(8), LOG_FOCAL, sigma)
    ground = naive.pinhole_residuals(p, nothing)[:8].reshape(4, 2)
    weights = np.eye(8) / max(spread, 0.1) + rng.normal(0, 0.3, (8, 8))
    return SeenCorners(PIXELS, ground + rng.normal(0, spread, (4, 2)), weights, LOG_FOCAL, sigma)


def pinhole(tilt=0.3, heading=1.0, focal=0.1):
    return np.array([40.0, -70.0, np.log(0.6), heading, tilt * 0.8, -tilt * 0.6, LOG_FOCAL + focal])


@given(st.floats(-1.2, 1.2), st.floats(-3.0, 3.0), st.floats(-0.5, 0.5))
def test_it_stands_and_points_like_the_twin(tilt: float, heading: float, focal: float) -> None:
    p = np.stack([pinhole(tilt, heading, focal), pinhole(0.0)])
    positions, rotations = _place(p, LOG_FOCAL)
    for item, position, rotation in zip(p, positions, rotations, strict=True):
        expected = naive.place_pinholes(item, LOG_FOCAL)
        assert position == pytest.approx(expected[0], abs=1e-8)
        assert rotation == pytest.approx(expected[1], abs=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 0.4, 0.9, 1.5])
def test_it_sees_corners_like_the_twin(tilt: float) -> None:
    corners = corners_of(pinhole(0.3))
    expected = naive.pinhole_residuals(pinhole(tilt), corners)
    assert pinhole_residuals(pinhole(tilt), corners) == pytest.approx(
        np.full(9, np.inf) if expected is None else expected
    )
    assert (expected is None) == (tilt > 1.2)  # a corner lies above the horizon


@pytest.mark.parametrize("tilt", [0.0, 0.2, 0.7])
@pytest.mark.parametrize("sigma", [0.45, 1e-3])
def test_it_is_fitted_like_the_twin(tilt: float, sigma: float) -> None:
    corners = corners_of(pinhole(tilt), 3, sigma=sigma)
    starts = np.stack([pinhole(tilt + away, 1.0 + away, 2 * away) for away in (0.2, 0.1, -0.2)] + [pinhole(1.5)])
    p, covariance = fit_pinhole(starts, corners, 50)
    seen = [(naive.pinhole_residuals(s, corners), s) for s in starts]
    _, best = min(((np.sum(r**2), s) for r, s in seen if r is not None), key=lambda item: item[0])
    expected, spread = naive.fit_pinhole(best, corners, 700.0)
    assert np.sum(naive.pinhole_residuals(p, corners) ** 2) == pytest.approx(
        np.sum(naive.pinhole_residuals(expected, corners) ** 2), rel=1e-5, abs=1e-9
    )
    assert (np.abs(p - expected) < 0.02 * np.sqrt(np.diag(spread))).all()
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(spread)), rel=0.02)


def test_nothing_is_fitted_where_no_start_sees_the_corners() -> None:
    corners = corners_of(pinhole())
    assert fit_pinhole(pinhole(1.5)[None], corners, 30) is None
    assert fit_pinhole(np.empty((0, 7)), corners, 30) is None
