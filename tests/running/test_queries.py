"""Photographs are recognised, segmented and located like masks; nobody says how large their pixels are."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from worlds.demo import DRONE, MASKS
from worlds.models import brightness_model

from roadgeo import open_reference
from roadgeo.cli import main
from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.matching.options import LocateOptions
from roadgeo.running import photographs, queries
from roadgeo.running.options import ReadOptions
from roadgeo.running.photographs import _how_much_finer
from roadgeo.running.queries import locate_query
from roadgeo.sources.bands import PROBABILITY_TAG
from roadgeo.sources.segmentation import scales
from roadgeo.sources.segmentation.probability import ProbabilityMap
from roadgeo.sources.segmentation.scales import rank_scales
from roadgeo.sources.segmentation.tiling import segment
from roadgeo.storage.geopackage import read_layer

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Sees a road where a picture is light."""
    props = {"class_names": {0: "ground", 1: "road"}, "resolution": 100, "tiles_overlap": 10}
    return str(brightness_model(tmp_path_factory.mktemp("models") / "light.onnx", size=256, props=props))


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drone's mask as a photograph: light roads on rough, coloured ground."""
    rng = np.random.default_rng(0)
    roads = cv2.imread(str(DRONE), cv2.IMREAD_GRAYSCALE) > 127
    ground = rng.integers(10, 110, (*roads.shape, 3)).astype(np.uint8)
    ground[..., 1] //= 2
    image = np.where(roads[..., None], np.uint8(225), cv2.GaussianBlur(ground, (0, 0), 1))
    path = tmp_path_factory.mktemp("photos") / "flight.jpg"
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return path


@pytest.mark.parametrize("name", ["a.gpkg", "a.zip", "a.geojson.gz", "a.csv", "A.TSV", "a.csv.gz"])
def test_lines_are_known_by_their_names(name: str) -> None:
    with queries.open_query(name, ReadOptions()) as query:
        assert query.kind == "lines"


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict:
    assert main(["locate", *arguments, "--json", "--quiet"]) in (0, 3)
    return json.loads(capsys.readouterr().out)


def offset(document: dict, size: int = 1) -> float:
    """Distance in metres of the middle from where it is."""
    width, height = document["size"]
    expected = MASKS["drone"].homography @ [width / 2, height / 2, 1]
    found = np.array(document["homography"]) @ [width / 2, height / 2, 1]
    return float(np.hypot(*(found[:2] / found[2] - expected[:2] / expected[2])))


#: What a photograph shows that shows no roads.
NOTHING = ProbabilityMap(np.zeros((10, 10), np.uint8), 0.5)


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, int]]:
    """Scales at which photographs are shown to models, with the number of ways; nothing is seen."""
    taken: list[tuple[float, int]] = []

    def note(
        _photograph: object, _network: object, scale: float, *_: object, ways: int, **__: object
    ) -> ProbabilityMap:
        taken.append((round(scale, 1), ways))
        return NOTHING

    monkeypatch.setattr(photographs, "segment", note)
    return taken


@pytest.mark.parametrize(("segmenter", "ways"), [("", True), ("model", True), ("plugin", False)])
def test_the_second_pass_shows_the_photograph_more_ways(
    segmenter: str, ways: bool, model: str, photo: Path, shown: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []

    def note(passes, *_):  # type: ignore[no-untyped-def]
        taken.extend(each.note for each in passes if each.rank == 0)
        raise MaskError("that is all")

    monkeypatch.setattr(photographs, "locate_passes", note)
    mask = RoadMask(np.zeros((10, 10), np.bool_))
    monkeypatch.setattr(photographs, "call_segmenter", lambda *_: mask)
    query = ReadOptions(segment="always", segmenter=model if segmenter == "model" else segmenter)
    options = LocateOptions()
    camera = replace(options.match.camera, gsd_m=(0.45, 0.55))
    options = replace(options, match=replace(options.match, camera=camera))
    if ways:
        locate_query(str(photo), [], options, query)
    else:
        with pytest.raises(MaskError):
            locate_query(str(photo), [], options, query)
    photographs.load_model.cache_clear()  # another test looks what is said without a model
    if ways and not segmenter:  # the model that ships is shown all ways at once; then each of these alone
        assert taken == ["", ", a lower threshold", ", shown alone", ", shown alone"]
        return
    assert (len(taken) > 1 and taken[1].endswith("shown 2 ways")) == ways
    assert not any("ways" in item for item in taken[:1] + taken[2:])


def light(folder: Path) -> Path:
    """A model that sees roads where a picture is light."""
    photographs.load_model.cache_clear()
    return brightness_model(folder / "light.onnx", size=256, props={"class_names": {0: "ground", 1: "road"}})


@pytest.mark.parametrize(("ways", "expected"), [(1, [(0.5, 1)]), (2, [(1.0, 1), (0.5, 1)])])
def test_the_first_pass_shows_the_photograph_in_two_ways_to_the_model_that_ships(
    tmp_path: Path,
    photo: Path,
    shown: list[tuple[float, int]],
    ways: int,
    expected: list[tuple[float, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = light(tmp_path)
    if ways == 2:
        monkeypatch.setattr(photographs, "DEFAULT_MODEL", model)
    segmenter = "" if ways == 2 else str(model)
    queries.read_roads(str(photo), (0.45, 0.55), ReadOptions(segment="always", segmenter=segmenter))
    photographs.load_model.cache_clear()
    assert shown == expected


def test_what_was_seen_while_scales_were_ranked_is_looked_at_first(
    tmp_path: Path, photo: Path, shown: list[tuple[float, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(photographs, "DEFAULT_MODEL", light(tmp_path))
    taken: list[str] = []

    def take(passes, see, *_):  # type: ignore[no-untyped-def]
        for each in passes:
            taken.append(f"{each.rank}{each.note}")
            with suppress(MaskError):
                see(each)
        raise MaskError("that is all")

    monkeypatch.setattr(photographs, "locate_passes", take)
    monkeypatch.setattr(photographs, "rank_scales", lambda *_: {0.5: NOTHING, 1.0: None, 2.0: None})
    locate_query(str(photo), [], LocateOptions(), ReadOptions(segment="always"))
    photographs.load_model.cache_clear()
    assert taken == ["0", "1", "2", "0, a lower threshold"]
    # Where its own pixels are not as fine it is turned instead; for other thresholds nothing is shown again.
    assert shown == [(1.0, 2), (2.0, 2)]


def test_a_scale_that_was_tried_alone_is_not_shown_finer(
    tmp_path: Path, photo: Path, shown: list[tuple[float, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was seen at the finest scale that is worth a look goes with the coarser one; a finer one would be dear."""
    monkeypatch.setattr(photographs, "DEFAULT_MODEL", light(tmp_path))
    monkeypatch.setattr(photographs, "rank_scales", lambda *_: dict.fromkeys((0.5, 0.25, 0.125), NOTHING))
    reading = ReadOptions(segment="always")
    with photographs.open_segmented(str(photo), reading, (0.0, np.inf), lambda *_: None) as segmented:
        for each in segmented.passes():
            with suppress(MaskError):
                segmented.roads(each)
    photographs.load_model.cache_clear()
    assert not shown


def test_a_told_scale_takes_no_scale_from_the_passes_of_a_photograph_whose_scale_is_unknown(
    tmp_path: Path, photo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says how large the ground is, not at which scale the model sees it best; it comes first."""
    monkeypatch.setattr(photographs, "DEFAULT_MODEL", light(tmp_path))
    monkeypatch.setattr(photographs, "rank_scales", lambda *_: {1.0: NOTHING, 0.5: NOTHING, 2.0: None})
    monkeypatch.setattr(photographs, "try_scales", lambda *_: (0.5, 1.0, 2.0))
    with photographs.open_segmented(
        str(photo), ReadOptions(segment="always"), (0.95, 1.05), lambda *_: None
    ) as segmented:
        passes = segmented.passes()
        assert [one.rank for one in passes[-segmented.n_further :]] == [1, 2, 3]
        assert {one.rank for one in passes[: -segmented.n_further]} == {0}
        told, *further = [segmented.scale(rank) for rank in range(4)]
    photographs.load_model.cache_clear()
    assert told == pytest.approx(photographs.scale_of(1.0, segmented.network), rel=0.01)
    assert further == [1.0, 0.5, 2.0]


def test_a_photograph_is_located(
    tmp_path: Path, porto: Path, model: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = run(capsys, str(photo), "-r", str(porto), "--segmenter", model, "-o", str(tmp_path))
    assert document["status"] == "located"
    assert document["query"] == str(photo)
    assert offset(document) < 3.0
    with rasterio.open(tmp_path / "flight_mask.tif") as kept:
        assert PROBABILITY_TAG in kept.tags()
        assert kept.shape == cv2.imread(str(photo)).shape[:2]
    with rasterio.open(tmp_path / "flight_footprint.tif") as drawn:
        assert drawn.count >= 3  # the photograph itself, not its mask


def test_roads_of_coarse_pixels_are_traced_on_the_models_grid(
    tmp_path: Path, porto: Path, model: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is told and drawn is of the photograph's own pixels all the same."""
    image = cv2.imread(str(photo))
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(tmp_path / "coarse.png"), small)
    given = ["-r", str(porto), "--segmenter", model, "-o", str(tmp_path)]
    fine = run(capsys, str(photo), *given, "--gsd", "0.6:1")
    coarse = run(capsys, str(tmp_path / "coarse.png"), *given, "--gsd", "1.2:2", "--report")
    height, width = small.shape[:2]
    assert coarse["status"] == "located"
    assert coarse["size"] == [width, height]
    assert coarse["n_intersections"] > 0.8 * fine["n_intersections"]
    truth = MASKS["drone"].homography @ np.diag([2.0, 2.0, 1.0]) @ [width / 2, height / 2, 1]
    found = np.array(coarse["homography"]) @ [width / 2, height / 2, 1]
    assert np.hypot(*(found[:2] / found[2] - truth[:2] / truth[2])) < 3.0
    assert coarse["gsd_m"] == pytest.approx(2 * fine["gsd_m"], rel=0.02)
    with rasterio.open(tmp_path / "coarse_mask.tif") as kept:
        assert kept.shape == (height, width)


@pytest.mark.parametrize(
    ("own", "scale", "expected"),
    [
        ((750, 750), 2.0, 2.0),
        ((750, 750), 1.6, 1.6),
        ((750, 750), 4.0, 2.0),  # no finer than that: a model sees nothing there
        ((750, 750), 1.1, 1.0),  # hardly finer
        ((3000, 3000), 0.5, 1.0),  # never coarser
        ((5000, 6400), 2.0, 2.0**0.5),  # memory is bounded
        ((8000, 8000), 2.0, 1.0),
    ],
)
def test_how_much_finer(own: tuple[int, int], scale: float, expected: float) -> None:
    assert _how_much_finer(own, scale) == pytest.approx(expected)


def test_what_was_seen_is_told_and_drawn(
    tmp_path: Path, porto: Path, model: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(photo), "-r", str(porto), "--segmenter", model, "-o", str(tmp_path), "--report"]
    assert main(["locate", *given]) == 0
    output = capsys.readouterr()
    assert "looking for the scale of" in output.err
    assert "times the mask's size" not in output.out
    page = (tmp_path / "flight_report.html").read_text()
    assert page.count('<g class="probability off"><image') == 1
    assert main(["locate", str(DRONE), "-r", str(porto), "-o", str(tmp_path), "--report"]) == 0
    assert "probability" not in (tmp_path / "drone_report.html").read_text().split("<script>")[0].split("</style>")[1]


@pytest.mark.parametrize("stated", [None, 0.8])
def test_no_scale_is_looked_for_in_vain(
    porto: Path, model: str, photo: Path, monkeypatch: pytest.MonkeyPatch, stated: float | None
) -> None:
    """Where the file states one it comes first; where none is known, what was seen on the way is taken."""
    calls = []
    monkeypatch.setattr(scales, "_TRIED_TILES", 4.0)  # no scale that may be the best is shown in part
    monkeypatch.setattr(photographs, "estimate_gsd", lambda _: stated)
    monkeypatch.setattr(photographs, "rank_scales", lambda *given: calls.append("ranked") or rank_scales(*given))
    monkeypatch.setattr(
        photographs, "segment", lambda *given, **reported: calls.append("shown") or segment(*given, **reported)
    )
    query = ReadOptions(segmenter=model)
    sighting = locate_query(str(photo), [open_reference(porto)], reading=query)
    assert sighting.location.located
    assert calls == ["ranked" if stated is None else "shown"]
    calls.clear()
    small = cv2.imread(str(photo))[:480, :480]
    cv2.imwrite(str(photo.with_name("small.png")), small)
    queries.read_roads(str(photo.with_name("small.png")), None, query)
    assert calls == (["ranked"] if stated is None else ["shown"])


def test_what_is_seen_is_shown_without_a_map(
    tmp_path: Path, model: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Traced on a finer grid where pixels are coarse; the layers lie on the photograph all the same."""
    image = cv2.imread(str(photo))
    cv2.imwrite(str(tmp_path / "coarse.png"), cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    given = ["--segmenter", model, "-o", str(tmp_path / "seen")]
    assert main(["vectorize", str(photo), *given, "--gsd", "0.6:1"]) == 0
    assert main(["vectorize", str(tmp_path / "coarse.png"), *given, "--gsd", "1.2:2"]) == 0
    assert "flight_mask.tif" in capsys.readouterr().out
    points = {
        name: read_layer(tmp_path / "seen" / f"{name}_vectorized.gpkg", "intersections")[0]
        for name in ("flight", "coarse")
    }
    assert len(points["coarse"]) > 0.8 * len(points["flight"])
    fine = np.array(points["flight"]) / 2
    nearest = np.linalg.norm(np.array(points["coarse"])[:, None] - fine, axis=2).min(axis=1)
    assert np.median(nearest) < 0.5
    with rasterio.open(tmp_path / "seen" / "coarse_mask.tif") as kept:
        assert PROBABILITY_TAG in kept.tags()
        assert kept.shape == (image.shape[0] // 2, image.shape[1] // 2)
    drawn = cv2.imread(str(tmp_path / "seen" / "flight_vectorized.png"))
    assert drawn.shape == image.shape
    far = cv2.distanceTransform(np.uint8(image.max(axis=2) < 200), cv2.DIST_L2, 3) > 20
    assert np.corrcoef(drawn[far].ravel(), image[far].ravel())[0, 1] > 0.9  # the photograph itself, faded


def test_a_threshold_makes_no_mask_of_a_photograph(photo: Path, model: str) -> None:
    reading = ReadOptions(threshold=0.4, segmenter=model)
    assert queries.read_roads(str(photo), (0.6, 1.0), reading).probability is not None
    assert queries.read_roads(str(DRONE), None, reading).probability is None
    as_mask = replace(reading, threshold=200.0, segment="never")
    assert queries.read_roads(str(photo), None, as_mask).probability is None


def test_what_plugins_and_masks_show(
    tmp_path: Path, photo: Path, model: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(photographs, "call_plugin", lambda *_: cv2.imread(str(DRONE), cv2.IMREAD_GRAYSCALE))
    seen = queries.read_roads(str(photo), None, ReadOptions(segmenter="plugin"))
    assert seen.probability is None
    assert seen.coarser == 1.0
    np.testing.assert_array_equal(seen.mask.roads, queries.read_roads(str(DRONE), None, ReadOptions()).mask.roads)
    assert main(["vectorize", str(photo), "--segment", "never", "-o", str(tmp_path)]) == 1
    assert "looks like a photograph" in capsys.readouterr().err
    given = ["vectorize", str(photo), "-o", str(tmp_path), "--segmenter", model]
    assert main([*given, "--segment", "always", "--threshold", "0.999"]) == 1
    assert "no road is seen in it that is probable enough; wrote" in capsys.readouterr().err
    assert (tmp_path / "flight_mask.tif").exists()
    (tmp_path / "flight_mask.tif").write_bytes(b"the user's")
    assert main(given) == 1
    assert "was not written by roadgeo" in capsys.readouterr().err
    assert (tmp_path / "flight_mask.tif").read_bytes() == b"the user's"


def test_our_own_probability_map_is_no_further_query(
    tmp_path: Path, porto: Path, model: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "flight.jpg").write_bytes(photo.read_bytes())
    given = [str(tmp_path), "-r", str(porto), "--segmenter", model, "-o", str(tmp_path)]
    run(capsys, *given)
    assert (tmp_path / "flight_mask.tif").exists()
    assert run(capsys, *given)["query"].endswith("flight.jpg")


def test_a_mask_of_the_users_is_not_overwritten(
    tmp_path: Path, porto: Path, model: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "flight_mask.tif"
    cv2.imwrite(str(mine), np.zeros((50, 50), np.uint8))
    content = mine.read_bytes()
    status = main(["locate", str(photo), "-r", str(porto), "--segmenter", model, "-o", str(tmp_path)])
    assert status == 1
    assert "not written by roadgeo" in capsys.readouterr().err
    assert mine.read_bytes() == content
    assert [path.name for path in tmp_path.iterdir()] == ["flight_mask.tif"]


def test_a_photograph_that_shows_no_road_is_not_located(
    tmp_path: Path, porto: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    dark = rng.integers(20, 90, (300, 300, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "dark.png"), dark)
    out = str(tmp_path / "out")
    given = [str(tmp_path / "dark.png"), "-r", str(porto), "--segmenter", model, "-o", out]
    document = run(capsys, *given, "--segment", "always", "--report")
    assert document["status"] == "not_located"
    assert "hardly a road" in document["reason"]
