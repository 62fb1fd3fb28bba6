import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from outputs.test_location_files import CRS, located, road_mask
from worlds.answers import with_place

from roadgeo.errors import OutputError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Content, Location
from roadgeo.matching.scene import trace_query
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.overlay import MAP_PX, MASK_SHARE, draw_overlay, write_overlay
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.plot import draw_plot
from roadgeo.outputs.subject import Subject

FRAME, MATCH, QUERY_ROAD, MAP_ROAD = map(rgb, ("frame", "match", "query", "map-road"))
LETTERS = [True, False] if hasattr(cv2, "FontFace") else [False]


def map_roads() -> np.ndarray:
    """The two roads of the query, on the map, and one far away."""
    a, b, c = Homography(located().homography)(np.array([[50.5, 60.5], [200.0, 150.0], [350.0, 20.0]]))
    return np.array([[*a, *b], [*b, *c], [0.0, 0.0, 1.0, 1.0]])


def city() -> SimpleNamespace:
    """A map of those roads."""
    plane = LocalPlane(CRS, (531000.0, 4556000.0))
    segments = map_roads() - (531000.0, 4556000.0) * 2
    return SimpleNamespace(
        name="porto", meta={"attribution": "© them"}, plane=plane, segments=segments, xy=segments[:1, :2]
    )


def shown(location: Location | None = None, mask: RoadMask | None = None, photo: Path | None = None) -> Subject:
    """What outputs show, on that map."""
    scene, graph = trace_query(road_mask())
    location = replace(location or located(), content=Content(scene.size, graph, scene.intersections.xy))
    return Subject(location, mask or road_mask(), output_paths("", "a"), photo=photo, indexes=[city()])


def photograph(folder: Path, shape: tuple[int, int], shown_columns: int) -> Path:
    """A green one, transparent behind some columns."""
    picture = np.full((*shape, 4), (30, 200, 10, 255), np.uint8)
    picture[:, shown_columns:, 3] = 0
    cv2.imwrite(str(folder / "photo.png"), picture)
    return folder / "photo.png"


@pytest.mark.parametrize("truetype", LETTERS)
def test_everything_is_drawn(truetype: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not truetype:
        monkeypatch.delattr(cv2, "FontFace", raising=False)
    picture = draw_overlay(shown(), 600)
    assert picture.dtype == np.uint8
    for color in (FRAME, MATCH, QUERY_ROAD, MAP_ROAD):
        assert (picture == color).all(axis=2).sum() > 50


def test_the_legend_of_a_portrait_ends_within_the_picture() -> None:
    portrait = located(np.diag([0.5, 1.0, 1.0]) @ located().homography)
    picture = draw_overlay(shown(portrait), 900)
    assert (picture[-20:, -12:] > 240).all()


@pytest.mark.parametrize("stretch", [(1.0, 1.0), (12.0, 1.0), (1.0, 12.0)])
def test_a_long_footprint_still_makes_a_picture_of_bounded_size(stretch: tuple[float, float]) -> None:
    long = located(np.diag([*stretch, 1.0]) @ located().homography)
    picture = draw_overlay(shown(long), 500)
    assert max(picture.shape) < 1000


def test_a_location_without_evidence_is_drawn_without_matches() -> None:
    picture = draw_overlay(shown(with_place(located(), matches=None)))
    assert (picture == FRAME).all(axis=2).any()
    assert not (picture == MATCH).all(axis=2).any()


@pytest.mark.parametrize("shape", [(40, 60), (400, 600), (900, 300)])
def test_a_photograph_is_drawn_above_its_mask_and_what_is_transparent_is_not(
    shape: tuple[int, int], tmp_path: Path
) -> None:
    with_it = draw_overlay(shown(photo=photograph(tmp_path, shape, shape[1] // 2)))
    without = draw_overlay(shown())
    assert with_it.shape == without.shape
    green = np.argwhere((with_it == (10, 200, 30)).all(axis=2))
    width = MASK_SHARE * MAP_PX
    assert len(green) > 0.02 * width**2
    assert green[:, 1].max() < 0.6 * width  # half of it is transparent
    assert green[:, 0].max() < 0.55 * len(with_it)  # above the mask
    mask = np.argwhere((with_it[:, : int(width)] == MATCH).all(axis=2))
    assert mask[:, 0].min() > green[:, 0].max()


@pytest.mark.parametrize("with_photo", [False, True])
@pytest.mark.parametrize("shape", [(500, 500), (900, 300), (300, 900), (1, 1), (4000, 40), (40, 4000)])
def test_nothing_is_drawn_over_the_title_or_the_legend(
    shape: tuple[int, int], with_photo: bool, tmp_path: Path
) -> None:
    photo = photograph(tmp_path, shape, shape[1]) if with_photo else None
    mask = RoadMask(np.ones(shape, np.bool_))
    picture = draw_overlay(shown(with_place(located(), matches=None), mask, photo))
    top, panel = round(MAP_PX * 0.075), round(MAP_PX * MASK_SHARE)
    for strip in (picture[:top], picture[-(top // 2) :, :panel]):
        for color in (FRAME, (10, 200, 30)):
            assert not (strip == color).all(axis=2).any()
    assert (picture[top : -(top // 2), :panel] == FRAME).all(axis=2).any()


def test_the_picture_is_written(tmp_path: Path) -> None:
    write_overlay(tmp_path / "a.png", shown())
    drawn = draw_overlay(shown())
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], drawn)
    with pytest.raises(OutputError, match="no place"):
        draw_overlay(shown(replace(located(), places=())))


def test_a_plot_is_saved_as_its_name_tells(tmp_path: Path) -> None:
    plot = draw_plot(shown())
    for name in ("a.svg", "a.png"):
        plot.save(tmp_path / name)
    root = ET.parse(tmp_path / "a.svg").getroot()
    groups = [each.get("class") for each in root if each.tag.endswith("}g")]
    assert groups == ["ground", "map-roads", "query-roads", "footprint", "matches"]
    assert "© them" in (tmp_path / "a.svg").read_text("utf-8")
    picture = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    assert picture.shape[1] == 1400
    assert (picture == FRAME).all(axis=2).any()
    with pytest.raises(OutputError, match=r"\.svg or \.png"):
        plot.save(tmp_path / "a.pdf")
