"""How exact a change of datum is, by what PROJ says of the best way that it has the grids for."""

import math

import pytest

from roadgeo.geometry import transformation
from roadgeo.geometry.projection import choose_plane
from roadgeo.geometry.transformation import LONLAT, Exactness, exactness

NORWICH, KASSEL, PORTO = (1.31, 52.63), (9.5, 51.3), (-8.6, 41.1)


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch) -> None:
    """PROJ without further grids."""
    import pyproj.network

    transformation._exactness.cache_clear()
    before = pyproj.network.is_network_enabled()
    pyproj.network.set_network_enabled(False)
    yield
    pyproj.network.set_network_enabled(before)
    transformation._exactness.cache_clear()


def test_one_datum_is_exact() -> None:
    for crs in ("EPSG:32629", "EPSG:3857", LONLAT, choose_plane([[-110.0, 35.0], [-90.0, 45.0]]).crs):
        assert exactness(crs, LONLAT, PORTO) == Exactness(0.0)
        assert exactness(LONLAT, crs, PORTO) == Exactness(0.0)
    assert exactness("EPSG:27700", "EPSG:27700", NORWICH) == Exactness(0.0)


def test_of_a_datum_that_moves_with_its_plate_nothing_better_is_known() -> None:
    found = exactness("EPSG:25829", LONLAT, PORTO)  # ETRS89
    assert (found.sigma_m, found.grids, found.told("x")) == (1.0, (), "")


@pytest.mark.parametrize(
    ("crs", "lonlat", "grid"),
    [("EPSG:27700", NORWICH, "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"), ("EPSG:31467", KASSEL, "de_adv_BETA2007.tif")],
)
def test_a_missing_grid_is_named_with_what_it_is_worth(
    lacking: None, crs: str, lonlat: tuple[float, float], grid: str
) -> None:
    for other in (LONLAT, "EPSG:3857"):
        found = exactness(crs, other, lonlat)
        assert 1.0 < found.sigma_m < 6.0
        assert found.grids == (grid,)
        assert found.better_m < found.sigma_m
    reported = found.told("longitude and latitude")
    assert reported.startswith(
        f"longitude and latitude are good to {found.sigma_m:g} m only: PROJ lacks the grid {grid}"
    )
    assert reported.endswith(f"get it by `pyproj sync --file {grid}`, or set PROJ_NETWORK=ON")


def test_what_nobody_knows_is_said() -> None:
    found = exactness("+proj=tmerc +lon_0=-9 +ellps=bessel +type=crs", LONLAT, PORTO)
    assert math.isnan(found.sigma_m)
    assert found.told("places") == "places are not known how exact: PROJ knows no way from datum to datum"


def test_roads_that_leave_their_datum_for_a_plane_are_told_of(lacking: None, caplog: pytest.LogCaptureFixture) -> None:
    lonlat = [[x, y] for x in (1.2, 1.4) for y in (52.5, 52.7)]
    assert choose_plane(lonlat, "EPSG:27700").crs == "EPSG:27700"
    assert not caplog.records
    assert choose_plane(lonlat, "EPSG:4277").crs == "EPSG:32631"
    assert "places of EPSG:4277 in EPSG:32631 are good to 2 m only: PROJ lacks the grid uk_os_OSTN15" in caplog.text
