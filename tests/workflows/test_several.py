"""Answers of several references become one answer."""

import math
from dataclasses import replace

import pytest

from roadgeo.geometry.camera import CameraOptions
from roadgeo.location import Location, Place, Seconds
from roadgeo.matching.search import SearchResult
from roadgeo.workflows import LocateOptions, _best_of, _refusal

HERE = Place(0.0, 0.0, 8.60, 41.15, 20.0)


def located(reference: str, odds: float, lon: float = 8.60) -> Location:
    center = replace(HERE, lon=lon, log10_odds=odds)
    return Location(
        "q", "located", "fits", reference=reference, size=(1000, 1000), center=center, gsd_m=1.0, log10_odds=odds,
        seconds=Seconds(match=1.0, refine=0.5),
    )  # fmt: skip


def refused(reference: str) -> Location:
    return Location(
        "q", "not_located", "no place stands out", reference=reference, attribution="© all", seconds=Seconds(match=2.0)
    )


def test_the_surest_place_wins_and_all_work_counts():
    best = _best_of([refused("a"), located("b", 20.0), located("c", 9.0, lon=9.0)], LocateOptions())
    assert (best.status, best.reference, best.log10_odds) == ("located", "b", 20.0)
    assert (best.seconds.match, best.seconds.refine) == (4.0, 1.0)


def test_two_places_far_apart_that_are_equally_sure_are_ambiguous():
    best = _best_of([located("b", 20.0), located("c", 19.0, lon=9.0)], LocateOptions())
    assert best.status == "ambiguous"
    assert "on b and 19.0 on c" in best.reason
    assert best.runner_up is not None
    assert best.runner_up.lon == 9.0


def test_overlapping_maps_may_agree():
    assert _best_of([located("b", 20.0), located("c", 19.9, lon=8.6001)], LocateOptions()).status == "located"


@pytest.mark.parametrize("names", [["a"], ["a", "b"]])
def test_a_refusal_says_where_it_looked(names):
    best = _best_of([refused(name) for name in names], LocateOptions())
    assert (best.reference, best.attribution) == (", ".join(names), "© all")


NEAR, CAMERA = (-71.06, 42.36, 500.0), CameraOptions()


@pytest.mark.parametrize(
    ("near", "camera", "told"),
    [
        (None, {}, "; more roads in view or another map may help"),
        (NEAR, {}, "; searched within 500 m of -71.06,42.36: more roads in view or a wider search may help"),
        ((8.123456, -1.0, 1234567.0), {}, "; searched within 1234.57 km of 8.123456,-1: "),
        (None, {"gsd_m": (0.5, 1.0)}, "; searched at 0.5 to 1 m per pixel: "),
        (None, {"max_tilt_deg": 20.0}, "; searched tilted by up to 20 degrees: "),
        (None, {"focal_px": 1280.0}, "; searched with a focal length of 1280 pixels: "),
        (NEAR, {"gsd_m": (0.5, 1.0), "north_up": True}, "of -71.06,42.36, at 0.5 to 1 m per pixel, north up: "),
    ],
)
@pytest.mark.parametrize("stopped", ["exhausted", "time"])
def test_a_refusal_names_the_limits_that_were_given(near, camera, told, stopped):
    match = replace(LocateOptions().match, camera=replace(CAMERA, **camera))
    nothing = SearchResult(None, -math.inf, None, -math.inf, 1, 0, stopped)
    reason = _refusal(nothing, LocateOptions(near=near, match=match), 0.1)
    if stopped == "time":
        assert reason.startswith("stopped at the time limit of 10 s")
        assert reason.endswith(told.partition(": ")[0] if near or camera else "none passed the tests")
    else:
        assert told in reason
        assert reason.endswith(" may help")
