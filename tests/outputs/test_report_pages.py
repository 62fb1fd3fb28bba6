"""The HTML report: what it says and holds, how large it gets, and how it works in a real browser without a network."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.browser import Browser, Page, browser
from worlds.answers import moved, with_place
from worlds.demo import MASKS

from roadgeo.cli import main
from roadgeo.errors import MaskError, OutputError
from roadgeo.evaluation.demo import ATTRIBUTION
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask, pixel_to_plane, plane_to_pixel
from roadgeo.geometry.placement import Matches
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Location, Reason
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.drawing.svg import draw_dots, draw_image, draw_lines, join_segments, thin_lines
from roadgeo.outputs.drawing.views import whole_map
from roadgeo.outputs.location_files import OutputOptions, write_location
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.report import Entry, render_batch, write_batch
from roadgeo.outputs.report.page import render_report as render_subject
from roadgeo.outputs.subject import Subject, ViewLimits
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.sources.masks import read_mask
from roadgeo.workflows import locate

__all__ = ["browser"]

MAX_BYTES = 3_000_000


@pytest.fixture(scope="module")
def porto(porto: Path) -> Reference:
    """The map of the demonstration."""
    return open_reference(porto)


@pytest.fixture(scope="module")
def drone() -> RoadMask:
    """A mask that shows a part of it from a tilted camera."""
    return replace(read_mask(MASKS["drone"].path), name="drone.png")


@pytest.fixture(scope="module")
def found(porto: Reference, drone: RoadMask) -> Location:
    """Where that mask lies."""
    location = locate(drone, porto)
    assert location.located
    return location


def rival(location: Location, dx: float = 400.0, dy: float = 400.0) -> Location:
    """The same with a runner-up somewhere else."""
    assert location.place is not None
    return with_place(location, score=8.5, rival=moved(location.place, dx, dy, score=7.5))


def on_another_map(location: Location) -> Location:
    """The same, its runner-up on a map whose zone is another."""
    other = replace(location.place.rival, plane=LocalPlane("EPSG:32632", (597000.0, 6642000.0)), reference="Oslo")
    return with_place(location, rival=other)


def render_report(
    location: Location,
    mask: RoadMask,
    index: ReferenceIndex,
    attribution: str = "",
    picture: Path | None = None,
    options: ViewLimits | None = None,
) -> str:
    """Its page."""
    index = replace(index, meta={**index.meta, "attribution": attribution})
    views = options or ViewLimits()
    return render_subject(Subject(location, mask, output_paths("", "a"), photo=picture, indexes=[index], views=views))


class Reader(HTMLParser):
    """Collects tags with their attributes, and the text that people read."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in {"meta", "link", "input", "br"}:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.text += data


# --- what it says -----------------------------------------------------------------------------------------------------


def test_a_located_mask_is_shown_and_explained(porto: Reference, drone: RoadMask, found: Location) -> None:
    page = render_report(found, drone, porto.index, ATTRIBUTION)
    assert len(page.encode()) < MAX_BYTES
    read = Reader(page)
    assert read.open == []
    text = read.text
    assert found.reason in text
    for said in ("✓ located", ATTRIBUTION, "EPSG:32629", f"{found.n_matched} of {found.n_intersections} matched"):
        assert said in text
    assert found.center is not None
    assert f"{found.center.x:,.1f}, {found.center.y:,.1f}" in text
    layers = {attrs.get("class") for tag, attrs in read.tags if tag == "g"}
    assert {"map-roads", "query-roads", "footprint", "residuals", "matches", "sigma", "edge"} <= layers
    assert page.count('<button type="button" data-x=') == 4
    assert len(re.findall(r'<td><button type="button">\d+</button>', page)) == found.n_matched


def test_an_image_that_was_mirrored_is_said_to_be(porto: Reference, drone: RoadMask, found: Location) -> None:
    assert found.place is not None
    over = np.array([[-1.0, 0.0, drone.shape[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    place = replace(found.place, matrix=found.place.matrix @ over)
    mirrored = replace(found, places=(place, *found.places[1:]))
    said = "clockwise from north, mirrored"
    assert said in Reader(render_report(mirrored, drone, porto.index)).text
    assert said not in Reader(render_report(found, drone, porto.index)).text


def test_the_page_asks_nobody_for_anything(porto: Reference, drone: RoadMask, found: Location) -> None:
    read = Reader(render_report(found, drone, porto.index))
    for tag, attrs in read.tags:
        for name in ("src", "href", "action", "data", "poster"):
            address = attrs.get(name) or "data:"
            assert address.startswith("data:") or tag == "a"
    policies = [attrs["content"] for tag, attrs in read.tags if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert policies[0].startswith("default-src 'none';")


def test_a_mask_that_was_not_located_is_shown_with_the_reason(porto: Reference) -> None:
    mask = read_mask(MASKS["elsewhere"].path)
    location = locate(mask, porto)
    text = Reader(page := render_report(location, mask, porto.index)).text
    assert location.status == "not_located"
    for said in ("✕ not located", location.reason[1:], "Nothing was georeferenced", "It was porto.", "--near"):
        assert said in text
    assert 'data-frame="map"' not in page
    assert 'class="overview"' in page
    best = location.alternatives[0]
    assert f'<a href="https://www.openstreetmap.org/?mlat={best.center.lat:.6f}' in page
    assert "href" not in text
    few = replace(location, content=replace(location.content, xy=np.zeros((4, 2))))
    assert "4 intersections are seen in the mask: few" in Reader(render_report(few, mask, porto.index)).text


def test_a_footprint_over_the_edge_of_the_map_is_shown_whole(
    porto: Reference, drone: RoadMask, found: Location
) -> None:
    assert found.place is not None
    beyond = replace(found, places=(moved(found.place, 1500.0, 0.0),))
    page = render_report(beyond, drone, porto.index)
    (box,) = re.findall(r'class="overview" viewBox="([^"]+)"', page)
    left, _, width, _ = map(float, box.split())
    _, window = whole_map(porto.index, 2000, 100)
    assert beyond.place is not None
    east = window.place(beyond.place.footprint)[:, 0].max()
    assert window.width < east <= left + width + 1.0


def test_half_a_place_is_no_choice_of_two(porto: Reference, drone: RoadMask, found: Location) -> None:
    reason = "only half a place is known: the middle lies within +-200 m along 62 degrees from north"
    location = replace(found, status="ambiguous", reason=reason, reason_code=Reason.HALF_A_PLACE)
    text = Reader(render_report(location, drone, porto.index)).text
    for said in ("≈ ambiguous", "nly half a place is known", "known in one direction only", "in other directions"):
        assert said in text
    assert "Two places fit" not in text


def test_two_places_are_both_shown(porto: Reference, drone: RoadMask, found: Location) -> None:
    location = replace(rival(found), status="ambiguous", reason="two places fit almost equally")
    page = render_report(location, drone, porto.index)
    text = Reader(page).text
    assert "≈ ambiguous" in text
    assert "570 m to the north-east, 8.5 behind by the score" in text
    unsure = render_report(with_place(location, score=-0.4), drone, porto.index)
    assert "to the north-east, 0.0 behind by the score" in Reader(unsure).text
    assert page.count('<g class="runner-up"') == 2  # around the footprint, and on the whole map
    elsewhere = Reader(render_report(on_another_map(location), drone, porto.index)).text
    assert "km to the" in elsewhere
    assert ", on the map Oslo, 8.5 behind by the score" in elsewhere
    far = render_report(rival(location, -30_000.0, 0.0), drone, porto.index)
    assert "30 km to the west" in far
    assert far.count('<g class="runner-up"') == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"matches": None},
        {"corner_covariance_m2": None},
        {"score": np.nan, "is_pinhole": False},
        {"matches": Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))},
        {"corner_covariance_m2": np.full((8, 8), np.nan), "is_pinhole": False},
    ],
    ids=["matches", "accuracy", "score", "no matches", "no accuracy"],
)
def test_what_is_not_known_is_left_out(porto: Reference, drone: RoadMask, found: Location, changes: dict) -> None:
    several = replace(with_place(found, **changes), reference="porto, lisbon")
    text = Reader(render_report(several, drone, porto.index)).text
    assert "nan" not in text.replace("°", " ").lower().split()
    assert "None" not in text


def test_names_are_text_and_nothing_else(porto: Reference, drone: RoadMask, found: Location) -> None:
    evil = '"><script>alert("x")</script>.png'
    location = replace(found, query=evil, reference=evil, reason=evil)
    index = replace(porto.index, meta={**porto.index.meta, "name": evil, "sources": [{"name": evil}]})
    read = Reader(render_report(location, drone, index, evil))
    assert [tag for tag, _ in read.tags].count("script") == 1
    assert evil in read.text


def test_a_photograph_is_shown_in_place_of_the_mask(
    porto: Reference, drone: RoadMask, found: Location, tmp_path: Path
) -> None:
    rows, columns = drone.shape
    photograph = np.random.default_rng(0).integers(0, 65535, (rows * 2, columns * 2, 3), np.uint16)
    cv2.imwrite(str(tmp_path / "photo.png"), photograph)
    page = render_report(found, drone, porto.index, picture=tmp_path / "photo.png")
    assert len(page.encode()) < MAX_BYTES
    assert "photograph</label>" in page
    with pytest.raises(MaskError, match="missing"):
        render_report(found, drone, porto.index, picture=tmp_path / "missing.png")


def test_the_report_is_written_in_one_step(porto: Reference, drone: RoadMask, found: Location, tmp_path: Path) -> None:
    refused, options = replace(found, status="not_located"), OutputOptions(products=("report",))
    write_location(refused, drone, output_paths(tmp_path, "drone"), options, indexes=[porto.index])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drone_location.json", "drone_report.html"]
    with pytest.raises(OutputError, match="cannot write"):
        write_location(refused, drone, output_paths(tmp_path / "none", "drone"), options, indexes=[porto.index])


# --- many masks -------------------------------------------------------------------------------------------------------


def test_many_masks_are_listed_with_their_reports(porto: Reference, found: Location) -> None:
    elsewhere = replace(found, query="b/else&where.png", status="not_located", reason="no <place>")
    documents = [
        found.to_dict(),
        elsewhere.to_dict(),
        {"query": "c.png", "status": "error", "reason": "c.png: missing"},
    ]
    links = ["drone_report.html", "else & where_report.html", ""]
    entries = list(map(Entry, documents, links))
    other = replace(porto.index, meta={**porto.index.meta, "name": "lisbon", "attribution": "© Lisbon"})
    read = Reader(render_batch(entries, [other, porto.index]))
    assert read.open == []
    for said in ("3 images", "1 located, 1 not located, 1 failed", "else&where.png", "no <place>", "c.png: missing"):
        assert said in read.text
    assert "On porto" in read.text  # nothing lies on the first, which is shown because it was searched
    addresses = [attrs["href"] for tag, attrs in read.tags if tag == "a"]
    assert addresses == ["drone_report.html", "else%20%26%20where_report.html", "drone_report.html"]
    assert "© Lisbon; © OpenStreetMap" in read.text
    assert "a/drone.png" not in read.text
    twice = [Entry({**entries[0].document, "query": f"{folder}/drone.png"}) for folder in ("x/a", "x/b")]
    assert "a/drone.png ✓ located" in Reader(render_batch(twice, [porto.index])).text
    assert len(render_batch(entries[:1] * 9000, [porto.index]).encode()) < MAX_BYTES


def test_the_command_line_writes_reports(
    porto: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    reference = str(porto.index.path)
    for name in ("drone", "elsewhere"):
        (tmp_path / f"{name}.png").write_bytes(MASKS[name].path.read_bytes())
    (tmp_path / "broken.png").write_bytes(b"no picture")
    (tmp_path / "broken_report.html").touch()  # of an earlier run, when it was not broken
    arguments = ["locate", "drone.png", "elsewhere.png", "broken.png", "-r", reference, "--report", "--jobs", "2"]
    assert main(arguments) == 1
    assert "roadgeo_report.html" in capsys.readouterr().err
    assert "✓ located" in (tmp_path / "drone_report.html").read_text(encoding="utf-8")
    assert "✕ not located" in (tmp_path / "elsewhere_report.html").read_text(encoding="utf-8")
    page = (tmp_path / "roadgeo_report.html").read_text(encoding="utf-8")
    assert "1 located, 1 not located, 1 failed" in page
    assert ATTRIBUTION in page
    assert "broken_report.html" not in page
    assert main(["locate", "elsewhere.png", "-r", reference, "--quiet"]) == 3
    assert not (tmp_path / "elsewhere_report.html").exists()  # nothing that no longer holds is left


# --- how large it gets ------------------------------------------------------------------------------------------------


def test_the_file_stays_small_whatever_is_shown(porto: Reference, found: Location, tmp_path: Path) -> None:
    """A map of 150,000 road segments, a mask of 100 streets across and along, a photograph of noise, 20,000 matches."""
    rng = np.random.default_rng(0)
    ring = porto.index.plane.from_crs(found.footprint)
    low, high = ring.min(axis=0), ring.max(axis=0)
    start = rng.uniform(low - 500, high + 500, (150_000, 2))
    segments = np.hstack([start, start + rng.normal(0, 60, start.shape)]).astype(np.float32)
    index = replace(porto.index, segments=segments)
    mask = RoadMask(np.zeros((1000, 1000), bool), name="grid")
    mask.roads[3::10] = mask.roads[4::10] = True
    mask.roads[:, 3::10] = mask.roads[:, 4::10] = True
    pixels = rng.uniform(0, 1000, (20_000, 2))
    at = Homography(found.homography)(pixels)
    matches = Matches(pixel_to_plane(pixels), at + 1.0, rng.uniform(0, 9, 20_000))
    location = with_place(found, matches=matches, size=(1000, 1000))
    cv2.imwrite(str(tmp_path / "noise.png"), rng.integers(0, 255, (1800, 1800, 3), np.uint8))
    page = render_report(location, mask, index, picture=tmp_path / "noise.png")
    assert 1_000_000 < len(page.encode()) < MAX_BYTES
    assert "18500 more, with smaller residuals, are not shown" in page


def test_limits_can_be_chosen(porto: Reference, drone: RoadMask, found: Location) -> None:
    options = ViewLimits(
        max_map_vertices=200, max_query_vertices=100, max_matches=3, picture_bytes=2000, overview_bytes=2000
    )
    page = render_report(found, drone, porto.index, options=options)
    assert len(page.encode()) < 80_000
    assert len(re.findall(r'<td><button type="button">\d+</button>', page)) == 3


# --- its pieces -------------------------------------------------------------------------------------------------------


coordinates = st.floats(-1e5, 1e5).map(lambda value: round(value, 1))
polylines = st.lists(st.integers(2, 6).flatmap(lambda n: arrays(float, (n, 2), elements=coordinates)), max_size=5)


@given(polylines, st.integers(2, 20), st.sampled_from([0.0, 0.4]))
def test_thinned_lines_keep_to_the_limit_and_their_ends(lines: list, limit: int, tolerance: float) -> None:
    thin = thin_lines(lines, limit, tolerance)
    assert sum(map(len, thin)) <= limit
    ends = [line[[0, -1]].tolist() for line in lines]
    for line in thin:
        assert any(np.allclose(line[[0, -1]], one, atol=0.02) for one in ends)


def test_segments_that_meet_become_one_line() -> None:
    segments = np.array([[[0, 0], [1, 0]], [[1, 0], [1, 1]], [[5, 5], [6, 6]]], float)
    assert [line.tolist() for line in join_segments(segments)] == [[[0, 0], [1, 0], [1, 1]], [[5, 5], [6, 6]]]
    assert join_segments(np.empty((0, 2, 2))) == []
    assert draw_lines([]) == ""
    assert draw_dots(np.empty((0, 2))) == ""


@pytest.mark.parametrize("lossless", [True, False])
@pytest.mark.parametrize("limit", [200, 5000, 10**6])
def test_a_picture_keeps_to_its_limit(lossless: bool, limit: int) -> None:
    image = np.random.default_rng(1).integers(0, 255, (120, 160, 4), np.uint8)
    svg = draw_image(image, (1, 2, 160, 120), limit, lossless=lossless)
    encoded = base64.b64decode(re.search(r"base64,([^\"]+)", svg)[1])
    assert len(encoded) <= limit
    decoded = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    if lossless and limit == 10**6:
        seen = image[..., 3] > 0
        assert np.array_equal(decoded[..., [2, 1, 0, 3]][seen], image[seen])
    assert decoded.shape[1] / decoded.shape[0] == pytest.approx(4 / 3, rel=0.3)


# --- in a browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(porto: Reference, drone: RoadMask, found: Location, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "drone_report.html"
    path.write_text(render_report(rival(found), drone, porto.index, ATTRIBUTION), encoding="utf-8")
    return path


def view(page: Page, figure: str = "main > .viewer") -> tuple[float, float, float]:
    """Centre of a view and units per pixel."""
    x, y, width, height = map(
        float, page.run(f"document.querySelector('{figure} svg.view').getAttribute('viewBox')").split()
    )
    return x + width / 2, y + height / 2, width / page.box(f"{figure} .stage")[2]


def is_shown(page: Page, selector: str) -> bool:
    return page.run(f"getComputedStyle(document.querySelector('{selector}')).display") != "none"


@pytest.mark.parametrize(
    ("width", "height", "phone", "dark"),
    [(1360, 860, False, False), (1360, 860, False, True), (390, 844, True, False), (320, 568, True, True)],
)
def test_it_opens_from_disk_without_a_network(
    browser: Browser, report: Path, tmp_path: Path, width: int, height: int, phone: bool, dark: bool
) -> None:
    with browser.open(report, width, height, phone=phone, dark=dark) as page:
        page.picture(tmp_path / "page.png")
        assert page.complaints() == []
        assert page.requests() == [report.as_uri()]
        assert page.run("document.documentElement.scrollWidth <= innerWidth")  # nothing sticks out to the right
        left, _, wide, high = page.box("main > .viewer .stage")
        assert left == 0
        assert wide * high > 0.3 * width * height
        if phone:  # fingers need room, and text must not be tiny
            assert page.box(".buttons button")[2] >= 40
            assert page.run("parseFloat(getComputedStyle(document.querySelector('td')).fontSize)") >= 13
    pixels = cv2.imread(str(tmp_path / "page.png"))[..., ::-1].reshape(-1, 3).astype(int)
    background, roads, footprint, arrows = (
        [(22, 25, 29), (255, 122, 80), (90, 169, 230), (255, 106, 193)]
        if dark
        else [(243, 241, 236), (228, 87, 46), (31, 111, 180), (163, 16, 124)]
    )
    share = {
        color: (np.abs(pixels - color).max(axis=1) < 40).mean() for color in (background, roads, footprint, arrows)
    }
    assert share[background] > 0.2
    assert share[roads] > 0.003
    assert share[footprint] > 0.003
    assert share[arrows] > 0.0005


def test_mouse_keys_and_buttons_zoom_and_move(browser: Browser, report: Path) -> None:
    with browser.open(report, 1360, 860) as page:
        x, _, unit = start = view(page)
        at = page.middle("main > .viewer .stage")
        page.mouse("mouseWheel", at[0] + 100, at[1], deltaX=0, deltaY=-300)
        page.settle()
        zoomed = view(page)
        assert zoomed[2] < 0.7 * unit
        assert zoomed[0] + 100 * zoomed[2] == pytest.approx(x + 100 * unit, rel=1e-3)  # the ground under it stays
        page.drag(*at, 120, -40)
        moved = view(page)
        assert moved[0] - zoomed[0] == pytest.approx(-120 * zoomed[2], rel=0.05)
        assert moved[1] - zoomed[1] == pytest.approx(40 * zoomed[2], rel=0.05)
        page.run("document.querySelector('main > .viewer .stage').focus()")
        for key, text in (("+", "+"), ("-", "-"), ("-", "-"), ("ArrowLeft", ""), ("ArrowDown", "")):
            before = view(page)
            page.press(key, text)
            assert view(page) != pytest.approx(before, rel=1e-6)
        page.press("0", "0")
        assert view(page) == pytest.approx(start)
        page.drag(*page.middle("[data-act=in]"), 0, 0)
        assert view(page)[2] == pytest.approx(unit / 1.5)
        page.drag(*page.middle("[data-act=fit]"), 0, 0)
        assert view(page) == pytest.approx(start)
        assert page.complaints() == []


def test_fingers_zoom_and_move(browser: Browser, report: Path) -> None:
    with browser.open(report, 390, 844, phone=True) as page:
        start = view(page)
        x, y = page.middle("main > .viewer .stage")
        page.touch("touchStart", (x, y))
        page.touch("touchMove", (x + 30, y))
        page.touch("touchMove", (x + 60, y))
        page.touch("touchEnd")
        page.settle()
        assert view(page)[0] - start[0] == pytest.approx(-60 * start[2], rel=0.1)
        page.touch("touchStart", (x - 20, y), (x + 20, y))
        page.touch("touchMove", (x - 60, y), (x + 60, y))
        page.touch("touchEnd")
        page.settle()
        assert view(page)[2] == pytest.approx(start[2] / 3, rel=0.02)
        assert page.run("scrollY") == 0
        assert page.complaints() == []


def test_layers_are_switched(browser: Browser, report: Path) -> None:
    with browser.open(report, 1360, 860) as page:
        for layer, at_first in (("map-roads", True), ("residuals", True), ("unmatched", False), ("picture", False)):
            group = f"main > .viewer svg.view g.{layer}"
            assert is_shown(page, group) == at_first
            page.drag(*page.middle(f"main > .viewer [data-toggles={layer}]"), 0, 0)
            assert is_shown(page, group) != at_first


def test_arrows_and_corners_are_to_scale_close_up(browser: Browser, report: Path) -> None:
    with browser.open(report, 1360, 860) as page:
        times = "document.querySelector('.times').textContent"
        assert page.run(times).startswith("× ")
        page.run("document.querySelector('aside button[data-x]').click()")
        page.settle()
        assert page.run("document.querySelector('.scale').textContent") in {"5 m", "10 m"}
        page.run("for (let i = 0; i < 9; i++) viewers[0].zoom(1.5)")
        page.settle()
        assert page.run(times) == "true to scale"


def test_a_match_is_chosen_in_both_views(browser: Browser, report: Path, found: Location) -> None:
    with browser.open(report, 1360, 860) as page:
        rings = ["main > .viewer .ring", "aside .viewer .ring"]
        assert [is_shown(page, ring) for ring in rings] == [False, False]
        page.run("document.querySelector('details').open = true")
        page.run("document.querySelector('.matches tbody button').click()")
        page.settle()
        assert [is_shown(page, ring) for ring in rings] == [True, True]
        said = page.run("document.querySelector('.chosen-match').textContent")
        assert said.startswith(f"Match 1: {found.place.matches.residual_m.max():.2f} m apart")
        # A click beside an intersection of the mask chooses the nearest.
        worst = plane_to_pixel(found.place.matches.query_xy)[np.argsort(-found.place.matches.residual_m, kind="stable")]
        page.run("select(null)")
        assert [is_shown(page, ring) for ring in rings] == [False, False]
        x, y, unit = view(page, "aside .viewer")
        middle = np.array(page.middle("aside .viewer .stage"))
        page.drag(*(middle + (worst[1] - (x, y)) / unit), 0, 0)
        assert page.run("document.querySelector('tr.chosen').rowIndex") == 2
        page.drag(*(np.array(page.box("main > .viewer .stage")[:2]) + 5), 0, 0)  # nothing is near
        assert page.run("document.querySelector('.chosen-match').textContent") == ""


def test_both_views_show_the_ground_under_the_pointer(browser: Browser, report: Path, found: Location) -> None:
    with browser.open(report, 1360, 860) as page:
        x, y, unit = view(page, "aside .viewer")
        middle = np.array(page.middle("aside .viewer .stage"))
        pixel = np.array([300.0, 500.0])
        page.mouse("mouseMoved", *(middle + (pixel - (x, y)) / unit))
        west, north = (
            float(page.run(f"document.querySelector('[data-west]').dataset.{side}")) for side in ("west", "north")
        )
        shown = re.findall(
            r"-?[\d.]+", page.run("document.querySelector('main > .viewer .cursor').getAttribute('transform')")
        )
        expected = Homography(found.homography)(pixel)
        assert np.array(shown, float) == pytest.approx([expected[0] - west, north - expected[1]], abs=1.5 * unit)
        assert page.run("document.querySelector('aside .viewer .position').textContent").startswith("column ")
        at = page.middle("main > .viewer .stage")
        page.mouse("mouseMoved", *at)
        x, y, _ = view(page)
        said = page.run("document.querySelector('main > .viewer .position').textContent")
        assert np.array(re.findall(r"[\d.]+", said), float) == pytest.approx([west + x, north - y], abs=5)


def test_the_list_leads_to_the_reports(browser: Browser, report: Path, porto: Reference, found: Location) -> None:
    path = report.with_name("roadgeo_report.html")
    write_batch(path, [Entry(found.to_dict(), report.name)], [porto.index])
    for link in ("svg.view a path", ".list a"):
        with browser.open(path, 1360, 860) as page:
            assert page.complaints() == []
            page.drag(*page.middle("svg.view a path"), 60, 40)  # moves the map, follows no link
            assert page.run("location.href") == path.as_uri()
            page.click_through(*page.middle(link))
            assert page.run("location.href") == report.as_uri()
            assert page.complaints() == []


def test_the_longest_lines_are_kept() -> None:
    lines = [np.array([[0.0, 0.0], [length, 0.0]]) for length in (5.0, 50.0, 10.0, 40.0)]
    assert [line[1, 0] for line in thin_lines(lines, 5)] == [50.0, 40.0]
