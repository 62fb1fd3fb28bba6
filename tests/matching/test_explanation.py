"""Explanations: of masks that are located, refused, cut short, and looked for with wrong limits."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from shapely import LineString
from worlds.answers import moved
from worlds.scenes import PLANE, camera, look, mapped, random_network

from roadgeo.cli import main
from roadgeo.evaluation.demo import demo_masks
from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Reason
from roadgeo.matching import rivals
from roadgeo.matching.explanation import SCHEMA, Explanation, tell
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import search_references
from roadgeo.matching.scene import read_query
from roadgeo.matching.search import SearchOptions
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.explanation_sheet import STARVED, draw_explanation, numbered, write_explanation_picture
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.subject import Subject
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.roads.network import build_network
from roadgeo.workflows import LocateOptions, explain, locate

SIZE = (900, 900)
TRUTH = camera((1500.0, 1400.0), SIZE, 1.0, tilt_deg=15.0, azimuth_deg=50.0, heading_deg=200.0, focal_px=900.0)


def reference_of(network) -> Reference:
    return Reference(build_index(network), network)


def mask_of(network, matrix=TRUTH, size=SIZE) -> RoadMask:
    canvas = np.zeros(size[::-1], np.uint8)
    for line in look(network, matrix, size).polylines():
        cv2.polylines(canvas, [np.rint(plane_to_pixel(line) * 16).astype(np.int32)], False, 1, 8, cv2.LINE_8, 4)
    return RoadMask(canvas > 0, name="mask.png")


@pytest.fixture(scope="module")
def network():
    return random_network(4)


@pytest.fixture(scope="module")
def town(network):
    return reference_of(network)


@pytest.fixture(scope="module")
def mask(network):
    return mask_of(network)


@pytest.fixture(scope="module")
def lattice():
    at = np.arange(40) * 90.0
    ways = [LineString([(x, 0), (x, at[-1])]) for x in at] + [LineString([(0, y), (at[-1], y)]) for y in at]
    return reference_of(build_network(ways, PLANE, {"name": "lattice"}))


def subject(explanation, mask, town):
    """What outputs show of an explanation, on one map."""
    paths = output_paths("", "a")
    return Subject(explanation.location, mask, paths, indexes=[town.index], explanation=explanation)


def test_places_that_are_compared_to_be_shown_do_not_count_as_measured(lattice):
    """The funnel is that of the search, not of its explanation."""
    query, options = read_query(mask_of(lattice.network)), LocateOptions()
    (found,) = search_references(query, lattice.parts, options, 60.0, explained=True)
    measured = found.estimator.n_nulls
    assert len(found.estimator.verified) > measured
    story = tell(query, found, options)
    assert story.funnel.measured == measured


def with_camera(**limits) -> LocateOptions:
    options = LocateOptions()
    return replace(options, match=replace(options.match, camera=CameraOptions(**limits)))


def check(explanation: Explanation) -> dict:
    """Return its one search as plain values, after checking what holds of all."""
    document = json.loads(json.dumps(explanation.to_dict(), allow_nan=False))
    assert document["schema"] == SCHEMA
    (search,) = document["searches"]
    funnel = search["funnel"]
    assert funnel["proposals"] >= funnel["on_roads"] >= funnel["grown"] >= funnel["survived"] >= funnel["verified"]
    assert funnel["verified"] >= funnel["measured"]
    odds = [place["log10_odds"] for place in search["places"]]
    assert all(place["why"] for place in search["places"])
    assert None not in odds or len(odds) == 1
    assert (search["starved_at"] is None) == (document["status"] == "located")
    assert bool(search["missing"]) == (document["status"] != "located")
    return search


def test_a_located_mask_is_told_from_the_places_it_was_not_put(town, mask):
    explanation = explain(mask, town)
    search = check(explanation)
    assert explanation.location.located
    assert search["stopped"] == "accepted"
    assert search["places"][0]["why"] == "located"
    assert search["places"][0]["log10_odds"] == explanation.location.log10_odds
    where = mapped(TRUTH, np.array([[450.0, -450.0]]))[0] + PLANE.origin
    place = search["places"][0]["center"]
    assert np.hypot(place["x"] - where[0], place["y"] - where[1]) < 3
    assert explanation.stories[0].places[0].place.on_roads.mean() > 0.8


def test_watching_changes_nothing(town, mask):
    seen, plain = explain(mask, town).location, locate(mask, town)
    assert np.array_equal(seen.homography, plain.homography)
    assert (seen.status, seen.reason, seen.log10_odds, seen.stats) == (
        plain.status, plain.reason, plain.log10_odds, plain.stats,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("limits", "fault", "value"),
    [
        ({"gsd_m": (0.3, 0.7)}, "ground sampling out of range", "(1.0"),
        ({"north_up": True}, "heading out of range", "(up is 2"),
    ],
)
def test_limits_that_are_too_narrow_are_named(town, mask, limits, fault, value):
    explanation = explain(mask, town, with_camera(**limits))
    search = check(explanation)
    assert explanation.location.status == "not_located"
    assert search["camera_refusals"][fault] > 0
    assert search["places"][0]["why"].startswith(f"the camera: {fault} {value}")
    assert search["places"][0]["log10_odds"] > 6
    assert any("limits on the camera may be too narrow" in sentence for sentence in search["missing"])


def test_that_the_image_is_mirrored_is_told_of_the_place_where_it_seems_to_lie(town, mask, monkeypatch):
    monkeypatch.setattr(rivals, "mirrored_likelihood", lambda *_: 1e4)
    monkeypatch.setattr(rivals, "_CERTAIN", np.inf)
    explanation = explain(mask, town)
    assert explanation.location.reason_code is Reason.MIRRORED
    first, *_ = explanation.stories[0].places
    assert first.place.agreement.forward > 0.8
    assert first.why == "its roads fit better mirrored"
    assert explanation.stories[0].missing[0].startswith("the right side: ")


def test_a_place_off_the_map_is_told(town, mask):
    explanation = explain(mask, town, LocateOptions(near=(0.0, 80.0, 500.0)))
    search = check(explanation)
    assert explanation.location.reason == (
        "no map has an intersection around the place given by near; searched within 500 m of 0,80"
    )
    assert search["missing"] == [explanation.location.reason]


def test_a_mask_of_elsewhere(town):
    search = check(explain(mask_of(random_network(77)), town))
    assert search["starved_at"] in {"odds", "survived", "on_roads", "camera"}
    assert search["stopped"] == "exhausted"
    assert all(place["why"] != "located" for place in search["places"])


def test_places_of_a_refusal_come_in_the_order_of_its_list(porto):
    """Users take a place by its number: the picture must show the one that they take."""
    elsewhere = next(mask.path for mask in demo_masks() if mask.path.stem == "elsewhere")
    explained = explain(elsewhere, open_reference(porto))
    listed = [(place.center.lon, place.center.lat) for place in explained.location.places]
    assert not explained.location.located
    assert len(listed) > 1
    shown = [place.place.lonlat for place in explained.stories[0].places]
    np.testing.assert_allclose(shown[: len(listed)], listed[: len(shown)], atol=1e-6)


def test_blocks_like_one_another(lattice):
    mask = mask_of(lattice.network)
    explanation = explain(mask, lattice)
    search = check(explanation)
    assert explanation.location.status != "located"
    assert search["starved_at"] == "odds"
    assert search["places"][0]["nearby"] > 0.5 * search["places"][0]["log10_likelihood"]
    assert any(sentence.startswith(("variety", "difference")) for sentence in search["missing"])


def test_time_that_ran_out_is_named(town, network):
    options = LocateOptions(search=SearchOptions(time_limit_s=1e-6))
    search = check(explain(mask_of(random_network(78)), town, options))
    assert search["stopped"] == "time"
    assert search["missing"][0].startswith("time: ")


def test_too_few_intersections(town):
    canvas = np.zeros((300, 300), np.uint8)
    cv2.line(canvas, (0, 150), (299, 140), 1, 7)
    explanation = explain(RoadMask(canvas > 0), town)
    search = check(explanation)
    assert search["starved_at"] == "intersections"
    assert search["funnel"]["intersections"] == 0
    assert search["missing"] == ["no intersections are seen, at least 1 is needed"]
    assert draw_explanation(subject(explanation, RoadMask(canvas > 0), town)).shape[1] == 2000


def test_the_papers_method_tells_what_it_counts(town, mask):
    unhurried = SearchOptions(time_limit_s=120.0)  # its kernels may be compiled meanwhile
    explanation = explain(mask, town, LocateOptions(method="pair", search=unhurried))
    (search,) = explanation.to_dict()["searches"]
    assert explanation.location.located
    assert search["places"] == search["missing"] == []
    assert search["funnel"]["intersections"] > 20
    assert draw_explanation(subject(explanation, mask, town)).shape[1] == 2000


def test_each_reference_has_its_story(town, mask, lattice):
    explanation = explain(mask, [lattice, town])
    assert [story.reference for story in explanation.stories] == ["lattice", "town 4"]
    assert explanation.location.reference == explanation.nearest.reference == "town 4"


class TestPicture:
    def test_places_bear_the_numbers_of_the_answer(self, town):
        """Other maps and other passes may have better ones, and put them in another order."""
        explanation = explain(mask_of(random_network(78)), town)
        (story,), first = explanation.stories, explanation.location.places[0]
        elsewhere = [replace(first, reference="another map"), moved(first, 3000.0, 0.0)]
        (number, told), *others = numbered(story, [*elsewhere, first])
        assert number == 3
        assert told.place.lonlat == pytest.approx(first.center[2:], abs=1e-6)
        assert [number for number, _ in others] == [None] * (len(story.places) - 1)

    def test_what_agrees_and_what_does_not(self, town, mask):
        picture = draw_explanation(subject(explain(mask, town), mask, town))
        assert picture.dtype == np.uint8
        assert picture.shape[1:] == (2000, 3)
        assert (picture == rgb("agree")).all(axis=2).sum() > 500
        assert not (picture == STARVED).all(axis=2).any()

    def test_the_stage_that_starved_is_marked(self, town, mask, tmp_path: Path):
        explanation = explain(mask, town, with_camera(gsd_m=(0.3, 0.7)))
        write_explanation_picture(tmp_path / "a.png", subject(explanation, mask, town))
        picture = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
        assert (explanation.stories[0].starved_at == "camera") == bool((picture == STARVED).all(axis=2).any())

    @pytest.mark.parametrize("size", [(1800, 60), (60, 1800)])
    def test_frames_of_any_shape_with_ground_unseen(self, town, network, size):
        mask = mask_of(network, camera((1500.0, 1500.0), size, 1.0), size)
        observed = np.ones(mask.shape, bool)
        observed[: size[1] // 2, : size[0] // 2] = False
        mask = RoadMask(mask.roads & observed, observed, "long.png")
        assert draw_explanation(subject(explain(mask, town), mask, town)).shape[1] == 2000


def test_from_the_command_line(town, mask, tmp_path: Path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path / "library"))
    town.save("town.gpkg")
    cv2.imwrite("a.png", mask.roads * np.uint8(255))
    assert main(["locate", "a.png", "-r", "town.gpkg", "--explain", "-q"]) == 0
    assert main(["locate", ".", "-r", "town.gpkg", "--explain", "-q", "--gsd", "0.3:0.7"]) == 3
    document = json.loads(Path("a_explain.json").read_text())
    assert document["status"] == "not_located"
    assert "narrow" in " ".join(document["searches"][0]["missing"])
    assert cv2.imread("a_explain.png") is not None
    assert not Path("a_explain_explain.json").exists()
    assert main(["locate", "a.png", "-r", "town.gpkg", "-q", "--gsd", "0.3:0.7"]) == 3
    assert not Path("a_explain.json").exists()
    assert capfd.readouterr().err == ""


# --- the true place ---------------------------------------------------------------------------------------------------


def lonlat_of(town, matrix, away_m=0.0):
    """Longitude and latitude of the frame's middle, moved east."""
    middle = mapped(matrix, np.array([[SIZE[0] / 2, -SIZE[1] / 2]])) + np.array([away_m, 0.0])
    return tuple(to_lonlat(town.index.plane.crs, town.index.plane.to_crs(middle))[0].tolist())


def truth_told(mask, town, options, lonlat):
    explanation = explain(mask, town, replace(options, truths=(("mask.png", *lonlat),)))
    (search,) = explanation.to_dict()["searches"]
    return search["truth"], explanation


def test_the_true_place_of_a_located_mask_is_not_lost(town, mask):
    row, _ = truth_told(mask, town, LocateOptions(), lonlat_of(town, TRUTH))
    assert row["lost_at"] is None
    assert row["counts"]["proposals"] >= row["counts"]["on_roads"] >= 1
    assert row["log10_odds"] > 8


def test_a_place_off_the_map_and_one_that_nothing_proposes_are_told_apart(town, mask):
    other = mask_of(random_network(9))
    row, explanation = truth_told(other, town, LocateOptions(effort="quick"), lonlat_of(town, TRUTH, 90_000.0))
    assert row["lost_at"] == "map"
    assert row["said"] in explanation.nearest.missing
    far = lonlat_of(town, TRUTH, 900.0)
    assert truth_told(mask, town, LocateOptions(), far)[0]["lost_at"] in {"proposals", "on_roads", "survived"}


def test_a_camera_that_refuses_the_true_place_is_named(town, mask):
    row, _ = truth_told(mask, town, with_camera(gsd_m=(1.4, 5.0)), lonlat_of(town, TRUTH))
    assert row["lost_at"] == "camera"
    assert "ground sampling" in row["said"]


def test_a_truth_of_another_mask_is_left_alone(town, mask):
    explanation = explain(mask, town, replace(LocateOptions(), truths=(("other.png", 0.0, 0.0),)))
    assert explanation.to_dict()["searches"][0]["truth"] is None
