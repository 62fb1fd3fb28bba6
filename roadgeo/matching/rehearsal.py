"""Compile or load all kernels on dummy data, so that compilation is not charged to a query's time limit."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from roadgeo.geometry.mask import RoadMask
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.query import trace_query

__all__ = ["rehearse_search", "rehearse_tracing"]

_rehearsed = False


@lru_cache(maxsize=1)
def rehearse_tracing() -> None:
    """Compile or load the kernels that trace a mask, once a process."""
    canvas = np.zeros((160, 160), np.uint8)
    for k in range(11):  # crossings, forks, near parallels: each kernel has its turn
        cv2.line(canvas, (7, 3 + 15 * k), (150, 97 * k % 160), 1, 3)
    trace_query(RoadMask(canvas > 0))


def rehearse_search(estimator: TripleEstimator) -> None:
    """Compile or load the kernels of a search, once a process."""
    global _rehearsed
    if not _rehearsed:
        estimator.rehearse()
        _rehearsed = True
