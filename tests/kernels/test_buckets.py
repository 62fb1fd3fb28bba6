"""Nearest neighbours against brute force."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import kernels as naive

from roadgeo.kernels.buckets import nearest_neighbours
from roadgeo.matching.index import neighbour_grid, sort_by_bucket


def sorted_points(xy, bucket=1.0):
    grid, shape = neighbour_grid(xy, bucket)
    order, starts = sort_by_bucket(xy, grid, shape)
    return np.ascontiguousarray(xy[order]), starts, grid, shape


def check(xy, k, bucket=1.0):
    xy, starts, grid, shape = sorted_points(np.asarray(xy, float), bucket)
    found = nearest_neighbours(xy, starts, grid, shape, k)
    assert found.shape == (len(xy), k)
    assert found.dtype == np.int32
    assert not (found == np.arange(len(xy))[:, None]).any()
    assert all(len(set(row[row >= 0].tolist())) == (row >= 0).sum() for row in found)
    distance = np.where(found >= 0, np.hypot(*(xy[found] - xy[:, None]).transpose(2, 0, 1)), np.nan)
    assert np.allclose(distance, naive.nearest_neighbours(xy, k), atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("bucket", [1.0, 30.0, 1e4])
@pytest.mark.parametrize("spread", [(1000, 1000), (1000, 3), (5, 2000)])
def test_random_points(bucket, spread):
    check(np.random.default_rng(3).uniform(0, spread, (150, 2)), 8, bucket)


def test_clusters_far_apart():
    rng = np.random.default_rng(5)
    check(np.vstack([rng.normal(0, 2, (40, 2)), rng.normal(5000, 2, (5, 2)), [[-9000, 400]]]), 8)


@pytest.mark.parametrize("n", [1, 2, 5, 8, 9])
def test_fewer_points_than_neighbours(n):
    check(np.random.default_rng(n).uniform(0, 100, (n, 2)), 8)


def test_points_on_one_another_and_on_a_line():
    check([[5, 5]] * 4, 3)
    check([[float(x), 7.0] for x in range(30)], 4)


@given(st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=1, max_size=40), st.integers(1, 9))
def test_any_lattice_points(points, k):
    check(points, k, 7.0)
