import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pyproj import CRS, Geod

from roadgeo.errors import CrsError
from roadgeo.geometry.projection import LocalPlane, choose_plane, from_lonlat, serves_as_plane, to_lonlat


def spread(lon, lat, width=0.2, height=0.2):
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, 5), np.linspace(-height / 2, height / 2, 5))
    return np.stack(((lon + x.ravel() + 180) % 360 - 180, lat + y.ravel()), axis=1)


@pytest.mark.parametrize(
    ("lon", "lat", "crs"),
    [
        (-71.06, 42.34, "EPSG:32619"),
        (-8.6, 41.15, "EPSG:32629"),
        (151.2, -33.9, "EPSG:32756"),
        (0.01, 0.0, "EPSG:32631"),
        (-0.2, 51.5, "EPSG:32630"),
        (179.95, -16.8, "EPSG:32760"),
        (180.0, -16.8, "EPSG:32701"),
        (-179.99, 66.0, "EPSG:32601"),
        (15.6, 78.2, "EPSG:32633"),
        (30.0, 88.0, "EPSG:5041"),
        (166.7, -84.0, "EPSG:5042"),
        (365.0, 45.0, "EPSG:32631"),
    ],
)
def test_the_plane_follows_the_data(lon, lat, crs):
    plane = choose_plane(spread(lon, lat))
    assert plane.crs == crs
    xy = from_lonlat(plane, spread(lon, lat))
    assert np.abs(xy).max() < 30_000


def test_data_astride_the_antimeridian_is_one_piece():
    lonlat = np.array([[179.9, -17.0], [-179.9, -17.0], [180.0, -16.9]])
    xy = from_lonlat(choose_plane(lonlat), lonlat)
    expected = Geod(ellps="WGS84").line_length([179.9, 180.1], [-17, -17])
    assert np.hypot(*(xy[0] - xy[1])) == pytest.approx(expected, rel=1e-3)


def test_data_wider_than_a_zone_gets_its_own_plane():
    lonlat = spread(-100, 40, width=20, height=10)
    plane = choose_plane(lonlat)
    crs = CRS(plane.crs)
    assert plane.crs.startswith('PROJCRS["Oblique stereographic, 40 N, 100 W"')
    assert crs.to_authority() is None
    assert {axis.unit_name for axis in crs.axis_info} == {"metre"}
    np.testing.assert_allclose(to_lonlat(plane.crs, plane.to_crs(from_lonlat(plane, lonlat))), lonlat, atol=1e-8)


def test_data_a_little_wider_than_a_zone_stays_in_utm():
    assert choose_plane(spread(9.5, 52, width=7)).crs == "EPSG:32632"


@pytest.mark.parametrize(
    ("lonlat", "message"),
    [
        (np.empty((0, 2)), "no coordinates"),
        ([[236000.0, 900000.0]], "coordinates reach 900000, expected degrees"),
        ([[10.0, 91.0]], "expected degrees"),
        ([[np.nan, 10.0], [3.0, 4.0]], "1 of 2 coordinates are NaN; mend them"),
        ([[np.inf, 10.0]], "coordinates reach inf, expected degrees"),
    ],
)
def test_what_is_not_degrees_is_refused(lonlat, message):
    with pytest.raises(CrsError, match=message):
        choose_plane(lonlat)


def test_an_unknown_crs_is_named():
    with pytest.raises(CrsError, match="no transformation from EPSG:999999 to EPSG:4326"):
        to_lonlat("EPSG:999999", [[0, 0]])


def test_the_plane_is_a_shift_of_its_crs():
    plane = LocalPlane("EPSG:32619", (330_000.0, 4_690_000.0))
    xy = np.array([[12.5, -7.25]])
    np.testing.assert_array_equal(plane.from_crs(plane.to_crs(xy)), xy)
    np.testing.assert_allclose(plane.to_crs_matrix() @ [12.5, -7.25, 1], [*plane.to_crs(xy)[0], 1])


@given(st.floats(-180, 180), st.floats(-89, 89), st.floats(0.01, 15), st.floats(0.01, 10))
def test_any_region_goes_there_and_back_with_true_angles(lon, lat, width, height):
    assume(abs(lat) + height / 2 < 89.5)
    lonlat = spread(lon, lat, width, height)
    plane = choose_plane(lonlat)
    xy = from_lonlat(plane, lonlat)
    back = to_lonlat(plane.crs, plane.to_crs(xy))
    assert np.abs((back[:, 0] - lonlat[:, 0] + 180) % 360 - 180).max() < 1e-7
    assert np.abs(back[:, 1] - lonlat[:, 1]).max() < 1e-7
    # conformal: a small step east and one north are perpendicular and, on the ground, equally scaled
    here = lonlat[7]
    geod = Geod(ellps="WGS84")
    steps = [geod.fwd(*here, azimuth, 100.0)[:2] for azimuth in (90.0, 0.0)]
    east, north = from_lonlat(plane, np.array(steps)) - from_lonlat(plane, here[None])
    assert abs(east @ north) / (np.hypot(*east) * np.hypot(*north)) < 1e-3
    assert np.hypot(*east) == pytest.approx(np.hypot(*north), rel=2e-3)
    assert np.hypot(*east) == pytest.approx(100.0, rel=0.03)


@pytest.mark.parametrize(
    ("crs", "lonlat", "kept"),
    [
        ("EPSG:26986", [[-71.2, 42.2], [-70.9, 42.4]], True),  # Massachusetts, metres
        ("EPSG:2249", [[-71.2, 42.2], [-70.9, 42.4]], False),  # the same in feet
        ("EPSG:26986", [[120.0, -20.0], [120.1, -20.1]], False),  # far from where it is meant for
        ("EPSG:2154", [[2.0, 48.0], [8.0, 43.0]], True),  # France
        ("EPSG:2056", [[7.0, 47.0], [8.0, 46.0]], True),  # Switzerland
        ("EPSG:27700", [[-2.0, 52.0], [0.0, 51.0]], True),  # Great Britain
        ("EPSG:3035", [[4.0, 50.0], [4.2, 50.1]], True),  # equal area, near enough to its middle
        ("EPSG:3035", [[-8.6, 41.1], [-8.5, 41.2]], False),  # equal area: angles are off by a degree in Porto
        ("EPSG:3857", [[-71.2, 42.2], [-70.9, 42.4]], False),
        ("EPSG:3857", [[10.0, 0.0], [10.1, 0.1]], False),  # not conformal even at the equator
        ("EPSG:4326", [[-71.2, 42.2], [-70.9, 42.4]], False),
        ("EPSG:2053", [[29.0, -26.0], [29.1, -26.1]], False),  # axes west and south
    ],
)
def test_a_projected_source_keeps_its_crs_where_that_is_true_enough(crs, lonlat, kept):
    points = np.array(lonlat)
    assert serves_as_plane(crs, points) is kept
    assert (choose_plane(points, crs).crs == crs) is kept
