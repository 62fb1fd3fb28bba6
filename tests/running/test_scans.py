"""Scans: stretched along one side, and with a margin, a line and a caption around the map."""

import cv2
import numpy as np
import pytest

from roadgeo.evaluation.landscape import Landscape
from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query
from roadgeo.geometry.homography import Homography
from roadgeo.reference.reference import Reference
from roadgeo.running.options import ReadOptions
from roadgeo.running.queries import locate_query
from roadgeo.workflows import explain

VIEW = ViewOptions(
    size_px=(700, 700), gsd_m=(1.2, 1.2), heading_deg=(0.0, 360.0), tilt_deg=(0.0, 0.0), intersections=(25, 1000)
)


@pytest.fixture(scope="module")
def drawn(town):
    """A reference, a mask of it, and where its corners lie on the map."""
    network, index = town
    query = simulate_query(Landscape.from_network(network), SimulationOptions(VIEW, NOISE_MODELS["clean"]), 0)
    return Reference(index, network), query.mask, query.truth


def corners_of(location, shape, inside=(0, 0, 0, 0)):
    left, top, right, bottom = inside
    height, width = shape
    pixels = np.array([[left, top], [width - right, top], [width - right, height - bottom], [left, height - bottom]])
    return location.pixel_to_map(pixels.astype(float))


def truth_of(truth):
    return Homography(truth.homography)(np.array([[0.0, 0], [700, 0], [700, 700], [0, 700]]))


@pytest.mark.parametrize("stretch", [0.62, 1.75])
def test_a_stretched_scan_is_located_where_its_pixels_are_given(drawn, stretch):
    reference, mask, truth = drawn
    scan = cv2.resize(mask, (round(700 / stretch), 700), interpolation=cv2.INTER_AREA)
    assert not locate_query(scan, [reference]).location.located
    location = locate_query(scan, [reference], reading=ReadOptions(aspect=stretch)).location
    assert location.located
    wide = float(location.reason.split("its pixels are ")[1].split()[0])
    assert wide == pytest.approx(stretch, rel=0.02)
    assert location.size == (scan.shape[1], scan.shape[0])
    assert location.camera is None
    gaps = corners_of(location, scan.shape) - truth_of(truth)
    assert np.hypot(*gaps.T).max() < 4.0
    placed = Homography(location.homography)(location.place.matches.query_xy * (1.0, -1.0))
    assert np.median(np.hypot(*(placed - location.place.matches.reference_xy).T)) < 4.0


def test_an_explanation_of_a_stretched_scan_shows_its_roads_on_the_scan(drawn):
    reference, mask, _ = drawn
    scan = cv2.resize(mask, (400, 700), interpolation=cv2.INTER_AREA)
    sighting = locate_query(scan, [reference], reading=ReadOptions(aspect=1.75), how=explain)
    seen, traced = sighting.location.content, sighting.explanation.scene.intersections
    assert len(seen.xy) == len(traced.xy) > 20
    assert np.ptp(seen.xy[:, 0]) < 400 < np.ptp(traced.xy[:, 0])


def test_a_sheet_is_located_by_its_map(drawn):
    reference, mask, truth = drawn
    sheet = np.zeros((900, 820), np.uint8)
    sheet[60:760, 60:760] = mask
    cv2.rectangle(sheet, (58, 58), (761, 761), 255, 4)
    cv2.putText(sheet, "Sheet 7. Scale 1:5000. Surveyed 1921", (70, 840), 0, 1.0, 255, 2)
    sheet[:30] = sheet[-30:] = sheet[:, :30] = sheet[:, -30:] = 255
    sighting = locate_query(sheet, [reference])
    assert sighting.location.located
    assert not sighting.mask.observed[:55].any()
    assert sighting.mask.observed[70:750, 70:750].all()
    gaps = corners_of(sighting.location, sheet.shape, (60, 60, 60, 140)) - truth_of(truth)
    assert np.hypot(*gaps.T).max() < 4.0
