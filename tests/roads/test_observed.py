"""Black corners are told from roadless ground by the roads that end on their sides."""

import cv2
import numpy as np
import pytest
from worlds.bent import street_grid

from roadgeo.roads.observed import find_voids

SIZE, WIDTH = 600, 7


def city(spacing: int = 70, seed: int = 0) -> np.ndarray:
    return street_grid(SIZE, 20, spacing, WIDTH - 2, seed)


def warped(image: np.ndarray, corners: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """The mask as a photograph whose corners lie there, and which pixels it shows."""
    frame = np.array([(0, 0), (SIZE, 0), (SIZE, SIZE), (0, SIZE)], np.float32)
    matrix = cv2.getPerspectiveTransform(frame, np.array(corners, np.float32))
    shown = cv2.warpPerspective(np.full_like(image, 255), matrix, (SIZE, SIZE), flags=cv2.INTER_NEAREST)
    return cv2.warpPerspective(image, matrix, (SIZE, SIZE)) > 127, shown > 0


@pytest.mark.parametrize(
    "corners",
    [
        [(90, 60), (560, 20), (580, 540), (40, 570)],
        [(300, -60), (660, 300), (300, 660), (-60, 300)],
        [(0, 0), (SIZE, 90), (SIZE, SIZE), (0, SIZE)],  # one void wedge at the top
    ],
)
def test_voids_of_a_warped_mask_are_found(corners: list[tuple[float, float]]) -> None:
    roads, shown = warped(city(spacing=50), corners)
    observed = find_voids(roads, WIDTH)
    assert observed is not None
    assert observed.shape == roads.shape
    assert observed.dtype == np.bool_
    assert (observed & ~shown).sum() < 0.1 * (~shown).sum()
    assert (~observed & shown).sum() < 2 * 4 * SIZE  # a fringe of two pixels


@pytest.mark.parametrize("seed", range(5))
def test_a_whole_frame_has_no_voids(seed: int) -> None:
    assert find_voids(city(seed=seed) > 0, WIDTH) is None


def test_a_road_along_the_hull_is_no_row_of_ends() -> None:
    image = np.zeros((SIZE, SIZE), np.uint8)
    cv2.line(image, (0, 400), (SIZE, 250), 255, WIDTH)
    for x in range(30, SIZE, 60):
        cv2.line(image, (x, 400 - x // 4), (x, SIZE), 255, WIDTH)
    assert find_voids(image > 0, WIDTH) is None


def test_few_ends_are_not_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    roads, _ = warped(city(spacing=190), [(300, -60), (660, 300), (300, 660), (-60, 300)])
    assert find_voids(roads, WIDTH) is None
    monkeypatch.setattr("roadgeo.roads.observed.SURE_ENDS", 2)
    monkeypatch.setattr("roadgeo.roads.observed.LEAST_ENDS", 2)
    assert find_voids(roads, WIDTH) is not None


def test_half_a_frame_is_told_by_three_ends() -> None:
    """So few may end on a line by chance, but not where half of the frame lies beyond it and is empty."""
    image = np.zeros((SIZE, SIZE), np.uint8)
    for y in (100, 310, 480):
        cv2.line(image, (0, y), (SIZE, y + 60), 255, WIDTH)
    cv2.line(image, (120, 0), (150, SIZE), 255, WIDTH)
    image[:, 300:] = 0
    observed = find_voids(image > 0, WIDTH)
    assert observed is not None
    assert observed[:, :298].all()
    assert not observed[:, 302:].any()
    image[:, 300:] = image[:, :300]  # where roads go on beyond, no road ends
    assert find_voids(image > 0, WIDTH) is None


def test_three_ends_beside_a_narrow_strip_are_not_enough() -> None:
    image = np.zeros((SIZE, SIZE), np.uint8)
    for y in (100, 310, 480):
        cv2.line(image, (0, y), (SIZE, y + 60), 255, WIDTH)
    image[:, SIZE - 40 :] = 0
    assert find_voids(image > 0, WIDTH) is None


@pytest.mark.parametrize("shape", [(1, 1), (40, 60)])
def test_a_mask_of_road_alone(shape: tuple[int, int]) -> None:
    assert find_voids(np.ones(shape, bool), 5.0) is None
