import json
from dataclasses import replace

import numpy as np
import pytest
from worlds.answers import placed, sure_to, with_place

from roadgeo.errors import NotLocatedError
from roadgeo.location import ERROR_RATES, Content, ErrorRate, Location
from roadgeo.outputs.location_document import read_answer

REASON = "only 3 intersections are seen, at least 6 are needed"
REFUSED = Location("field.png", "not_located", REASON, content=Content((400, 300)))
#: 0.5 m per pixel, north up, and with the sign of w turned about.
H = -np.array([[0.5, 0.0, 331_000.0], [0.0, -0.5, 4_690_000.0], [0.0, 0.0, 1.0]])
LOCATED = replace(
    REFUSED,
    status="located",
    reason="40 of 50 intersections agree",
    reference="boston <&>",
    places=(placed(H, "EPSG:32619", score=12.5, corner_covariance_m2=sure_to(*[0.7] * 4)),),
)
FOOTPRINT = [[331_000, 4_690_000], [331_200, 4_690_000], [331_200, 4_689_850], [331_000, 4_689_850]]


def test_all_follows_from_the_homography():
    np.testing.assert_allclose(LOCATED.footprint, FOOTPRINT)
    np.testing.assert_allclose(LOCATED.footprint_lonlat[0], [-71.051672, 42.343911], atol=1e-5)
    assert LOCATED.center[:2] == (331_100.0, 4_689_925.0)
    assert (LOCATED.gsd_m, LOCATED.mirrored) == (pytest.approx(0.5), False)
    assert LOCATED.camera.height_m > 100.0
    assert REFUSED.place is REFUSED.center is REFUSED.camera is None


def lonlat_known_to(metres):
    location = with_place(LOCATED)
    vars(location.place)["lonlat_accuracy_m"] = metres
    return location


def test_longitude_and_latitude_are_as_unsure_as_the_way_to_them():
    assert LOCATED.lonlat_sigma_m == pytest.approx(LOCATED.corner_sigma_m)
    document = lonlat_known_to(2.4).to_dict()
    assert document["lonlat_sigma_m"] == pytest.approx([2.5] * 4)
    assert document["corner_sigma_m"] == pytest.approx([0.7] * 4)
    assert document["lonlat_accuracy_m"] == 2.4
    unknown = lonlat_known_to(np.nan).to_dict()
    assert unknown["lonlat_sigma_m"] is unknown["lonlat_accuracy_m"] is None


def test_a_location_says_the_answer_in_one_line():
    assert repr(REFUSED) == "<Location 'field.png': not_located, only 3 intersections are seen, at least 6 are needed>"
    lon, lat = LOCATED.center[2:]
    expected = f"<Location 'field.png': located at {lat:.6f}, {lon:.6f} on boston <&>, score 12.5>"
    assert repr(LOCATED) == expected
    shown = LOCATED._repr_html_()
    assert "boston &lt;&amp;&gt;" in shown
    assert "0.7 m at most" in shown
    assert "<tr>" in REFUSED._repr_html_()


@pytest.mark.parametrize(
    ("location", "score"),
    [
        (LOCATED, 8.0),
        (with_place(LOCATED, score=3.5), 3.5),
        (with_place(LOCATED, score=4.99), 3.5),
        (with_place(LOCATED, score=99.0), 15.0),
        (with_place(LOCATED, score=3.4), None),  # a lower threshold was asked for: nothing was counted there
        (replace(LOCATED, status="ambiguous"), None),
        (with_place(LOCATED, score=np.nan), None),
        (REFUSED, None),
    ],
)
def test_a_place_tells_how_often_such_places_were_wrong(location, score):
    rate = location.error_rate
    assert (None if rate is None else rate.score) == score
    assert location.to_dict()["error_rate"] == (
        None if rate is None else {"kind": "mask", **rate._asdict(), "said": str(rate)}
    )


def test_pixels_go_to_the_map_and_back():
    pixels = np.array([[0.0, 0.0], [400.0, 300.0], [12.5, 7.25]])
    there = LOCATED.pixel_to_map(pixels)
    np.testing.assert_allclose(there[:2], LOCATED.footprint[[0, 2]])
    np.testing.assert_allclose(LOCATED.map_to_pixel(there), pixels, atol=1e-6)
    for way in (REFUSED.pixel_to_map, REFUSED.map_to_pixel):
        with pytest.raises(NotLocatedError, match=r"field.png has no place: only 3 intersections"):
            way(pixels)


def test_a_location_is_a_feature_to_other_libraries():
    import geopandas as gpd
    import shapely

    feature = LOCATED.__geo_interface__
    ring = shapely.geometry.shape(feature["geometry"])
    assert ring.is_valid
    assert len(feature["geometry"]["coordinates"][0]) == 5
    assert feature["properties"]["status"] == "located"
    assert feature["properties"]["log10_odds"] == 12.5
    assert REFUSED.__geo_interface__["geometry"] is None
    table = LOCATED.to_geodataframe()
    assert isinstance(table, gpd.GeoDataFrame)
    assert table.crs == "EPSG:32619"
    assert table.area[0] == pytest.approx(200 * 150, rel=1e-3)
    assert len(REFUSED.to_geodataframe()) == 1


@pytest.mark.parametrize("azimuth_deg", [0.0, 30.0, 90.0, 150.0])
def test_the_middle_is_least_known_along_the_road_that_is_seen(azimuth_deg: float) -> None:
    along = np.array([np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))])
    shift = np.tile(along, 4)  # all corners move together
    covariance = 100.0**2 * np.outer(shift, shift) + 4.0**2 * 4.0 * np.eye(8)
    error = with_place(LOCATED, corner_covariance_m2=covariance).center_error
    assert error is not None
    assert error.along_m == pytest.approx(100.0, rel=0.01)
    assert error.across_m == pytest.approx(4.0, rel=0.01)
    assert abs((error.azimuth_deg - azimuth_deg + 90.0) % 180.0 - 90.0) < 0.01
    assert with_place(LOCATED, corner_covariance_m2=None).center_error is None


@pytest.mark.parametrize("kind", ERROR_RATES)
def test_a_rate_is_that_of_its_kind_of_query_and_comes_back_from_the_file(tmp_path, kind):
    location = replace(LOCATED, content=replace(LOCATED.content, kind=kind))
    path = tmp_path / "a_location.json"
    path.write_text(json.dumps(location.to_dict()), encoding="utf-8")
    assert location.error_rate in ERROR_RATES[kind]
    assert read_answer(path).error_rate == location.error_rate


@pytest.mark.parametrize(("at_most", "n"), [(0.304, "3"), (0.0291, "34"), (0.00156, "640"), (0.0000123, "81,000")])
def test_a_rate_is_said_with_two_digits_and_never_better_than_it_is(at_most, n):
    assert str(ErrorRate(8.0, 1, 0, at_most)) == f"of such places at most 1 in {n} is wrong"
