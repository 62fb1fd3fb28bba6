"""From a mask to a graph."""

import itertools
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.vectorization import Vectorization, road_width, vectorize

Line = list[tuple[float, float]]

WIDTHS = [3, 4, 5, 7, 10, 15, 25]


def drawn(lines: list[Line], width: float, size: int = 200) -> np.ndarray:
    """Mark the pixels whose centres lie within half a width of polylines given in pixels (column, row)."""
    image = np.zeros((size, size), bool)
    rows, columns = np.mgrid[0:size, 0:size] + 0.5
    for line in lines:
        for (ax, ay), (bx, by) in itertools.pairwise(line):
            along = ((columns - ax) * (bx - ax) + (rows - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2)
            along = np.clip(along, 0, 1)
            image |= np.hypot(ax + along * (bx - ax) - columns, ay + along * (by - ay) - rows) <= width / 2
    return image


def traced(lines: list[Line], width: float, size: int = 200) -> Vectorization:
    return vectorize(RoadMask(drawn(lines, width, size)))


def off(graph: RoadGraph, lines: list[Line], size: int = 200, margin: float = 15.0) -> np.ndarray:
    """Distances of a graph's vertices from the true lines, away from the frame."""
    pixels = graph.coords * (1, -1)
    pixels = pixels[(pixels > margin).all(axis=1) & (pixels < size - margin).all(axis=1)]
    return shapely.distance(shapely.points(pixels), shapely.MultiLineString(lines))


def ragged(image: np.ndarray, amplitude: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.standard_normal(image.shape), 2.0)
    soft = ndimage.gaussian_filter(image.astype(float), 1.5)
    return soft + amplitude * noise / noise.std() * (soft > 0.03) > 0.5


@pytest.mark.parametrize("width", WIDTHS)
def test_a_crossing_is_found_at_its_place(width: int) -> None:
    lines = [[(-50.0, 100.0), (250.0, 110.0)], [(90.0, -50.0), (110.0, 250.0)]]
    result = traced(lines, width)
    graph = result.graph
    assert result.road_width_px == pytest.approx(width, rel=0.15, abs=0.6)
    assert result.is_open.sum() == 4
    assert (graph.degree() == 1).sum() == 4
    crossing = graph.xy[graph.degree() >= 3]
    assert np.hypot(*(crossing.mean(axis=0) - (100.33, -105.01))) < 0.2 * width + 0.5
    assert np.sqrt(np.mean(off(graph, lines) ** 2)) < 0.04 * width + 0.2


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("angle", [0.0, 17.0, 45.0, 90.0, 151.0])
def test_a_straight_road_is_straight(width: int, angle: float) -> None:
    turn = np.radians(angle)
    ends = 400 * np.array([[-np.cos(turn), -np.sin(turn)], [np.cos(turn), np.sin(turn)]]) + (151.3, 148.9)
    lines = [[tuple(end) for end in ends.tolist()]]
    result = traced(lines, width, 300)
    assert result.graph.n_edges == 1
    assert result.is_open.all()
    assert off(result.graph, lines, 300, 1.5 * width).max() < 0.04 * width + 0.35  # the drawing itself is off by 0.3 px


def test_a_curve_keeps_its_radius() -> None:
    turn = np.linspace(0, 2 * np.pi, 200)
    lines = [list(zip(100 + 60 * np.cos(turn), 100 + 60 * np.sin(turn), strict=True))]
    result = traced(lines, 7.0)
    assert result.graph.edges.tolist() == [[0, 0]]  # a ring
    assert off(result.graph, lines).max() < 0.6
    assert result.graph.edge_lengths().sum() == pytest.approx(2 * np.pi * 60, rel=0.01)


def test_pixel_centres_lie_at_a_half() -> None:
    image = np.zeros((60, 80), bool)
    image[30:33] = True  # rows 30, 31, 32: centre line at row 31.5
    result = vectorize(RoadMask(image))
    np.testing.assert_allclose(result.graph.coords[:, 1], -31.5, atol=1e-6)
    assert result.graph.coords[:, 0].min() <= 1.0
    assert result.graph.coords[:, 0].max() >= 79.0


@pytest.mark.parametrize("width", [5, 10, 20])
def test_a_bump_makes_no_spur_and_a_hole_no_loop(width: int) -> None:
    image = drawn([[(-50, 100), (250, 100)]], width)
    cv2.circle(image.view(np.uint8), (60, 100 - width // 2), width // 2, 1, cv2.FILLED)
    cv2.circle(image.view(np.uint8), (130, 100), max(width // 4, 1), 0, cv2.FILLED)
    graph = vectorize(RoadMask(image)).graph
    assert graph.n_edges == 1
    assert graph.edge_lengths().sum() == pytest.approx(199, abs=4)


def test_ragged_edges_make_no_junctions() -> None:
    lines = [[(-50.0, 80.0), (450.0, 140.0)], [(200.0, -50.0), (160.0, 450.0)]]
    graph = vectorize(RoadMask(ragged(drawn(lines, 9, 400), 0.2))).graph
    assert np.sqrt(np.mean(off(graph, lines) ** 2)) < 1.0
    assert len(graph.xy[graph.degree() >= 3]) in (1, 2)
    assert (graph.degree() == 1).sum() == 4


@pytest.mark.parametrize("width", [5, 8, 16])
def test_a_small_gap_is_bridged_and_a_large_one_is_not(width: int) -> None:
    def gapped(gap: float) -> RoadGraph:
        image = drawn([[(-50, 100), (250, 100)], [(100, 100), (100, 250)]], width)
        image[round(101 + width / 2) : round(101 + width / 2 + gap)] = False  # parts the side road from the main road
        return vectorize(RoadMask(image)).graph

    assert (gapped(0.8 * width).degree() >= 3).sum() == 1
    assert (gapped(2.5 * width).degree() >= 3).sum() == 0


def test_a_gap_in_a_road_is_bridged_once() -> None:
    image = drawn([[(-50, 100), (250, 110)]], 8)
    image[:, 96:103] = False
    graph = vectorize(RoadMask(image)).graph
    assert graph.n_edges == 1
    assert graph.degree().tolist() == [1, 1]


def test_specks_are_dropped() -> None:
    image = drawn([[(-50, 100), (250, 100)]], 8)
    cv2.circle(image.view(np.uint8), (50, 40), 7, 1, cv2.FILLED)
    image[150, 20] = True
    assert vectorize(RoadMask(image)).graph.n_edges == 1


def test_roads_along_the_frame_make_no_junctions_there() -> None:
    lines: list[Line] = [
        [(-50, 3), (250, 3)],
        *([(x, -50), (x, 100)] for x in (50, 100, 150)),
        [(-50, 100), (250, 100)],
    ]
    result = traced(lines, 8)
    graph = result.graph
    assert (graph.degree() >= 3).sum() == 3
    assert graph.xy[graph.degree() >= 3][:, 1].max() < -90
    assert (graph.degree()[result.is_open] == 1).all()


def test_unobserved_ground_cuts_roads_without_junctions() -> None:
    lines: list[Line] = [[(-50, 100), (250, 100)], [(60, -50), (60, 250)], [(120, -50), (123, 250)]]
    roads = drawn(lines, 8)
    observed = np.add.outer(np.arange(200), np.arange(200)) > 130  # a slanting void
    observed[:, 118:] = False  # along a road
    result = vectorize(RoadMask(roads & observed, observed))
    graph = result.graph
    assert (graph.degree() >= 3).sum() == 1
    assert result.is_open.sum() == 4
    ends = graph.xy[result.is_open] * (1, -1)
    inside = ends.astype(int).clip(0, 199)
    assert observed[inside[:, 1], inside[:, 0]].all()


def test_a_mask_is_reduced_where_it_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadgeo.roads.vectorization._MAX_WORKING_PIXELS", 20_000)  # 3 px in one pixel
    lines = [[(-50.0, 100.0), (450.0, 130.0)], [(200.0, -50.0), (180.0, 450.0)]]
    roads = drawn(lines, 3, 400)
    graph = vectorize(RoadMask(roads)).graph
    assert (graph.degree() == 1).sum() == 4
    assert np.sqrt(np.mean(off(graph, lines) ** 2)) < 1.5


@pytest.mark.parametrize("shape", [(41, 57), (200, 30), (33, 33)])
@pytest.mark.parametrize("width", [3, 9, 13])
def test_any_shape(shape: tuple[int, int], width: int) -> None:
    image = np.zeros(shape, bool)
    image[:, shape[1] // 2 - width // 2 : shape[1] // 2 + width // 2 + 1] = True
    graph = vectorize(RoadMask(image)).graph
    np.testing.assert_allclose(graph.coords[:, 0], shape[1] // 2 + 0.5, atol=0.1 * width)
    assert graph.coords[:, 1].min() >= -shape[0] - 1
    assert graph.coords[:, 1].max() <= 1


def test_no_road_is_an_error() -> None:
    with pytest.raises(MaskError, match="no road"):
        vectorize(RoadMask(np.zeros((50, 50), bool)))


def test_all_road_is_an_error() -> None:
    with pytest.raises(MaskError, match="no road is left"):
        vectorize(RoadMask(np.ones((50, 50), bool)))


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.0, 2.0, 4.0]), st.floats(0.02, 0.6), st.booleans())
def test_any_noise_gives_a_sound_graph(seed: int, scale: float, share: float, unseen: bool) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(32, 120, 2))
    noise = ndimage.gaussian_filter(rng.standard_normal(shape), scale)
    roads = noise > np.quantile(noise, 1 - share)
    observed = ndimage.gaussian_filter(rng.standard_normal(shape), 9.0) < 0.02 if unseen else None
    if observed is not None:
        roads &= observed
    try:
        result = vectorize(RoadMask(roads, observed))
    except MaskError:
        return
    graph = result.graph
    assert (np.diff(graph.offsets) >= 2).all()
    assert np.isfinite(graph.coords).all()
    np.testing.assert_array_equal(graph.coords[graph.offsets[:-1]], graph.xy[graph.edges[:, 0]])
    np.testing.assert_array_equal(graph.coords[graph.offsets[1:] - 1], graph.xy[graph.edges[:, 1]])
    assert (graph.degree() > 0).all()
    assert (graph.degree()[result.is_open] == 1).all()
    assert len(result.is_open) == graph.n_nodes
    margin = 2 * result.road_width_px
    assert (graph.coords > (-margin, -shape[0] - margin)).all()
    assert (graph.coords < (shape[1] + margin, margin)).all()


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_mask_gives_a_turned_graph(turns: int) -> None:
    lines: list[Line] = [[(-50, 60), (250, 90)], [(80, -50), (110, 250)], [(100, 130), (250, 180)]]
    image = drawn(lines, 6)
    straight = find_intersections(vectorize(RoadMask(image)).graph).xy
    turned = find_intersections(vectorize(RoadMask(np.rot90(image, turns))).graph).xy
    centre = np.array([100, -100])
    angle = turns * np.pi / 2
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = (straight - centre) @ matrix.T + centre
    assert len(turned) == len(expected)
    distances = np.hypot(*(turned[:, None] - expected[None]).transpose(2, 0, 1))
    assert distances.min(axis=0).max() < 1.0


@pytest.mark.parametrize("width", [10, 14, 35])
def test_where_streets_run_together_the_width_is_that_of_the_others(width: int) -> None:
    """Towards the horizon of a steep view streets make one patch, of more pixels than all that can be told apart."""
    image = drawn([[(-50, 100 + 150 * k), (1300, 60 + 150 * k)] for k in range(8)], width, 1200)
    alone = road_width(RoadMask(image.copy()))
    image[:, :400] = True
    image[::150, :400] = False  # here and there ground shows through
    assert alone < road_width(RoadMask(image)) < 1.6 * alone  # by area it is four times that, and more


def test_specks_do_not_tell_the_width() -> None:
    """There are many, and all of them together are longer than the roads."""
    image = drawn([[(-50, 300), (1300, 340)], [(400, -50), (380, 1300)]], 40, 1200)
    image |= np.random.default_rng(7).random(image.shape) < 0.02
    assert road_width(RoadMask(image)) > 20


def test_road_width_is_told_from_the_roads_alone() -> None:
    image = drawn([[(-50, 60), (450, 90)], [(80, -50), (110, 450)]], 8, 400)
    assert road_width(RoadMask(image)) == pytest.approx(8, abs=0.6)
    cv2.circle(image.view(np.uint8), (300, 300), 25, 1, cv2.FILLED)  # a blob
    assert road_width(RoadMask(image)) == pytest.approx(8, abs=3.5)
    with pytest.raises(MaskError, match="no road pixel"):
        road_width(RoadMask(np.zeros((300, 300), bool)))


def test_every_real_mask_gives_a_graph(data_dir: Path) -> None:
    for path in sorted((data_dir / "massachusetts" / "masks").glob("*.png")):
        result = vectorize(RoadMask(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127))
        assert 5.5 < result.road_width_px < 8.5
        assert (result.graph.degree() >= 3).sum() >= 20


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("checkerboard", "corners, expected at most 3,000,000"),
        ("hatching", "would cover 1"),
        ("squares", "would cover 2"),
    ],
)
def test_what_is_no_road_is_refused_before_it_takes_long(kind: str, message: str) -> None:
    """A checkerboard of single pixels took a minute and 2 GB at 1500 x 1500, and 8 GB at 3000 x 3000."""
    y, x = np.mgrid[:2600, :2600] if kind == "checkerboard" else np.mgrid[:700, :700]
    marked = {
        "checkerboard": (x + y) % 2 == 0,
        "hatching": ((x + y) % 4 == 0) | ((x - y) % 4 == 0),
        "squares": (x // 2 + y // 2) % 2 == 0,
    }[kind]
    with pytest.raises(MaskError, match=message):
        vectorize(RoadMask(marked))


def test_a_small_checkerboard_is_refused() -> None:
    y, x = np.mgrid[:400, :400]
    with pytest.raises(MaskError, match="would cover"):
        vectorize(RoadMask((x + y) % 2 == 0))


def test_a_wholly_white_mask_takes_no_more_memory_than_others() -> None:
    """Its road seems so wide that it was filled up to a grid 7,000 times as coarse, 700 MB for 300 x 300 pixels."""
    tracemalloc.start()
    try:
        with pytest.raises(MaskError, match="no road is left"):
            vectorize(RoadMask(np.ones((300, 200), np.bool_)))
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
