"""The location of a variant says the same of the ground in the query's own pixels."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.demo import DRONE

from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.projection import metres_apart
from roadgeo.matching.hints import apply_hints
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.opening import open_reference
from roadgeo.running.variants import Variant, in_pixels_of, mirrored, resampled, undoing
from roadgeo.sources.masks import read_mask
from roadgeo.workflows import locate


@pytest.fixture(scope="module")
def located(porto):
    location = locate(read_mask(DRONE), [open_reference(porto)])
    assert location.located
    return location


@pytest.mark.parametrize("factor", [(0.5, 0.5), (2.0, 2.0)])
def test_corners_stay_where_they_are(located, factor):
    size = tuple(round(side * f) for side, f in zip(located.size, factor, strict=True))
    scale = np.array(size) / located.size
    own = in_pixels_of(located, size, np.diag([*(1.0 / scale), 1.0]))
    assert own.size == size
    corners = np.array([(0, 0), (size[0], 0), size, (0, size[1])], float)
    assert np.allclose(Homography(own.homography)(corners), located.footprint)
    assert np.allclose(own.place.matches.query_xy, located.place.matches.query_xy * scale)
    assert np.allclose(own.content.graph.coords, located.content.graph.coords * scale)
    assert np.allclose(own.content.xy, located.content.xy * scale)
    assert own.gsd_m == pytest.approx(located.gsd_m / np.sqrt(scale.prod()))
    assert own.camera.focal_px == pytest.approx(located.camera.focal_px * np.sqrt(scale.prod()))
    for name in ("footprint", "corner_sigma_m", "tilt_deg", "rotation_deg", "log10_odds", "n_intersections"):
        assert getattr(own, name) == pytest.approx(getattr(located, name), rel=1e-6)


def test_what_has_no_place_has_none_on_another_grid(located):
    own = in_pixels_of(replace(located, places=()), (10, 10), np.eye(3))
    assert own.size == (10, 10)
    assert own.homography is None
    nothing = replace(located, content=None, places=())
    assert in_pixels_of(nothing, (10, 10), np.eye(3)) == nothing


def test_a_mask_turned_over_has_the_corners_of_the_mask(located):
    variant = mirrored(Variant(read_mask(DRONE), np.eye(3)))
    turned = in_pixels_of(located, located.size, variant.matrix)
    assert turned.mirrored
    assert (turned.camera, turned.tilt_deg) == (None, None)
    assert np.allclose(turned.footprint, located.footprint[[1, 0, 3, 2]])
    assert np.allclose(turned.corner_sigma_m, located.corner_sigma_m[[1, 0, 3, 2]])
    placed = Homography(turned.homography)(turned.place.matches.query_xy * (1.0, -1.0))
    assert np.allclose(placed, Homography(located.homography)(located.place.matches.query_xy * (1.0, -1.0)))
    again = in_pixels_of(turned, located.size, variant.matrix)
    assert not again.mirrored
    assert np.allclose(again.corner_covariance_m2, located.corner_covariance_m2)


@pytest.mark.parametrize("margins", [((300, 300), (300, 300)), ((0, 400), (150, 20))])
def test_margins_that_were_not_observed_cost_nothing(located, porto, margins):
    """A place is judged over its whole frame, where margins would count as places without roads."""
    mask = read_mask(DRONE)
    roads, seen = (np.pad(values, margins) for values in (mask.roads, np.ones(mask.shape, np.bool_)))
    padded = RoadMask(roads, seen, "padded")
    found = undoing(locate, None, False)(padded, [open_reference(porto)], LocateOptions())
    assert found.log10_odds == pytest.approx(located.log10_odds)
    assert found.size == padded.shape[::-1]
    (top, _), (left, _) = margins
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * located.size + (left, top)
    assert np.allclose(Homography(found.homography)(corners), located.footprint, atol=1e-3)
    here = found.place.in_pixels(located.size, shift(left, top))
    assert np.allclose(here.corner_covariance_m2, located.corner_covariance_m2, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", ["near", "within"])
def test_hints_are_of_the_middle_of_the_whole_frame_margins_included(porto, name):
    mask, reference = read_mask(DRONE), open_reference(porto)
    seen = np.ones(mask.shape, np.bool_)
    seen[:, : mask.shape[1] * 2 // 5] = False
    torn = RoadMask(mask.roads & seen, seen, "torn")
    place = locate(mask, [reference]).place
    lon, lat = place.center[2:]
    hints = {"near": (lon, lat, 50.0), "within": (lon - 5e-4, lat - 5e-4, lon + 5e-4, lat + 5e-4)}
    found = undoing(locate, None, False)(torn, [reference], apply_hints(LocateOptions(), {name: hints[name]}))
    assert found.located, found.reason
    assert metres_apart(np.array(found.place.center[2:]), np.array([lon, lat])) < 2.0


@pytest.mark.parametrize("hints", [{"gsd_m": (0.9, 1.1)}, {"heading_deg": (90.0, 10.0)}])
def test_scale_and_heading_are_of_that_middle_too(located, hints):
    """A tilted camera sees other ground at another scale."""
    mask = read_mask(DRONE)
    seen = np.zeros(mask.shape, np.bool_)
    seen[:, :500] = True
    looked_at: list[RoadMask] = []

    def look(shown, *_):
        looked_at.append(shown)
        return located

    for given in ({}, hints):
        undoing(look, None, False)(replace(mask, observed=seen), [], apply_hints(LocateOptions(), given))
    assert [shown.shape[1] for shown in looked_at] == [500, mask.shape[1]]


def test_masks_on_another_grid():
    mask = read_mask(DRONE)
    height, width = mask.shape
    seen = np.ones(mask.shape, np.bool_)
    seen[: height // 2] = False
    values = np.where(mask.roads, 200, 30).astype(np.uint8)
    small = resampled(replace(mask, observed=seen, probability=values), (height // 2, width // 2)).mask
    assert small.shape == small.observed.shape == small.probability.shape == (height // 2, width // 2)
    assert small.roads.mean() == pytest.approx(mask.roads.mean(), rel=0.1)
    assert not small.observed[: height // 4 - 1].any()
    assert small.observed[height // 4 + 1 :].all()
    assert set(np.unique(small.probability)) == {30, 200}
