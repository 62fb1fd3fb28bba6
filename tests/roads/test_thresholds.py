"""Thresholds of values of every kind: within them, or refused in a line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from roadgeo._arrays import AnyArray
from roadgeo.errors import MaskError
from roadgeo.roads.thresholds import Sample, find_numbered, find_thresholds

KINDS = st.sampled_from([np.uint8, np.int16, np.int32, np.float32, np.float64])


@given(st.data())
def test_thresholds_lie_among_the_values(data: st.DataObject) -> None:
    kind = data.draw(KINDS)
    numbers = st.floats(-(2.0**100), 2.0**100, width=32) if np.dtype(kind).kind == "f" else None
    few = data.draw(arrays.arrays(kind, data.draw(st.integers(1, 12)), elements=numbers))
    rows: AnyArray = np.resize(few, (12, 12))
    try:
        found = find_thresholds(Sample("it", rows.reshape(-1, 1), 0, lambda: rows))
    except MaskError:
        return
    low, high = float(rows.min()), float(rows.max())
    assert 1 <= len(found) <= 3
    assert all(np.isfinite(result) and min(low, np.nextafter(low, -np.inf)) <= result <= high for result in found)


def test_values_that_differ_by_rounding_are_refused() -> None:
    rows: AnyArray = np.resize(1e16 + np.arange(3) * 2.0, (12, 12))
    with pytest.raises(MaskError, match=r"it: 3 values from 1e\+16 to 1e\+16, too alike to part; give a threshold"):
        find_thresholds(Sample("it", rows.reshape(-1, 1), 0, lambda: rows))


@pytest.mark.parametrize("width", [3, 6, 10, 16, 30])
@pytest.mark.parametrize("size", [2, 4])
def test_smooth_edges_are_no_numbers_of_roads(width: int, size: int) -> None:
    y, x = np.mgrid[: 400 * size, : 400 * size] / size
    lines = [abs(x + slope * y - at) for slope, at in ((0.1, 90), (-0.2, 300))]
    lines += [abs(y + slope * x - at) for slope, at in ((0.05, 120), (-0.1, 260))]
    fine = np.minimum.reduce(lines) < width / 2
    rows = np.round(255 * fine.reshape(400, size, 400, size).mean((1, 3))).astype(np.uint8)
    sample = Sample("it", rows.reshape(-1, 1), 0, lambda: rows)
    assert len(sample.levels) > 2
    assert find_numbered(sample) is None
    assert find_thresholds(sample)[0] == 127.0
