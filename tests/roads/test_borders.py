"""What a scan shows around its map is told from the map."""

import cv2
import numpy as np
import pytest
from worlds.bent import street_grid

from roadgeo.roads.borders import find_border

MAP, WIDTH = 600, 7


def city(seed: int = 0, straight: bool = False) -> np.ndarray:
    return street_grid(MAP, 40, 70, WIDTH - 2, seed, straight)


def sheet(
    image: np.ndarray, *, line: bool = True, caption: bool = True, margin: int = 0, turn_deg: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The map on a sheet of paper, as a scanner sees it, and which pixels are map."""
    height, width = MAP + 160, MAP + 120
    paper, shown = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
    paper[60 : 60 + MAP, 60 : 60 + MAP], shown[60 : 60 + MAP, 60 : 60 + MAP] = image, 255
    if line:
        cv2.rectangle(paper, (60, 60), (60 + MAP, 60 + MAP), 255, 4)
    if caption:
        cv2.putText(paper, "Plate 12: North End, Scale 1:5000", (70, height - 40), 0, 0.9, 255, 2)
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, 1.0)
    paper, shown = (cv2.warpAffine(item, matrix, (width, height)) for item in (paper, shown))
    if margin:
        paper = cv2.copyMakeBorder(paper, *[margin] * 4, cv2.BORDER_CONSTANT, value=255)
        shown = cv2.copyMakeBorder(shown, *[margin] * 4, cv2.BORDER_CONSTANT, value=0)
    return paper > 127, shown > 127


@pytest.mark.parametrize(
    "what",
    [
        {"caption": False},
        {},
        {"turn_deg": 1.3},
        {"margin": 40, "turn_deg": -0.7},
        {"line": False, "margin": 25},
    ],
)
def test_only_the_map_is_left(what):
    roads, shown = sheet(city(), **what)
    on_map = find_border(roads, WIDTH)
    assert on_map is not None
    assert not (roads & on_map & ~shown).sum() > 0.002 * roads.sum()
    assert (on_map & shown).sum() > 0.96 * shown.sum()


def test_a_larger_sheet_is_cropped_as_well():
    roads, shown = (np.kron(item, np.ones((4, 4), bool)) for item in sheet(city(), turn_deg=0.5))
    on_map = find_border(roads, 4 * WIDTH)
    assert on_map is not None
    assert on_map.shape == roads.shape
    assert not (roads & on_map & ~shown).sum() > 0.002 * roads.sum()
    assert (on_map & shown).sum() > 0.96 * shown.sum()


@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_streets_are_no_border(straight, seed):
    assert find_border(city(seed, straight) > 127, WIDTH) is None


def test_a_mask_without_roads_and_one_of_nothing_else_have_no_border():
    assert find_border(np.zeros((200, 300), bool), WIDTH) is None
    assert find_border(np.ones((200, 300), bool), WIDTH) is None
