"""Scales are tried where nobody says how large pixels are; what was seen on the way is not looked at twice."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from worlds.models import brightness_model

from roadgeo.sources.segmentation import scales
from roadgeo.sources.segmentation.network import load_network
from roadgeo.sources.segmentation.photograph import open_photograph
from roadgeo.sources.segmentation.probability import ProbabilityMap
from roadgeo.sources.segmentation.scales import PYRAMID, rank_scales, try_scales
from roadgeo.sources.segmentation.tiling import segment

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture
def network(tmp_path: Path):
    return load_network(brightness_model(tmp_path / "m.onnx", size=256, props={"resolution": 50}))


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """900 x 800 px of streets, every 100 px."""
    image = np.full((800, 900, 3), 60, np.uint8)
    image[40::100] = image[:, 40::100] = 230
    for step in range(8):
        image[40 + step :: 100] = image[:, 40 + step :: 100] = 230
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize(
    ("gsd_m", "scales"),
    [
        ((0.0, np.inf), {1.0, 0.5, 2.0, 0.25}),  # at an eighth it is too small
        ((0.1, 12.0), {1.0, 0.5, 2.0, 0.25}),
        ((0.1, 0.3), {0.5, 0.25}),
        ((0.4, 0.9), {1.0, 2.0}),
        ((3.0, 12.0), {2.0}),  # coarser than all: the nearest
        ((0.01, 0.05), {0.25}),
    ],
)
def test_what_is_known_of_pixels_leaves_scales_out(
    network, photo: Path, gsd_m: tuple[float, float], scales: set[float]
) -> None:
    with open_photograph(photo) as opened:
        assert set(try_scales(opened, network, gsd_m)) == scales
        assert set(rank_scales(opened, network, gsd_m)) == scales
    assert scales < set(PYRAMID)


def test_what_was_seen_of_all_of_it_is_kept(network, photo: Path) -> None:
    with open_photograph(photo) as opened:
        ranked = rank_scales(opened, network)
        whole = {scale for scale, seen in ranked.items() if seen is not None}
        assert whole == {0.5, 0.25}  # the others show its middle
        for scale in whole:
            np.testing.assert_array_equal(ranked[scale].values, segment(opened, network, scale).values)


def test_one_scale_needs_no_look(network, photo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(network), "__call__", lambda *_: pytest.fail("the photograph was shown to the model"))
    with open_photograph(photo) as opened:
        assert rank_scales(opened, network, (3.0, 12.0)) == {2.0: None}


def test_scales_are_compared_on_the_same_ground_where_most_roads_are(network, tmp_path: Path) -> None:
    image = np.full((1800, 1800, 3), 60, np.uint8)
    image[1300:1308, 1200:] = image[1500:1508, 1200:] = 230  # streets in a corner, nothing in the middle
    image[1200:, 1300:1308] = image[1200:, 1500:1508] = 230
    path = tmp_path / "corner.png"
    cv2.imwrite(str(path), image)
    shown: list[tuple[float, float, float, float]] = []
    with open_photograph(path) as opened:

        def read(*part):  # type: ignore[no-untyped-def]
            shown.append(part[:4])
            return opened.read(*part)

        ranked = rank_scales(replace(opened, read=read), network)
    assert list(ranked) == [0.125, 0.25, 0.5, 1.0, 2.0]  # all see the same: what costs less comes first
    left, _, width, _ = shown[-1]
    assert (left, width) == (840, 960)  # of which a finer scale, which promises no more, would show a part


def test_roads_in_no_part_are_no_reason_to_fail(network, tmp_path: Path) -> None:
    path = tmp_path / "plain.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(40, 60, (900, 900, 3)).astype(np.uint8))
    with open_photograph(path) as opened:
        assert set(rank_scales(opened, network)) == {0.25, 0.5, 1.0, 2.0}


def test_where_no_intersection_is_seen_the_finest_scale_comes_first(
    network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tracks between farms: what is too narrow to be seen on coarse pixels may be seen on finer ones."""
    cv2.imwrite(str(tmp_path / "farm.png"), np.full((600, 900, 3), 90, np.uint8))
    monkeypatch.setattr(scales, "score", lambda _: 0.3)
    with open_photograph(tmp_path / "farm.png") as opened:
        ranked = list(rank_scales(opened, network))
    assert ranked == sorted(ranked, reverse=True)


def test_scales_at_which_roads_fell_apart_are_not_tried_finer(
    network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cv2.imwrite(str(tmp_path / "town.png"), np.full((900, 900, 3), 90, np.uint8))
    shown: list[float] = []

    def note(photograph, network, scale):  # type: ignore[no-untyped-def]
        shown.append(scale)
        return ProbabilityMap(np.zeros((10, 10), np.uint8))

    monkeypatch.setattr(scales, "segment", note)
    seen = iter([20.0, 0.0, 5.0, 20.0])  # at the coarsest scale; at the next, and what was seen of the same ground
    monkeypatch.setattr(scales, "score", lambda _: next(seen))
    with open_photograph(tmp_path / "town.png") as opened:
        ranked = rank_scales(opened, network)
        tried = sorted(try_scales(opened, network))
    assert shown == tried[:2]
    assert list(ranked) == tried
    assert all(ranked[scale] is None for scale in tried[2:])


def test_a_long_strip_may_be_enlarged(network, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "strip.png"), np.full((1000, 3400, 3), 90, np.uint8))
    with open_photograph(tmp_path / "strip.png") as opened:
        assert 2.0 in try_scales(opened, network)
