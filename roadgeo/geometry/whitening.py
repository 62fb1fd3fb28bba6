"""Weights from a covariance, however badly known some directions are."""

from __future__ import annotations

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = ["whitener"]

#: Variances below this part of the greatest are errors of rounding.
_LEAST = 1e-14


def whitener(covariance: FloatArray) -> FloatArray:
    """Return W (N, N) that makes errors of a covariance (N, N) independent, each of variance 1: W' W is its inverse.

    Variances of corners near the horizon differ by orders of magnitude; those that rounding made negative are raised.
    """
    variances, directions = np.linalg.eigh(covariance)
    return np.asarray((directions / np.sqrt(np.maximum(variances, _LEAST * variances[-1]))).T)
