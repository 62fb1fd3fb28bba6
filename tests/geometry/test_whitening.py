"""Weights from covariances, those that rounding has spoiled among them."""

import numpy as np
import pytest

from roadgeo.geometry.pinhole import make_view
from roadgeo.geometry.pose import find_pose
from roadgeo.geometry.whitening import whitener


def spoiled(seed: int) -> np.ndarray:
    """A covariance (8, 8), square metres, of corners towards the horizon: computed, it is none any more."""
    rng = np.random.default_rng(seed)
    root = np.linalg.qr(rng.normal(size=(8, 8)))[0] * np.array([1e7, 1e6, 1e3, 10.0, 1.0, 0.3, 0.1, 1e-3])
    return root @ root.T


def test_errors_come_out_independent():
    root = np.random.default_rng(2).normal(size=(8, 8))
    w = whitener(root @ root.T)
    assert w @ root @ root.T @ w.T == pytest.approx(np.eye(8), abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_variances_that_rounding_makes_negative_are_raised(seed):
    covariance = spoiled(seed)
    w = whitener(covariance)
    assert np.isfinite(w).all()
    assert (np.einsum("ij,jk,ik->i", w, covariance, w) < 2.0).all()  # none counts for more than it is sure of


@pytest.mark.parametrize("seed", range(6))
def test_a_camera_is_found_behind_corners_that_are_hardly_known(seed):
    homography = make_view((0.0, 0.0), (900, 900), 1.0, 50.0, 10.0, 20.0).homography.matrix
    found = find_pose(homography, (900, 900), spoiled(seed))
    assert found is None or np.isfinite(found.covariance).all()
