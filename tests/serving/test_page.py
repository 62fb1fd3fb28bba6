"""The page in Chromium: pictures are dropped and located, refusals are helped, by mouse, by keys and on a phone."""

import errno
import os
import re
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect, sync_playwright
from serving.test_server import Workers, running
from support.browser import find_chromium
from worlds.answers import moved

from roadgeo.geometry.projection import metres_apart, to_lonlat
from roadgeo.location import Reason
from roadgeo.reference.reference import Reference
from roadgeo.serving.app import Service
from roadgeo.serving.options import ServeOptions
from roadgeo.serving.server import Server
from roadgeo.serving.workers import _reply
from roadgeo.workflows import locate

FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--no-first-run", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader",
]  # fmt: skip
PATIENCE_MS = 60_000


class Direct(Workers):
    """Answers as processes do, in the thread that asks."""

    def __init__(self, references):
        super().__init__(3)
        self.references = references

    def ask(self, asked, say=None, called_off=None):
        if not asked.wanted:
            super().ask(asked, say, called_off)
        return _reply(asked, self.references, say)

    def close(self):
        """Serve again: the images stay."""


@pytest.fixture(scope="module")
def served(town, place):
    """A server of a town, its workers, a mask of it, and where that lies."""
    (network, index), (folder, truth) = town, place
    index = replace(index, meta={**index.meta, "attribution": '© <a href="https://maps.example">Mappers</a>'})
    workers = Direct([Reference(index, network)])
    lonlat = to_lonlat(index.plane.crs, np.array([truth.center]))[0]
    with serving(workers) as server:
        yield server, workers, folder / "mask.png", lonlat
    Workers.close(workers)


def serving(workers, references=None, **options):
    options = ServeOptions(port=0, workers=2, waiting=4, **options)
    return running(Server(Service(workers, references or workers.references, options)))


@pytest.fixture(scope="module")
def chromium():
    executable = find_chromium()
    with sync_playwright() as started, started.chromium.launch(executable_path=executable, args=FLAGS) as browser:
        yield browser


@contextmanager
def opened(chromium, server, *, width=1280, height=800, phone=False):
    """The page in a session of its own; nothing may have complained in the end, and nothing been asked elsewhere."""
    viewport = {"width": width, "height": height}
    context = chromium.new_context(viewport=viewport, has_touch=phone, is_mobile=phone, reduced_motion="reduce")
    page, said, asked = context.new_page(), [], []
    context.set_default_timeout(PATIENCE_MS)
    page.on("console", lambda reported: said.append(reported.text) if reported.type == "error" else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("dialog", lambda dialog: (said.append(dialog.message), dialog.dismiss()))
    page.on("request", lambda request: asked.append(request.url))
    try:
        page.goto(f"http://127.0.0.1:{server.server_port}/")
        page.wait_for_selector("#drop, #token:not([hidden])")
        yield page
        assert [text for text in said if "status of 503" not in text] == []  # to come again is no fault
        assert {url.split("/")[2] for url in asked if url.startswith("http")} == {f"127.0.0.1:{server.server_port}"}
    finally:
        context.close()


@pytest.fixture
def page(served, chromium):
    server, workers, _, _ = served
    workers.asked.clear()
    workers.goes_on.set()
    with opened(chromium, server) as page:
        yield page


@pytest.fixture
def phone(served, chromium):
    with opened(chromium, served[0], width=390, height=844, phone=True) as page:
        yield page


@pytest.fixture
def hard(monkeypatch):
    """Masks that are called hard are refused without a hint, and those that are called twins lie at two places."""

    def judge(mask, references, options, **_):
        found = locate(mask, references, options)
        if options.near is not None or options.match.within is not None:
            return found
        if "hard" in mask.name:
            return replace(found, status="not_located", reason="no place stands out", places=())
        if "twins" in mask.name:
            twin = moved(found.place, 900.0, 0.0, score=5.0)
            places = (replace(found.place, rival=twin), twin)
            return replace(found, status="ambiguous", reason="two places fit", places=places)
        return found

    monkeypatch.setattr("roadgeo.workflows.locate", judge)


def give(page, path, name=None):
    expect(page.locator("#work")).to_be_visible(timeout=PATIENCE_MS)  # as a person sees it: it knows its maps
    page.set_input_files("#files", {"name": name or path.name, "mimeType": "image/png", "buffer": path.read_bytes()})


def wait_for(page, word):
    expect(page.locator("#status")).to_have_text(word, timeout=PATIENCE_MS)


def look_at(page, lonlat, zoom=15):
    """Move the map; the page's own module tells which it is."""
    page.evaluate(
        "([center, zoom]) => import('./page/map.mjs').then((map) => { map.theMap().jumpTo({ center, zoom }); })",
        [[float(value) for value in lonlat], zoom],
    )


def on_map(page, lonlat):
    """Where a place is in the window."""
    return page.evaluate(
        """(place) => import('./page/map.mjs').then((map) => {
            const { x, y } = map.theMap().project(place);
            return [x, y];
        })""",
        [float(value) for value in lonlat],
    )


def test_what_is_dropped_is_located_and_shown(page, served):
    _, workers, mask, lonlat = served
    workers.goes_on.clear()
    dropped = page.evaluate_handle(
        """(bytes) => {
            const held = new DataTransfer();
            held.items.add(new File([new Uint8Array(bytes)], "mask.png", { type: "image/png" }));
            return held;
        }""",
        list(mask.read_bytes()),
    )
    page.dispatch_event("#map", "dragover", {"dataTransfer": dropped})
    expect(page.locator("#drag")).to_be_visible()
    page.dispatch_event("#map", "drop", {"dataTransfer": dropped})
    wait_for(page, "Working")
    expect(page.locator("#step")).to_have_text("Finding roads.")
    assert page.locator("progress").get_attribute("value") == "50"
    workers.goes_on.set()
    wait_for(page, "Located")
    output = [float(number) for number in page.locator("#facts button").inner_text().split(",")]
    assert output == pytest.approx([lonlat[1], lonlat[0]], abs=1e-4)
    expect(page.locator("#said")).to_contain_text("mask.png: Located.")
    # On the map: the picture, its outline, the roads.
    shown = """import('./page/map.mjs').then(async (module) => {
        const map = module.theMap();
        while (!map.loaded()) await new Promise((done) => setTimeout(done, 50));
        const drawn = (layer) => map.queryRenderedFeatures({ layers: [layer] }).length > 0;
        return [drawn('road-0'), drawn('outline'), map.getBounds().toArray()];
    })"""
    roads, outline, ((west, south), (east, north)) = page.evaluate(shown)
    assert roads
    assert outline
    assert west < lonlat[0] < east
    assert south < lonlat[1] < north


def test_a_place_is_looked_at_from_all_sides(page, served):
    give(page, served[2])
    wait_for(page, "Located")
    page.locator("#opacity").fill("30")
    page.uncheck("#show-roads")
    page.check("#show-matches")
    look = "import('./page/map.mjs').then(({ theMap }) => [%s])"
    shown = "theMap().getPaintProperty('photo', 'raster-opacity'), theMap().getLayoutProperty('seen', 'visibility')"
    assert page.evaluate(look % shown) == [0.3, "none"]
    # A matched crossing tells its residual.
    where = page.locator("#photo").get_attribute("src").replace("picture.jpg", "view.json")
    first = page.evaluate("(where) => fetch(where).then((answer) => answer.json())", where)
    page.mouse.click(*on_map(page, first["place"]["matches"][0]["map"]))
    expect(page.locator(".maplibregl-popup")).to_contain_text(f"{first['place']['matches'][0]['residual_m']:.1f} m")


def test_every_output_may_be_had(page, served):
    give(page, served[2], "My mask (1).png")
    wait_for(page, "Located")
    page.click("#files-of summary")
    links = page.locator("#files-of a")
    expect(links.nth(0)).to_be_visible()
    # Not each by a click: in a busy browser the eleventh is now and then not even asked for.
    names = {
        link.inner_text().split("\n")[0]: page.request.get(link.evaluate("link => link.href")) for link in links.all()
    }
    assert all(answer.ok for answer in names.values())
    assert {"geopackage", "json", "report", "geojson", "kmz", "gcps"} <= set(names)
    document = names["json"].json()
    assert (document["status"], document["query"]) == ("located", "My mask (1).png")
    with page.expect_download() as download:
        links.nth(list(names).index("footprint")).click()
    assert download.value.suggested_filename == "My_mask_1_footprint.tif"
    assert Path(download.value.path()).read_bytes() == names["footprint"].body()


def test_a_refusal_is_helped_by_a_circle(page, served, hard):
    _, workers, mask, lonlat = served
    give(page, mask, "hard.png")
    wait_for(page, "Not located")
    expect(page.locator("#hints")).to_be_visible()
    look_at(page, lonlat)
    page.click("#draw-circle")
    x, y = on_map(page, lonlat)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y, steps=3)
    page.mouse.up()
    wait_for(page, "Located")
    assert workers.asked[-1].hints["near"][:2] == pytest.approx(tuple(lonlat), abs=1e-4)
    assert 50 < workers.asked[-1].hints["near"][2] < 1000


def test_one_of_two_places_is_chosen(page, served, hard):
    _, workers, mask, _ = served
    give(page, mask, "twins.png")
    wait_for(page, "Two places")
    expect(page.locator("#map .pin.place")).to_have_count(2)
    page.click("#places li:first-child .take")
    wait_for(page, "Chosen by you")
    assert workers.asked[-1].hints["take"] == 1


def test_a_place_of_a_refusal_is_taken(page, served, monkeypatch):
    """Of a refusal that lists two places, the second is taken."""
    _, workers, mask, _ = served

    def refuse(mask, references, options, **_):
        found = locate(mask, references, options)
        places = (found.place, moved(found.place, 900.0, 0.0, score=-1.0))
        reason = "no place; the heading to 5 degrees (--heading DEG+-5) would help"
        return replace(found, status="not_located", reason=reason, reason_code=Reason.FEW_ROADS, places=places)

    monkeypatch.setattr("roadgeo.workflows.locate", refuse)
    give(page, mask, "far.png")
    wait_for(page, "Not located")
    expect(page.locator("#map .pin.place")).to_have_count(2)
    expect(page.locator("#reason")).to_contain_text("5 degrees (“How it was held” below) would help")
    rows = page.locator("#places li button:not(.take)")
    expect(rows.nth(1)).to_contain_text(f"{workers.references[0].name}, ")
    expect(rows.nth(1)).to_contain_text("score -1.0")
    look = "import('./page/map.mjs').then(({ theMap }) => theMap().getCenter().toArray())"
    rows.nth(0).click()
    page.wait_for_timeout(300)
    first = page.evaluate(look)
    rows.nth(1).click()
    page.wait_for_timeout(300)
    second = page.evaluate(look)
    assert metres_apart(np.array(first), np.array(second)) == pytest.approx(900.0, rel=0.2)
    expect(page.locator("#status")).to_have_text("Not located")  # to look is not to take
    page.click("#places li:nth-child(2) .take")
    wait_for(page, "Chosen by you")
    assert workers.asked[-1].hints["take"] == 2
    expect(page.locator("#reason")).to_contain_text("place 2 of 2")


def test_points_tell_where_it_is_how_large_a_pixel_and_where_up_is(page, served, hard):
    _, workers, mask, lonlat = served
    give(page, mask, "hard.png")
    wait_for(page, "Not located")
    look_at(page, lonlat)
    page.click("#pick")
    pixels = np.array([(250.0, 300.0), (700.0, 500.0), (400.0, 700.0)])
    place = locate(str(mask), workers.references)
    places = to_lonlat(place.crs, place.pixel_to_map(pixels))
    searches = len(workers.asked)
    for k in range(2):
        click_on_picture(page, pixels[k])
        expect(page.locator("#asks")).to_contain_text("on the map")
        page.mouse.click(*on_map(page, places[k]))
    expect(page.locator("#asks")).to_contain_text("A third crossing")
    page.click("#again")
    wait_for(page, "Located")
    hints = workers.asked[-1].hints
    assert hints["near"][:2] == pytest.approx(tuple(lonlat), abs=2e-4)
    assert hints["gsd_m"][0] < 1.0 < hints["gsd_m"][1]
    assert turn(hints["heading_deg"][0], place.rotation_deg) < 1.0
    assert hints["heading_deg"][1] == 15.0
    expect(page.locator("#map .pin.mapped")).to_have_count(2)
    # Three place it as they are.
    page.click("#help summary")
    expect(page.locator("#put")).to_be_hidden()
    page.click("#pick")
    look_at(page, lonlat)
    click_on_picture(page, pixels[2])
    page.mouse.click(*on_map(page, places[2]))
    expect(page.locator("#map .pin.mapped")).to_have_count(3)
    page.click("#put")
    wait_for(page, "Chosen by you")
    assert len(workers.asked) == searches + 2
    assert len(workers.asked[-1].hints["points"]) == 3
    expect(page.locator("#reason")).to_contain_text("Placed by 3 points, as given")
    expect(page.locator("#facts")).not_to_contain_text("crossings matched")


def turn(a, b):
    """The angle between two headings, degrees."""
    return abs((a - b + 180) % 360 - 180)


def click_on_picture(page, pixel):
    page.locator("#photo").scroll_into_view_if_needed()
    box = page.locator("#photo").bounding_box()
    page.mouse.click(*((box["x"], box["y"]) + pixel / 900 * (box["width"], box["height"])))


def test_what_is_known_of_the_camera_is_asked_with(page, served, hard):
    _, workers, mask, lonlat = served
    give(page, mask, "hard.png")
    wait_for(page, "Not located")
    page.fill("#height", "900")
    page.click("#again")
    expect(page.locator("#hint-trouble")).to_have_text("Give both the height and the lens.")
    for field, value in {
        "lens": "36",
        "tilt": "20",
        "heading": str(round(locate(str(mask), workers.references).rotation_deg)),
        "near-lat": lonlat[1],
        "near-lon": lonlat[0],
        "near-km": 3,
    }.items():
        page.fill(f"#{field}", str(value))
    page.click("#again")
    wait_for(page, "Located")
    hints = workers.asked[-1].hints
    assert (hints["focal_px"], hints["max_tilt_deg"], hints["near"][2]) == (900.0, 20.0, 3000.0)
    assert hints["heading_deg"] == (round(locate(str(mask), workers.references).rotation_deg), 10.0)
    expect(page.locator("#heading-off")).to_have_value("10")
    assert hints["gsd_m"] == pytest.approx((0.8, 1.25))
    page.click("#help summary")
    page.check("#heading-stated")
    page.click("#again")
    wait_for(page, "Failed")
    expect(page.locator("#reason")).to_contain_text("EXIF and XMP state no direction of its camera")
    assert workers.asked[-1].hints["heading_deg"] == "exif"


def test_it_is_all_done_by_keys(page, served, hard):
    _, _, mask, lonlat = served
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "files"
    give(page, mask, "hard.png")
    wait_for(page, "Not located")
    page.focus("#near-lat")
    for value in (lonlat[1], lonlat[0], 2):
        page.keyboard.type(str(value))
        page.keyboard.press("Tab")
    page.keyboard.press("Shift+Tab")
    page.keyboard.press("Enter")
    wait_for(page, "Located")


def test_points_are_chosen_by_keys(page, served, hard):
    _, workers, mask, lonlat = served
    give(page, mask, "hard.png")
    wait_for(page, "Not located")
    page.focus("#pick")
    page.keyboard.press("Enter")
    place = locate(str(mask), workers.references)
    for key, pixel in {"ArrowLeft": (405.0, 450.0), "ArrowUp": (405.0, 405.0)}.items():
        page.focus("#photo")
        page.keyboard.press(f"Shift+{key}")
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.className").startswith("maplibregl-canvas")
        look_at(page, to_lonlat(place.crs, place.pixel_to_map(np.array([pixel])))[0], 17)
        page.focus("#take-middle")
        page.keyboard.press("Enter")
    page.focus("#again")
    page.keyboard.press("Enter")
    wait_for(page, "Located")
    assert workers.asked[-1].hints["near"][:2] == pytest.approx(tuple(lonlat), abs=2e-4)


def test_a_file_that_is_too_large_is_not_sent(served, chromium, tmp_path):
    (tmp_path / "large.png").write_bytes(served[2].read_bytes() + bytes(3_000_000))
    with serving(served[1], max_bytes=2_000_000) as server, opened(chromium, server) as page:
        page.set_input_files("#files", str(tmp_path / "large.png"))
        wait_for(page, "Failed")
        expect(page.locator("#reason")).to_have_text("The file has 3 MB, this server takes 2 MB: reduce it.")


def test_several_are_taken_and_kept_for_the_session(page, served, hard):
    mask = served[2]
    names = [f"mask {k}.png" for k in range(4)]  # more than there are places
    page.set_input_files(
        "#files", [{"name": name, "mimeType": "image/png", "buffer": mask.read_bytes()} for name in names]
    )
    expect(page.locator("#session small.located")).to_have_count(4, timeout=PATIENCE_MS)
    page.reload()
    expect(page.locator("#session small.located")).to_have_count(4, timeout=PATIENCE_MS)
    page.click("#session li:last-child button")
    expect(page.locator("#answer-name")).to_have_text("mask 3.png")


def test_a_search_is_called_off(page, served):
    _, workers, mask, _ = served
    workers.goes_on.clear()
    give(page, mask)
    expect(page.locator("#step")).to_have_text("Finding roads.")
    page.click("#cancel")
    wait_for(page, "Cancelled")
    workers.goes_on.set()


def test_names_are_text_and_faults_are_said(page, served, tmp_path):
    picture = tmp_path / "black.png"
    cv2.imwrite(str(picture), np.zeros((50, 50), np.uint8))
    name = "<img src=x onerror=alert(1)>.png"
    give(page, picture, name)
    wait_for(page, "Failed")
    assert page.locator("#answer-name").inner_text() == name
    assert page.locator("#reason").inner_text()
    assert page.locator("#answer img[src=x]").count() == 0


NAMELESS = """() => [...document.querySelectorAll('button, a, input, img, [role=slider], progress')]
    .filter((one) => one.checkVisibility() && !one.closest('[aria-hidden=true], .maplibregl-ctrl-attrib'))
    .filter((one) => !one.getAttribute('aria-label') && !one.title && !one.innerText && !one.labels?.length)
    .filter((one) => one.alt == null)
    .map((one) => one.outerHTML)"""

FAINT = """() => {
    const parse = (text) => text.match(/[\\d.]+/g).map(Number);
    const light = ([r, g, b]) => [r, g, b].map((v) => v / 255)
        .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
        .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
    const ground = (one) => {
        for (let at = one; at; at = at.parentElement) {
            const color = parse(getComputedStyle(at).backgroundColor);
            if (color.length < 4 || color[3] > 0.8) return color;
        }
        return [255, 255, 255];
    };
    return [...document.querySelectorAll('#panel *')]
        .filter((one) => one.checkVisibility())
        .filter((one) => [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim()))
        .map((one) => {
            const [a, b] = [light(parse(getComputedStyle(one).color)), light(ground(one))];
            return [one.outerHTML.slice(0, 80), (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05)];
        }).filter(([, ratio]) => ratio < 4.5);
}"""


def require_usable(page):
    assert page.evaluate(NAMELESS) == []
    assert page.evaluate(FAINT) == []


def test_everything_has_a_name_and_can_be_read(page, served, hard):
    mask = served[2]
    require_usable(page)
    give(page, mask)
    wait_for(page, "Located")
    page.click("#help summary")
    page.click("#files-of summary")
    require_usable(page)
    give(page, mask, "twins.png")
    wait_for(page, "Two places")
    require_usable(page)
    # What a screen reader is told.
    expect(page.locator("#panel")).to_match_aria_snapshot("""
      - heading "roadgeo" [level=1]
      - article "twins.png":
        - heading "twins.png" [level=2]
        - region "Places that fit"
        - group "On the map":
          - slider "Opacity of the photograph"
          - checkbox "Roads seen" [checked]
    """)


def test_it_serves_on_a_phone(phone, served, hard):
    _, workers, mask, lonlat = served
    workers.goes_on.set()
    give(phone, mask, "hard.png")
    wait_for(phone, "Not located")
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    small = """() => [...document.querySelectorAll('#panel button, #panel input:not([type=file]), summary')]
        .filter((one) => one.checkVisibility()).map((one) => [one.id, one.getBoundingClientRect().height])
        .filter(([id, height]) => height < 16)"""
    assert phone.evaluate(small) == []
    require_usable(phone)
    look_at(phone, lonlat, 14)
    phone.locator("#draw-circle").tap()
    phone.wait_for_timeout(200)
    phone.touchscreen.tap(*on_map(phone, lonlat))  # a touch without a movement takes a fifth of what is seen
    wait_for(phone, "Located")
    assert phone.locator("#map").bounding_box()["height"] > 400


def require_tidy(page, width):
    """Nothing is wider than the window, and no HTML is shown as text."""
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for part in ("#panel", "#work", "#answer"):
        assert page.eval_on_selector(part, "(one) => one.scrollWidth - one.clientWidth") <= 1, part
    assert not re.search(r"</?[a-z]+[^<]*>", page.inner_text("body"))


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
def test_every_state_fits_its_window(served, chromium, hard, width, height):
    _, workers, mask, _ = served
    workers.goes_on.set()
    far = replace(workers.references[0].index, meta={**workers.references[0].index.meta, "name": "a long name " * 6})
    black = cv2.imencode(".png", np.zeros((50, 50), np.uint8))[1].tobytes()
    with (
        serving(workers, [*workers.references, Reference(far)]) as server,
        opened(chromium, server, width=width, height=height, phone=width < 700) as page,
    ):
        require_tidy(page, width)
        workers.goes_on.clear()
        give(page, mask, "a name without a single gap in it, that goes on and on ".replace(" ", "_") * 2 + ".png")
        wait_for(page, "Working")
        require_tidy(page, width)
        workers.goes_on.set()
        wait_for(page, "Located")
        for summary in ("#help summary", "#files-of summary"):
            page.click(summary)
        expect(page.locator("#files-of a").first).to_be_visible()
        require_tidy(page, width)
        page.click("#larger")
        require_tidy(page, width)
        page.click("#larger")
        for name, word in {"hard.png": "Not located", "twins.png": "Two places"}.items():
            give(page, mask, name)
            wait_for(page, word)
            require_tidy(page, width)
        page.set_input_files("#files", {"name": "black.png", "mimeType": "image/png", "buffer": black})
        wait_for(page, "Failed")
        require_tidy(page, width)


def test_of_several_maps_the_first_is_shown_and_each_may_be_chosen(served, chromium):
    workers = served[1]
    index = workers.references[0].index
    x, y = index.meta["origin"]
    far = replace(index, meta={**index.meta, "name": "Far town", "origin": (x, y + 900_000.0)})
    zoom = "import('./page/map.mjs').then(({ theMap }) => [theMap().getZoom(), theMap().getCenter().lat])"
    with serving(workers, [Reference(index), Reference(far)]) as server, opened(chromium, server) as page:
        expect(page.locator("#maps option")).to_have_text([index.name, "Far town"])
        first = page.evaluate(zoom)
        page.select_option("#maps", "Far town")
        page.wait_for_timeout(200)
        second = page.evaluate(zoom)
    assert first[0] > 11
    assert second[0] == pytest.approx(first[0], abs=0.3)
    assert second[1] > first[1] + 5


def test_an_answer_without_its_view_tells_the_place(served, chromium, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    server, workers, mask, _ = served
    workers.goes_on.set()
    monkeypatch.setattr("roadgeo.serving.view.write_view", full)
    page = chromium.new_page()
    page.goto(f"http://127.0.0.1:{server.server_port}/")
    give(page, mask)
    wait_for(page, "Located")
    expect(page.locator("#facts")).to_contain_text("Middle")
    page.close()


def test_it_may_lie_below_a_path(served, chromium):
    server, workers, mask, _ = served
    workers.goes_on.set()
    refused, root = [], f"http://127.0.0.1:{server.server_port}"

    def lead(route):
        """As a proxy does that knows what lies below /maps/ only."""
        path = route.request.url.removeprefix(root)
        route.continue_(url=root + (path.removeprefix("/maps") if path.startswith("/maps/") else "/outside"))

    page = chromium.new_page()
    page.on("response", lambda answer: refused.append(answer.url) if answer.status >= 400 else None)
    page.route(f"{root}/**", lead)
    page.goto(f"{root}/maps/")
    give(page, mask)
    wait_for(page, "Located")
    page.click("#files-of summary")
    named = "(link) => fetch(link.href).then((answer) => answer.headers.get('Content-Disposition'))"
    assert "mask_footprint.tif" in page.locator("#files-of a").first.evaluate(named)
    page.close()
    assert refused == []


def test_a_token_is_asked_for_once(served, chromium):
    workers = served[1]
    with serving(workers, token="open sesame") as server:
        context = chromium.new_context()
        try:
            page = context.new_page()
            page.goto(f"http://127.0.0.1:{server.server_port}/")
            page.fill("#token-text", "guess")
            page.press("#token-text", "Enter")
            expect(page.locator("#token .bad")).to_have_text("This is not the token.")
            page.fill("#token-text", "open sesame")
            page.press("#token-text", "Enter")
            page.wait_for_selector("#drop")
            give(page, served[2])
            wait_for(page, "Located")
            (cookie,) = context.cookies()
            assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
            assert "sesame" not in cookie["value"]
        finally:
            context.close()


def test_a_browser_that_draws_no_map_tells_places(served, chromium):
    flags = [*(flag for flag in FLAGS if "swiftshader" not in flag), "--disable-3d-apis"]
    with chromium.browser_type.launch(executable_path=find_chromium(), args=flags) as browser:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{served[0].server_port}/")
        expect(page.locator("#trouble")).to_contain_text("cannot draw the map")
        give(page, served[2])
        wait_for(page, "Located")
        expect(page.locator("#facts")).to_contain_text("Middle")


def test_a_basemap_is_asked_where_the_user_said(served, chromium):
    workers, asked = served[1], []
    with serving(workers, basemap="http://127.0.0.1:9/{z}/{x}/{y}.png", basemap_attribution="<b>Me</b> & co") as server:
        context = chromium.new_context()
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.goto(f"http://127.0.0.1:{server.server_port}/")
        expect(page.locator(".maplibregl-ctrl-attrib")).to_contain_text("Me & co")
        page.wait_for_timeout(500)
        context.close()
    elsewhere = [url for url in asked if f":{server.server_port}/" not in url and url.startswith("http")]
    assert elsewhere
    assert all(url.startswith("http://127.0.0.1:9/") for url in elsewhere)
