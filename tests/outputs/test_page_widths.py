"""Every page that a program writes, in all its states, on a phone and on a screen: nothing is wider than the window."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from evaluation.test_report import answer, truth
from outputs.test_report_pages import render_report, rival
from pyproj import CRS
from support.browser import Browser, browser
from worlds.answers import with_place
from worlds.demo import MASKS

from roadgeo.evaluation.report import render_report as render_evaluation
from roadgeo.evaluation.scoring import evaluate
from roadgeo.flights.report import Thumbnails, render_flight
from roadgeo.flights.rows import Row
from roadgeo.geometry.georeference import Georeference
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Location, Reason
from roadgeo.outputs.report import Entry, render_batch
from roadgeo.outputs.report.verification import write_verification
from roadgeo.reference.opening import open_reference
from roadgeo.sources.masks import read_mask
from roadgeo.workflows import locate

__all__ = ["browser"]

#: A name, and with it reasons, that no line can be broken in.
LONG = "a_photograph_of_a_flight_" * 6 + ".png"

#: Elements that reach beyond what shows them, those aside that are meant to be scrolled or belong to a drawing.
TOO_WIDE = """(() => {
  document.querySelectorAll("details").forEach((each) => { each.open = true; });
  return [...document.querySelectorAll("body, body *")]
    .filter((each) => !each.closest("svg, .scroll, pre, .stage"))
    .filter((each) => each.scrollWidth > each.clientWidth + 1 && each.clientWidth > 0
                      || each.getBoundingClientRect().right > innerWidth + 1)
    .map((each) => `${each.tagName}.${each.className}: ${each.textContent.slice(0, 60)}`);
})()"""


@pytest.fixture(scope="module")
def pages(porto: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """All pages by their states."""
    folder, reference = tmp_path_factory.mktemp("pages"), open_reference(porto)
    index = reference.index
    drone, elsewhere = read_mask(MASKS["drone"].path), read_mask(MASKS["elsewhere"].path)
    found = replace(locate(drone, reference), command=f"roadgeo locate {LONG}", reason=f"{LONG} agrees")
    refused = replace(locate(elsewhere, reference), query=LONG)
    photo = folder / "photo.jpg"
    cv2.imwrite(str(photo), np.full((480, 640, 3), 90, np.uint8))
    drawn: dict[str, str] = {}

    def report(state: str, location: Location, **given: object) -> None:
        mask = elsewhere if location.query == LONG else drone
        drawn[state] = render_report(location, mask, index, "© OpenStreetMap contributors", **given)

    report("located", found)
    report("photograph", found, picture=photo)
    report("runner-up", rival(found))
    report("two places", replace(rival(found), status="ambiguous", reason_code=Reason.TWO_PLACES))
    report("half a place", replace(found, status="ambiguous", reason_code=Reason.HALF_A_PLACE))
    report(
        "own plane",
        with_place(
            found, plane=LocalPlane(CRS("+proj=sterea +lat_0=41 +lon_0=-8.6").to_wkt(), found.place.plane.origin)
        ),
    )
    report("refused", replace(refused, places=refused.places[:1]))
    report("refused without a best", replace(refused, places=(), content=replace(refused.content, xy=np.zeros((3, 2)))))
    report("several maps", replace(refused, reference=f"porto, {LONG}"))
    error = {"query": LONG, "status": "error", "reason": f"{LONG}: no such file"}
    entries = [Entry(item, "a.html") for item in (found.to_dict(), refused.to_dict(), error)]
    drawn["many"] = render_batch(entries, [index])
    drawn["none of many"] = render_batch(entries[2:], [index])
    truths = [replace(truth(k), file=f"{k}{LONG}") for k in range(9)]
    answers = [answer(0), None, {**answer(2), "status": "ambiguous", "reason": LONG}, *map(answer, range(3, 9))]
    drawn["evaluation"] = render_evaluation(evaluate(truths, answers, {"queries": LONG}), truths, LONG)
    drawn["evaluation of nothing"] = render_evaluation(evaluate([], []), [], "nothing")
    drawn["flight"] = flight(index, found)
    drawn["lost flight"] = render_flight(LONG, [], [])
    for state, text in drawn.items():
        (folder / f"{state}.html").write_text(text, encoding="utf-8")
    for verdict, document in verified().items():
        place = Georeference(found.homography, found.crs, found.size, "geotransform") if verdict != "error" else None
        picture = {**document, "image": str(MASKS["drone"].path) if place else LONG}
        corrected = place if verdict == "off" else None
        write_verification(folder / f"verify {verdict}.html", picture, LONG, place, corrected, index)
    return {path.stem: path for path in folder.glob("*.html")}


def flight(index: object, found: Location) -> str:
    """A flight of three frames, the first of them lost."""
    reference = SimpleNamespace(name="porto", index=index)
    pose = SimpleNamespace(corners=index.plane.from_crs(found.footprint))
    states = ("lost", "located", "tracked")
    lost, *there = (Row(k, LONG, float(k), None, status, LONG, k) for k, status in enumerate(states))
    rows = [lost, *(replace(row, reference="porto", center=(-8.6, 41.1), sigma_m=1.234) for row in there)]
    tracked = [SimpleNamespace(status=row.status, pose=pose, reference=reference) for row in rows]
    tracked[0].pose = tracked[0].reference = None
    pictures = Thumbnails()
    for row in rows:
        pictures.add(row.number, read_mask(MASKS["drone"].path))
    return render_flight(LONG, tracked, rows, pictures.kept)


def verified() -> dict[str, dict]:
    """Documents of `roadgeo verify`, by verdict."""
    shift = {"east_m": 60.0, "north_m": -35.0, "turn_deg": 0.1, "scale": 1.0001, "off_m": 69.5, "sigma_m": 0.2}
    known = {"displacement": shift, "agreeing": 0.9, "agreeing_as_given": 0.1, "log10_lead": 30.0, "reference": LONG}
    return {
        name: {"verdict": name, **(known if name != "error" else {})} for name in ("agrees", "off", "unknown", "error")
    }


STATES = """
    located, photograph, runner-up, two places, half a place, own plane, refused, refused without a best, several maps,
    many, none of many, evaluation, evaluation of nothing, flight, lost flight,
    verify agrees, verify off, verify unknown, verify error
"""
STATES = [state.strip() for state in STATES.split(",")]


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("state", STATES)
def test_nothing_is_wider_than_the_window(browser: Browser, pages: dict[str, Path], state: str, width: int) -> None:
    with browser.open(pages[state], width, 800, phone=width < 400) as page:
        assert page.run(TOO_WIDE) == []
        assert page.run("innerWidth") == width
        text = page.run("document.body.innerText")
        for wrong in ("<a ", "</", "&lt;", "undefined", "None", "nan "):
            assert wrong not in text
        assert page.complaints() == []


def test_all_pages_are_looked_at(pages: dict[str, Path]) -> None:
    assert set(pages) == set(STATES)
