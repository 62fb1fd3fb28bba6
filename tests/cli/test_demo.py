"""The demonstration judges each mask by its truth."""

import pytest
from worlds.demo import MASKS

from roadgeo.cli.demo import _judge
from roadgeo.evaluation.demo import DemoMask
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import to_lonlat
from roadgeo.running.batch import Outcome


def located(mask: DemoMask, east_m: float) -> Outcome:
    """An answer so far to the east of the truth."""
    size = (1000, 1000)
    homography = mask.homography.copy()
    homography[0] += east_m * homography[2]
    lon, lat = to_lonlat(mask.crs, Homography(homography)(Frame(*size).center)[None])[0]
    found = {
        "status": "located",
        "size": size, "homography": homography.tolist(), "crs": mask.crs, "center": {"lon": lon, "lat": lat},
        "n_matched": 20, "reason": "all agree", "seconds": {"total": 2.0, "open": 0.5, "write": 0.5},
    }  # fmt: skip
    return Outcome("located", found)


@pytest.mark.parametrize(("east_m", "right"), [(3.0, True), (500.0, False)])
def test_a_place_is_right_where_it_is_near_the_truth(east_m: float, right: bool) -> None:
    judged, text = _judge(located(MASKS["drone"], east_m), MASKS["drone"])
    assert judged is right
    assert f"the middle is {east_m:.1f} m off, the corners {east_m:.1f} m; 20 intersections matched, 1.00 s" in text


@pytest.mark.parametrize(
    ("stem", "status", "right", "said"),
    [
        ("elsewhere", "not_located", True, "refused, as it should be: why"),
        ("elsewhere", "located", False, "located, although it is not on this map: why"),
        ("drone", "not_located", False, "not found, although it is there: why"),
        ("drone", "error", False, "why"),
    ],
)
def test_what_else_may_come_out(stem: str, status: str, right: bool, said: str) -> None:
    outcome = Outcome(status, {"reason": "why"})
    assert _judge(outcome, MASKS[stem]) == (right, said)
