from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from outputs.test_location_files import CRS, located, road_mask

from roadgeo.errors import OutputError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane
from roadgeo.outputs.overlay import FRAME, MATCH, QUERY_ROAD, PlotOptions, draw_overlay, write_overlay
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.subject import Subject

LETTERS = [True, False] if hasattr(cv2, "FontFace") else [False]


def map_roads() -> np.ndarray:
    """The two roads of the query, on the map, and one far away."""
    a, b, c = Homography(located().homography)(np.array([[50.5, 60.5], [200.0, 150.0], [350.0, 20.0]]))
    return np.array([[*a, *b], [*b, *c], [0.0, 0.0, 1.0, 1.0]])


def subject() -> Subject:
    """What outputs show, on a map of those roads."""
    plane = LocalPlane(CRS, (531000.0, 4556000.0))
    segments = map_roads() - (531000.0, 4556000.0) * 2
    index = SimpleNamespace(name="porto", meta={"attribution": "© them"}, plane=plane, segments=segments)
    return Subject(located(), road_mask(), output_paths("", "a"), indexes=[index])


@pytest.mark.parametrize("truetype", LETTERS)
def test_everything_is_drawn(truetype: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not truetype:
        monkeypatch.delattr(cv2, "FontFace", raising=False)
    picture = draw_overlay(located(), road_mask(), map_roads(), "© OpenStreetMap contributors", PlotOptions(map_px=600))
    assert picture.dtype == np.uint8
    for color in (FRAME, MATCH, QUERY_ROAD):
        assert (picture == color).all(axis=2).sum() > 50


@pytest.mark.parametrize("stretch", [(1.0, 1.0), (12.0, 1.0), (1.0, 12.0)])
def test_a_long_footprint_still_makes_a_picture_of_bounded_size(stretch: tuple[float, float]) -> None:
    long = located(np.diag([*stretch, 1.0]) @ located().homography)
    picture = draw_overlay(long, road_mask(), map_roads(), options=PlotOptions(map_px=500))
    assert max(picture.shape) < 1000


def test_a_location_without_evidence_is_drawn_without_roads() -> None:
    picture = draw_overlay(replace(located(), evidence=None), road_mask(), np.empty((0, 4)))
    assert (picture == FRAME).all(axis=2).any()


def test_the_picture_is_written(tmp_path: Path) -> None:
    write_overlay(tmp_path / "a.png", subject())
    drawn = draw_overlay(located(), road_mask(), map_roads(), "© them")
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], drawn)
    with pytest.raises(OutputError, match="no place"):
        draw_overlay(replace(located(), homography=None), road_mask(), map_roads())
