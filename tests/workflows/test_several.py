"""Places found on one or more references are judged once, together."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import PLANE, camera, look, random_network, scene_of

from roadgeo.geometry.camera import CameraFault, CameraOptions
from roadgeo.location import Reason, Seconds
from roadgeo.matching.evidence import Agreement
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import Searched
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.refinement import Refined
from roadgeo.matching.scene import Query
from roadgeo.matching.verdict import decide

SIZE = (1000, 1000)


@pytest.fixture(scope="module")
def query():
    graph = look(random_network(1, 2000.0), camera((1000, 1000)))
    return Query("q", scene_of(graph), graph, Seconds(vectorize=0.1))


@pytest.fixture(scope="module")
def town():
    return build_index(random_network(1, 2000.0))


def at(query, index, matrix, score, likelihood, covariance=None, agreeing=0.8):
    """A place as a search returns it."""
    refined = Refined(matrix, 1.0, np.eye(8) / 2.0 if covariance is None else covariance, 0.0, 0.0, 1.0)
    place = Place(query.scene, index, matrix, refined=refined, score=score, by=Weight(likelihood, 1.0))
    vars(place).update(agreement=Agreement(0.9, 0.9), agreeing=agreeing)
    return place


@pytest.fixture
def searched(query, town):
    """Return what a search of a reference of that name found, at these odds and eastings in metres.

    The first explains `likelihood`, as much as its odds unless that is given; of the others none knows.
    """

    def found(
        name: str, *places: tuple[float, float], tried: int = 100, likelihood: float | None = None, **reported
    ) -> Searched:
        index = replace(town, meta={**town.meta, "name": name, "attribution": "© all"})
        best = [at(query, index, camera((east, 0.0), SIZE), score, -np.inf) for score, east in places]
        if best:
            explained = best[0].score if likelihood is None else likelihood
            best[0] = best[0].but(by=Weight(explained, 1.0), rival=best[1] if len(best) > 1 else None)
        reported = {"stopped": "exhausted", "seconds": Seconds(match=1.0, refine=0.5), **reported}
        return Searched(index, tuple(best[:1]), counts=Counter(tried=tried, searched=len(index)), **reported)

    return found


def judge(query, *found, **options):
    return decide(query, found, LocateOptions(**options))


def test_the_surest_place_wins_and_all_work_counts(query, searched, monkeypatch):
    monkeypatch.setattr("roadgeo.matching.verdict.perf_counter", iter([10.0, 10.25]).__next__)
    best = judge(query, searched("a"), searched("b", (20.0, 0.0)), searched("c", (9.0, 30_000.0)))
    assert (best.status, best.reference) == ("located", "b")
    assert best.log10_odds == 11.0  # it explains 10^20, the other place 10^9
    assert best.runner_up is not None
    # and what it took to choose between them: a quarter of a second
    assert (best.seconds.match, best.seconds.refine, best.seconds.vectorize) == (3.25, 1.5, 0.1)


def test_one_reference_alone_keeps_its_odds(query, searched):
    assert judge(query, searched("a", (8.0, 0.0), (3.0, 500.0))).log10_odds == 8.0


def test_a_quick_refusal_says_that_more_can_be_done(query, searched):
    assert "full effort" in judge(query, searched("a"), effort="quick").reason
    assert "full effort" not in judge(query, searched("a")).reason


def test_two_places_far_apart_that_are_equally_sure_are_ambiguous(query, searched):
    best = judge(query, searched("b", (20.0, 0.0)), searched("c", (19.0, 30_000.0)))
    assert (best.status, best.reference) == ("ambiguous", "b")
    assert "80% agrees at one on b, 80% at another on c" in best.reason
    assert best.runner_up.center.x == pytest.approx(PLANE.origin[0] + 30_000.0, abs=1.0)


def test_overlapping_maps_may_agree(query, searched):
    best = judge(query, searched("b", (20.0, 0.0)), searched("c", (19.9, 100.0)))
    assert best.status == "located"


def test_a_place_that_does_not_lead_its_own_map_is_no_rival_on_another(query, searched):
    """Many places of a dense map explain 10^30 by chance: none of them leads."""
    best = judge(query, searched("a", (4.0, 30_000.0)), searched("b", (0.5, 0.0), (-0.5, 5000.0), likelihood=30.0))
    assert (best.status, best.reference, best.log10_odds) == ("located", "a", 4.0)


def test_places_of_different_scales_are_compared_by_what_they_explain_of_the_same_pixels(query, searched):
    """Laid five times as large, a mask has five times as much road that may agree by chance."""
    here, large = searched("a", (20.0, 0.0), likelihood=100.0), searched("b", (-8.0, 30_000.0), likelihood=180.0)
    here, large = (
        replace(item, places=tuple(place.but(by=place.by._replace(statement_px=px)) for place in item.places))
        for item, px in ((here, 600.0), (large, 120.0))
    )
    best = judge(query, large, here)
    assert (best.status, best.reference, best.log10_odds) == ("located", "a", 20.0)


def test_places_that_repeat_are_told_whatever_another_map_holds(query, searched):
    pair = searched("b", (0.5, 0.0), (-0.5, 5000.0), likelihood=30.0)
    for place in pair.compared:
        vars(place)["agreeing"] = 0.95
    assert judge(query, pair).status == "ambiguous"
    assert judge(query, searched("a", (-3.0, 30_000.0), likelihood=1.0), pair).status == "ambiguous"


def test_odds_against_any_other_place_heed_those_on_other_maps(query, searched):
    best = judge(query, searched("a", (20.0, 0.0), likelihood=30.0), searched("b", (19.0, 30_000.0), likelihood=27.0))
    assert best.log10_odds <= 3.0


def test_a_place_that_is_refused_alone_is_listed(query, searched):
    best = judge(query, searched("a", (4.0, 0.0)), searched("b", (2.9, 30_000.0)))
    assert (best.status, best.log10_odds) == ("located", 4.0)
    assert best.runner_up.score == 2.9


@pytest.mark.parametrize(("agreements", "status"), [((0.95, 0.9), "ambiguous"), ((0.95, 0.6), "not_located")])
def test_where_streets_repeat_both_places_are_told(query, searched, agreements, status: str) -> None:
    """Neither explains more than the other, so that neither has odds."""
    found = searched("a", (-2.0, 0.0), (-2.1, 5000.0))
    for place, rate in zip(found.compared, agreements, strict=True):
        vars(place)["agreeing"] = rate
    best = judge(query, found)
    assert best.status == status
    assert ("streets repeat there: 95% agrees at one, 90% at another" in best.reason) == (status == "ambiguous")


@pytest.mark.parametrize("names", [["a"], ["a", "b"]])
def test_a_refusal_says_where_it_looked(query, searched, names):
    best = judge(query, *map(searched, names))
    assert (best.status, best.reference, best.attribution) == ("not_located", ", ".join(names), "© all")


def test_a_refusal_tells_the_odds_of_the_best_and_of_the_next_place(query, searched):
    best = judge(query, searched("a", (2.8, 0.0), (1.0, 2000.0)), searched("b", (2.0, 30_000.0)))
    assert (best.status, best.center) == ("not_located", None)
    assert (best.log10_odds, best.runner_up.score) == (2.8, 2.0)
    assert best.runner_up.center.x == pytest.approx(PLANE.origin[0] + 30_000.0, abs=1.0)


def test_a_refusal_lists_the_places_of_all_maps_by_their_scores(query, searched):
    """What leads another map, and explains less, has no higher score than the likeliest."""
    first = searched("a", (0.2, 0.0), (-0.9, 5000.0), likelihood=30.0)
    best = judge(query, first, searched("b", (0.7, 30_000.0), likelihood=9.0))
    assert [(place.reference, place.score) for place in best.places] == [("a", 0.2), ("b", 0.2), ("a", -0.9)]
    assert best.reason.startswith("no place on these maps stands out")


def test_a_given_focal_length_is_used_for_the_tilt(query, town):
    """A homography alone tells the tilt to a degree at best, with the focal length it tells it to hundredths."""
    truth = camera((1000.0, 1000.0), SIZE, 1.0, tilt_deg=24.0, azimuth_deg=70.0, focal_px=900.0)
    found = Searched(town, (at(query, town, truth, 20.0, 40.0),), "accepted", counts=Counter(tried=1))
    match = LocateOptions().match
    known = replace(match, camera=CameraOptions(focal_px=900.0))
    seen = judge(query, found, match=known)
    assert seen.tilt_deg == pytest.approx(24.0, abs=1e-3)
    assert seen.tilt_source == "camera"
    assert judge(query, found).tilt_source == "homography"


def test_a_refusal_gives_the_reason_of_what_came_nearest(query, searched):
    near_miss = searched("b", (1.5, 0.0), stopped="time")
    best = judge(query, searched("a", tried=9000), near_miss, searched("c", (1.0, 9000.0)))
    assert best.reason.startswith("time limit of 60 s reached, the result may differ between runs; of the")
    assert "of the places tried, the best has a score of 1.5, 3.5 is asked for" in best.reason
    assert best.stopped == "time"


def test_an_answer_that_the_clock_cut_short_says_so(query, searched):
    cut = judge(query, searched("a", (9.0, 0.0), stopped="time"), searched("b", stopped="exhausted"))
    assert (cut.status, cut.stopped) == ("located", "time")
    assert cut.reason.endswith("; time limit reached, the result may differ between runs")
    whole = judge(query, searched("a", (9.0, 0.0), stopped="work"))
    assert (whole.status, whole.stopped) == ("located", "work")
    assert "between runs" not in whole.reason
    refused = judge(query, searched("a", stopped="work"))
    assert refused.reason.startswith("stopped after as much work as a search may take; of the places tried, none fits")


NEAR, CAMERA = (-71.06, 42.36, 500.0), CameraOptions()


@pytest.mark.parametrize(
    ("near", "camera", "reported"),
    [
        (
            None,
            {},
            "; the size of a pixel (--gsd SIZE+-5%), the heading (--heading DEG+-5), the place (--near LON,LAT,200)",
        ),
        (
            NEAR,
            {},
            "; searched within 500 m of -71.06,42.36; the size of a pixel (--gsd SIZE+-5%), the heading (--heading",
        ),
        ((8.123456, -1.0, 1234567.0), {}, "; searched within 1200 km of 8.12346,-1; "),
        (
            None,
            {"gsd_m": (0.5, 1.0)},
            "; searched at 0.5 to 1 m per pixel; the heading (--heading DEG+-5), the place (--near LON,LAT,200)",
        ),
        (None, {"max_tilt_deg": 20.0}, "; searched tilted by up to 20 degrees; "),
        (None, {"focal_px": 1280.0}, "; searched with a focal length of 1280 pixels; "),
        (
            NEAR,
            {"gsd_m": (0.5, 1.0), "north_up": True},
            "; searched within 500 m of -71.06,42.36, at 0.5 to 1 m per pixel, north up; more",
        ),
    ],
)
@pytest.mark.parametrize("stopped", ["exhausted", "time"])
def test_a_refusal_names_the_limits_that_were_given(query, searched, near, camera, reported, stopped):
    match = replace(LocateOptions().match, camera=replace(CAMERA, **camera))
    reason = judge(query, searched("a", stopped=stopped), near=near, match=match).reason
    if stopped == "time":
        assert reason.startswith("time limit of 60 s reached")
        assert ("; ".join(reported.split("; ")[:2]) if near or camera else "none fits") in reason
    else:
        assert reported in reason
        assert reason.endswith(" may help")


def test_a_refusal_shows_the_best_place_that_there_was(query, searched):
    best = judge(query, searched("a", (1.5, 300.0), (0.5, 5000.0)))
    assert (best.status, best.center) == ("not_located", None)
    assert "the heading to 5 degrees (--heading DEG+-5) would leave 2 of 2 places" in best.reason
    assert (
        "the place to 200 m (--near LON,LAT,200) would leave 1 of 2 places; more roads in view, another map, or "
        "the image flipped if it was scanned from its back may help" in best.reason
    )
    assert [alternative.score for alternative in best.alternatives] == [1.5, 0.5]


@pytest.mark.parametrize(
    ("score", "reported"),
    [
        (-3.0, "another fits as well as the best"),
        (0.7, "score of 0.7, 3.5 is"),
        (3.49, "score of 3.4, 3.5 is asked for"),
    ],
)
def test_a_refusal_states_the_score_that_is_missing(query, searched, score, reported):
    assert reported in judge(query, searched("a", (score, 0.0))).reason


def test_where_the_mirrored_image_fits_better_nothing_is_reported_and_the_remedy_is(query, searched):
    found = searched("a", (-4.0, 0.0), (-5.0, 800.0))
    best, *others = found.places
    answer = judge(query, replace(found, places=(best.but(fault=CameraFault.MIRRORED), *others)))
    assert (answer.status, answer.reason_code) == ("not_located", Reason.MIRRORED)
    assert answer.reason == "the roads fit better with the image mirrored: was it scanned from its back? Flip it"
    assert [place.score for place in answer.alternatives] == [-4.0, -5.0]


@pytest.mark.parametrize(("along_m", "status"), [(5.0, "located"), (100.0, "ambiguous")])
def test_half_a_place_is_not_located(query, searched, along_m, status):
    """Of one road alone the mask tells where it lies across that, and not how far along it."""
    found = searched("a", (20.0, 0.0))
    east = np.tile([1.0, 0.0], 4)
    covariance = along_m**2 * np.outer(east, east) + np.eye(8)
    place = found.places[0]
    found = replace(found, places=(place.but(refined=replace(place.refined, corner_covariance_m2=covariance)),))
    answer = judge(query, found)
    assert answer.status == status
    if status == "ambiguous":
        assert answer.reason_code is Reason.HALF_A_PLACE
        assert answer.reason.startswith("position is uncertain along one direction: +-200 m at azimuth 90 degrees")
        assert answer.center is not None
        assert answer.to_dict()["center_error"]["along_m"] == pytest.approx(100.0, rel=0.01)
