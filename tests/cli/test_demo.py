"""The demonstration judges each mask by its truth."""

import pytest
from worlds.demo import MASKS

from roadgeo.cli.demo import _judge
from roadgeo.evaluation.demo import DemoMask
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import to_lonlat
from roadgeo.running.locating import Outcome


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


@pytest.mark.parametrize(
    ("stem", "outcome", "right", "said"),
    [
        ("drone", located(MASKS["drone"], 3.0), True, "the middle is 3.0 m off, the corners 3.0 m; 20 intersections"),
        ("drone", located(MASKS["drone"], 500.0), False, "the middle is 500.0 m off"),
        ("elsewhere", Outcome("not_located", {"reason": "why"}), True, "refused, as it should be: why"),
        ("elsewhere", Outcome("located", {"reason": "why"}), False, "located, although it is not on this map: why"),
        ("drone", Outcome("not_located", {"reason": "why"}), False, "not found, although it is there: why"),
        ("drone", Outcome("error", {"reason": "why"}), False, "why"),
    ],
)
def test_each_result_is_judged(stem: str, outcome: Outcome, right: bool, said: str) -> None:
    judged, text = _judge(outcome, MASKS[stem])
    assert judged is right
    assert said in text
