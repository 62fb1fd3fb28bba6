"""Roads alongside road points, against a slow twin. (The other kernels are tested with `roads.simplification`.)"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from naive import simplification as naive

from roadgeo.kernels.parallel_roads import roads_alongside


@given(st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_like_the_twin(n, seed):
    rng = np.random.default_rng(seed)
    angle = rng.choice([0.3, 0.5, 2.0], n) + rng.choice([0.0, np.pi], n)
    xy, along = rng.uniform(0, 60, (n, 2)), np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reach, out = rng.uniform(0, 10, n), np.empty((n, 2))
    roads_alongside(xy, along, reach, 3.0, 30.0, 0.9, out)
    np.testing.assert_allclose(out, naive.roads_alongside(xy, along, reach, 3.0, 30.0, 0.9), atol=1e-9)


def test_two_roads_side_by_side():
    columns = np.arange(0.0, 100.0, 10.0)
    xy = np.concatenate([np.stack([columns, np.zeros(10)], 1), np.stack([columns + 4.0, np.full(10, 12.0)], 1)])
    along, out = np.tile([1.0, 0.0], (20, 1)), np.empty((20, 2))
    along[10:] *= -1.0
    roads_alongside(xy, along, np.full(20, 5.5), 3.0, 30.0, 0.9, out)
    np.testing.assert_allclose(out, np.repeat([[0.0, 12.0], [0.0, -12.0]], 10, axis=0), atol=1e-12)
