"""What Python programs call, with all that they may have at hand."""

import inspect
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from worlds.demo import DRONE
from worlds.rasters import write_raster

import roadgeo
from roadgeo.api import _is_place
from roadgeo.errors import MaskError, NotLocatedError
from roadgeo.evaluation.demo import PHOTO, ROADS
from roadgeo.matching.hints import as_keywords
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.triples import Sweep, TripleOptions
from roadgeo.reference.files import reference_digest
from roadgeo.sources.roads import read_roads

QUICK = LocateOptions(effort="quick")


@pytest.fixture(scope="module")
def porto() -> roadgeo.Reference:
    return roadgeo.index(ROADS, "porto")


@pytest.fixture(scope="module")
def answer(porto: roadgeo.Reference) -> roadgeo.Answer:
    return roadgeo.locate(DRONE, porto, QUICK)


def picture(kind: str, folder: Path) -> object:
    """The demonstration's mask as another library holds it."""
    rows = cv2.imread(str(DRONE), cv2.IMREAD_GRAYSCALE)
    colours = np.repeat(rows[..., None], 3, axis=2)
    if kind == "PIL":
        return pytest.importorskip("PIL.Image").open(DRONE)
    if kind == "PIL, black on transparent":
        image = pytest.importorskip("PIL.Image")
        return image.fromarray(np.dstack([np.zeros_like(colours), rows]), "RGBA")
    if kind.startswith("xarray"):
        array = pytest.importorskip("xarray").DataArray
        return array(colours.transpose(2, 1, 0), dims=("band", "x", "y"))
    if kind == "rasterio":
        return rasterio.open(write_raster(folder / "a.tif", rows, transform=rasterio.Affine.scale(2)))
    shapes = {"HW": rows > 127, "HWC": colours, "CHW": colours.transpose(2, 0, 1), "1HW": rows[None]}
    return {"text": str(DRONE), "path": DRONE, **shapes}[kind]


@pytest.mark.parametrize(
    "kind",
    ["text", "HW", "HWC", "CHW", "1HW", "PIL", "PIL, black on transparent", "xarray", "rasterio"],
)
def test_a_mask_is_located_however_it_is_held(
    kind: str, porto: roadgeo.Reference, answer: roadgeo.Answer, tmp_path: Path
) -> None:
    found = roadgeo.locate(picture(kind, tmp_path), porto, QUICK)
    assert found.located
    np.testing.assert_allclose(found.footprint, answer.footprint, atol=1.0)


def test_what_is_no_picture_is_named(porto: roadgeo.Reference) -> None:
    with pytest.raises(MaskError, match=r"array of shape \(4,\); expected \(rows, columns\)"):
        roadgeo.locate(np.zeros(4), porto)


def test_references_go_by_path_and_by_name(
    porto: roadgeo.Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path))
    porto.save(tmp_path / "porto.gpkg")
    for reference in ((), "porto", tmp_path / "porto.gpkg", [porto, "porto"]):
        assert roadgeo.locate(DRONE, reference, QUICK).located


def test_an_answer_says_what_was_asked_and_of_which_map(porto: roadgeo.Reference, tmp_path: Path) -> None:
    """As the JSON of the command line does, but for the command."""
    built = roadgeo.index(ROADS, path=tmp_path / "city.gpkg")
    assert repr(built) == f"<Reference 'city': 2,649 intersections, EPSG:32629, {tmp_path / 'city.gpkg'}>"
    found = roadgeo.locate(DRONE, built, QUICK, gsd=1.0)
    assert found.options == {"effort": "quick", "match": {"camera": {"gsd_m": [0.8, 1.25]}}}
    assert found.reference_digest == reference_digest(tmp_path / "city.gpkg")
    for item in (porto, porto.index, found, found.mask, read_roads(ROADS), roadgeo.explain(found.mask, built, QUICK)):
        assert "\n" not in repr(item)
        assert len(repr(item)) < 200
    (written,) = (path for path in found.write(tmp_path) if path.suffix == ".json")
    assert json.loads(written.read_text())["reference_digest"] == found.reference_digest


def test_an_answer_tells_of_options_within_options(porto: roadgeo.Reference) -> None:
    match = replace(QUICK.match, sweeps=(Sweep(TripleOptions(n_neighbours=9), 7),))
    said = roadgeo.locate(DRONE, porto, replace(QUICK, match=match)).options
    (sweep,) = said["match"]["sweeps"]
    assert (sweep["max_anchors"], sweep["triples"]["n_neighbours"]) == (7, 9)


def test_what_is_known_narrows_the_search(porto: roadgeo.Reference) -> None:
    known = {"gsd": 1.0, "near": (-8.6, 41.15, 3000.0), "within": "Portugal", "max_tilt": 50.0}
    assert roadgeo.locate(DRONE, porto, QUICK, **known).located
    for wrong, code in (
        ({"near": (2.35, 48.85, 100.0)}, "few_near"),
        ({"within": "Germany"}, "few_near"),
        ({"within": (-8.7, 41.0, -8.65, 41.3)}, "fits_elsewhere"),
        ({"gsd": (2.0, 3.0), "max_tilt": 5.0, "north_up": True}, "nothing_stands_out"),
    ):
        refused = roadgeo.locate(DRONE, porto, QUICK, **wrong)
        assert (refused.status, refused.reason_code) == ("not_located", code)
    with pytest.raises(ValueError, match=r"did you mean near=-8.6,41.15,3000"):
        roadgeo.locate(DRONE, porto, QUICK, near=(41.15, -8.6, 3000.0))
    for within in ("Portugol", (41.1, -8.6, 41.2, -8.7)):
        with pytest.raises(ValueError, match=r"Portugol|south must lie below north"):
            roadgeo.locate(DRONE, porto, QUICK, within=within)


def test_a_photograph_goes_the_way_of_the_command_line(
    porto: roadgeo.Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    from roadgeo.running import queries
    from roadgeo.running.passes import Sighting

    def segmented(path: str, *_: object) -> Sighting:
        return Sighting(roadgeo.Location(path, "not_located", "hardly a road"), roadgeo.RoadMask(np.zeros((9, 9))))

    monkeypatch.setattr(queries, "locate_photograph", segmented)
    found = roadgeo.locate(PHOTO, porto)
    assert (found.reason, found.photo) == ("hardly a road", str(PHOTO))


def test_an_answer_is_written_as_by_the_command_line(answer: roadgeo.Answer, tmp_path: Path) -> None:
    files = answer.write(tmp_path / "out", also=["overlay", "report", "matches"])
    assert sorted(path.name for path in files) == sorted(path.name for path in (tmp_path / "out").iterdir())
    assert {"drone_footprint.tif", "drone_overlay.png", "drone_report.html"} <= {path.name for path in files}


def test_an_answer_is_an_array_on_the_map(answer: roadgeo.Answer, tmp_path: Path) -> None:
    pytest.importorskip("xarray")
    array = answer.to_xarray()
    (path,) = (path for path in answer.write(tmp_path) if path.suffix == ".tif")
    with rasterio.open(path) as raster:
        np.testing.assert_array_equal(array.values, raster.read(1))
        assert tuple(raster.transform)[:6] == array.attrs["transform"]
        np.testing.assert_allclose((array.x[0], array.y[0]), raster.xy(0, 0))
        assert raster.crs.to_epsg() == int(array.attrs["crs"].split(":")[1])


def test_an_answer_is_drawn(answer: roadgeo.Answer, porto: roadgeo.Reference, tmp_path: Path) -> None:
    answer.plot().save(tmp_path / "a.png")
    assert answer.plot()._repr_svg_().startswith("<svg")
    assert cv2.imread(str(tmp_path / "a.png")).std() > 10
    refused = roadgeo.locate(DRONE, porto, QUICK, near=(2.0, 48.0, 10.0))
    for draw in (refused.plot, refused.to_xarray):
        with pytest.raises(NotLocatedError):
            draw()
    assert [path.name for path in refused.write(tmp_path / "refused")] == ["drone_location.json"]


@pytest.mark.parametrize("kind", ["array", "floats", "PIL"])
def test_photographs_that_are_no_files_are_segmented_as_files_are(
    kind: str, porto: roadgeo.Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from roadgeo.running import queries
    from roadgeo.running.passes import Sighting

    photograph = cv2.cvtColor(cv2.imread(str(PHOTO)), cv2.COLOR_BGR2RGB)
    given = {"array": photograph, "floats": photograph / 255.0, "PIL": Image.fromarray(photograph)}[kind]
    read: list[np.ndarray] = []

    def segmented(path: str, *_: object) -> Sighting:
        with rasterio.open(path) as file:
            read.append(np.moveaxis(file.read(), 0, 2))
        location = roadgeo.Location(path, "not_located", f"hardly a road in {path}")
        return Sighting(location, roadgeo.RoadMask(np.zeros((9, 9))))

    monkeypatch.setattr(queries, "locate_photograph", segmented)
    found = roadgeo.locate(given, porto)
    assert (found.query, found.reason, found.photo) == ("array", "hardly a road in array", None)
    assert np.array_equal(read[0], photograph)
    assert found.pixels is not None


@pytest.mark.parametrize(
    ("text", "is_place"),
    [("Boston, MA", True), ("St. Gallen", True), ("Washington D.C.", True), ("streets.gpkg", False), ("a/b", False)],
)
def test_places_are_told_from_files(text: str, is_place: bool) -> None:
    assert _is_place(text) is is_place


def test_the_roads_of_a_place_are_fetched(monkeypatch: pytest.MonkeyPatch) -> None:
    from roadgeo.sources import roads as sources

    asked: list[dict[str, object]] = []
    monkeypatch.setattr(sources, "fetch_roads", lambda **where: asked.append(where) or read_roads(ROADS))
    assert roadgeo.index("Porto, Portugal").name == "porto-portugal"
    assert roadgeo.index((-8.7, 41.1, -8.6, 41.2)).name == "box"
    assert [(query.get("place"), query.get("bbox")) for query in asked] == [
        ("Porto, Portugal", None),
        (None, (-8.7, 41.1, -8.6, 41.2)),
    ]


def test_what_the_camera_states_is_a_hint(porto: roadgeo.Reference, tmp_path: Path) -> None:
    from sources.test_camera import MAKERS, photograph

    photo = Image.open(DRONE).convert("L")
    view = photograph(tmp_path / "photo.jpg", MAKERS["DJI"])
    with Image.open(view) as stated:
        photo.save(tmp_path / "drone.jpg", exif=stated.getexif(), xmp=stated.info["xmp"], quality=95)
    with pytest.raises(ValueError, match="is for files"):
        roadgeo.locate(photo, porto, QUICK, near="exif")
    found = roadgeo.locate(tmp_path / "drone.jpg", porto, QUICK, near="exif")
    assert not found.located  # it says that it is elsewhere
    assert found.options["near"][:2] == pytest.approx((-8.6283, 41.1625), abs=1e-4)
    free = roadgeo.locate(tmp_path / "drone.jpg", porto, QUICK)
    assert free.located
    assert free.stated_offset_m == pytest.approx(2050, rel=0.2)


def test_the_advice_of_a_refusal_names_keywords(porto: roadgeo.Reference) -> None:
    refused = roadgeo.locate(DRONE, porto, QUICK, near=(-8.5, 41.0, 10.0))
    assert "--" not in refused.reason
    assert as_keywords("5 % (--gsd SIZE+-5%), or leave --max-tilt out") == '5 % (gsd="SIZE+-5%"), or leave max_tilt out'


def test_what_is_no_picture_is_none_for_a_type_checker() -> None:
    assert inspect.signature(roadgeo.locate).parameters["mask"].annotation == "Picture | RoadMask"
    assert inspect.signature(roadgeo.vectorize).parameters["image"].annotation == "Picture"


@pytest.mark.parametrize("frames", [3.14, None, ["a.png", 3], [np.zeros((40, 40))]])
def test_a_flight_is_of_files(porto, frames):
    with pytest.raises(MaskError, match=r"is no path, nor several; expected files, folders or patterns"):
        roadgeo.track(frames, porto)


#: What takes each kind of argument, and what is answered to one of another type.
TAKES = {
    "locate": (lambda given, _: roadgeo.locate(given), "is no picture; expected a path"),
    "vectorize": (lambda given, _: roadgeo.vectorize(given), "is no picture; expected a path"),
    "verify": (lambda given, _: roadgeo.verify(given), "is no path; expected a file's"),
    "fence": (lambda given, _: roadgeo.fence(given), "is no path, nor several"),
    "index": (lambda given, _: roadgeo.index(given), "cannot be read: .*expected a path"),
    "path": (lambda given, _: roadgeo.index(ROADS, path=given or 0), "is no path; expected a file's"),
    "kinds": (lambda given, _: roadgeo.index(ROADS, kinds=given), "expected one of main, drivable"),
    "motion": (lambda given, porto: roadgeo.track("a.png", porto, motion=given or 0), "is no path; expected a file's"),
    "open": (lambda given, _: roadgeo.open_reference(given), "is no reference; expected a path, a name"),
    "locate on": (lambda given, _: roadgeo.locate(DRONE, given), "is no reference; expected a path, a name"),
    "verify on": (lambda given, _: roadgeo.verify(DRONE, [given]), "is no reference; expected a path, a name"),
    "track on": (lambda given, _: roadgeo.track("a.png", given), "is no reference; expected a path, a name"),
}


@pytest.mark.parametrize("given", [3.14, None, True, object()], ids=["float", "None", "bool", "object"])
@pytest.mark.parametrize("taker", TAKES)
def test_what_is_of_another_type_is_answered_in_one_line(porto, taker, given):
    call, answer = TAKES[taker]
    with pytest.raises(roadgeo.RoadgeoError, match=answer):
        call(given, porto)


@pytest.mark.parametrize("given", ["", "."])
def test_a_reference_has_a_name(given):
    with pytest.raises(roadgeo.RoadgeoError, match="names no reference; expected a path such as"):
        roadgeo.open_reference(given)


@pytest.mark.parametrize("place", ["first", 3.14, None, (1.0, 2.0, 3.0)])
def test_a_place_is_a_number_or_a_point(answer, place):
    with pytest.raises(NotLocatedError, match="is no place; expected its number, from 1, or longitude and latitude"):
        answer.take(place)
    assert answer.take(np.int64(1)).center == answer.center


def test_the_start_of_a_flight_may_be_text(porto, tmp_path):
    Image.open(DRONE).save(tmp_path / "a.png")
    (row,) = roadgeo.track(tmp_path / "a.png", porto, start="2024-05-01T09:30:00+01:00")
    assert row.time is not None
    assert row.time.isoformat() == "2024-05-01T08:30:00+00:00"


def test_frames_have_their_own_times_unless_told(porto, tmp_path):
    for name in ("1.5.png", "2.0.png", "4.5.png"):
        Image.new("L", (90, 60)).save(tmp_path / name)
    assert [row.time_s for row in roadgeo.track(tmp_path, porto)] == [0.0, 0.5, 3.0]
    assert [row.time_s for row in roadgeo.track(tmp_path, porto, interval=2.0)] == [0.0, 2.0, 4.0]
