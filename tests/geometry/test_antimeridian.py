import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer

from roadgeo.geometry.antimeridian import bounds_of, cut_ring, holds_pole, unwrap_ring

BOX = np.array([(0, 0), (2, 0), (2, 1), (0, 1)], float)


def moved(lon, lat):
    """A box of 2 x 1 degrees whose middle lies there, as other programs give it: within ±180."""
    ring = BOX - (1, 0.5) + (lon, lat)
    ring[:, 0] = (ring[:, 0] + 180) % 360 - 180
    return ring


@pytest.mark.parametrize("closed", [False, True])
def test_a_ring_that_lies_nowhere_special_is_only_closed(closed):
    ring = moved(10, 50)
    given_ring = np.vstack((ring, ring[:1])) if closed else ring
    (part,) = cut_ring(given_ring)
    np.testing.assert_array_equal(part, np.vstack((ring, ring[:1])))
    assert bounds_of(given_ring) == (9, 49.5, 11, 50.5)


def test_a_ring_astride_180_degrees_is_cut_there():
    ring = moved(179.5, -17)
    assert unwrap_ring(ring)[:, 0].tolist() == [178.5, 180.5, 180.5, 178.5, 178.5]
    west, east = map(shapely.Polygon, cut_ring(ring))
    assert (west.bounds, east.bounds) == ((178.5, -17.5, 180, -16.5), (-180, -17.5, -179.5, -16.5))
    assert west.exterior.is_ccw
    assert east.exterior.is_ccw
    assert bounds_of(ring) == (178.5, -17.5, -179.5, -16.5)


def around_pole(radius, south, start):
    """A circle around a point 100 m from a pole, counterclockwise as seen from above."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False) + start
    xy = np.column_stack((100 + radius * np.cos(angle), radius * np.sin(angle))) + 2_000_000
    crs = "EPSG:5042" if south else "EPSG:5041"
    return np.stack(Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*xy.T), axis=1)


@pytest.mark.parametrize("south", [False, True])
@given(start=st.floats(-7, 7))
def test_a_ring_around_a_pole_is_closed_over_it(south, start):
    ring = around_pole(500, south, start)
    assert holds_pole(ring)
    (part,) = cut_ring(ring)
    polygon = shapely.Polygon(part)
    assert polygon.is_valid
    assert polygon.exterior.is_ccw
    assert part[:, 0].min() == pytest.approx(-180)
    assert part[:, 0].max() == pytest.approx(180)
    pole = -90 if south else 90
    assert polygon.covers(shapely.Point(77, pole + (0.001 if south else -0.001)))
    west, low, east, high = bounds_of(ring)
    assert (west, east) == (-180, 180)
    assert (low if south else high) == pole


@pytest.mark.parametrize("south", [False, True])
@given(start=st.floats(-7, 7))
def test_a_ring_beside_a_pole_holds_none(south, start):
    ring = around_pole(90, south, start)
    assert not holds_pole(ring)
    assert all(shapely.Polygon(part).is_valid for part in cut_ring(ring))


@given(st.floats(-180, 180), st.floats(-80, 80))
def test_parts_keep_the_area_and_lie_within_180(lon, lat):
    parts = [shapely.Polygon(part) for part in cut_ring(moved(lon, lat))]
    assert sum(part.area for part in parts) == pytest.approx(2)
    bounds = np.array([part.bounds for part in parts])
    assert np.abs(bounds[:, [0, 2]]).max() <= 180
