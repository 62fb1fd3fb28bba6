"""The report of one mask: its views, the numbers, the reason in words, put into a page that needs nothing else.

`page.css` and `page.js` are the style and the behaviour of every report. Without JavaScript only zooming and choosing
are missing.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from pyproj import Geod

from roadgeo._text import counted, in_html
from roadgeo._version import __version__
from roadgeo.geometry.frame import polygon_area
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.placement import Center, Placement
from roadgeo.geometry.projection import transform
from roadgeo.location import Location, Reason
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.drawing.layers import Cross, Layer, Ring
from roadgeo.outputs.drawing.svg import draw_layer, stylesheet
from roadgeo.outputs.drawing.views import (
    SIGMAS,
    Window,
    frame_layers,
    place_layers,
    probability_layer,
    whole_map,
)
from roadgeo.outputs.names import bare_command, bare_name, without_folders
from roadgeo.outputs.report.viewer import draw_viewer
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.wording import format_lonlat, write_distance, write_sigma

__all__ = [
    "STATUS", "label_values", "name_owners", "render_page", "render_report", "section", "table", "write_report",
]  # fmt: skip

#: How each status is shown: by a sign and a word, not by colour alone.
STATUS = {
    "located": "✓ located",
    "ambiguous": "≈ ambiguous",
    "chosen": "☞ chosen",
    "not_located": "✕ not located",
    "error": "! failed",
}

_CORNERS = ("top left", "top right", "bottom right", "bottom left")
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")

#: How the user overrules a refusal.
_TAKING = "If you know one of the places to be right, the same command with --take N writes the N-th."

#: Below this number of intersections a report recommends a larger frame.
_FEW = 12

#: Widths in pixels that smaller views are scaled for until the page's script knows better.
_MASK_PX, _OVERVIEW_PX = 400, 380

#: Screen pixels that a large residual's arrow (the 90th percentile) and a corner's circle get at most.
_ARROW_PX, _CIRCLE_PX = 26.0, 60.0


def write_report(path: Path, subject: Subject) -> None:
    """Write `render_report`."""
    path.write_text(render_report(subject), encoding="utf-8", newline="\n")


def render_report(subject: Subject) -> str:
    """Render what became of a mask, located or not, as a whole HTML page.

    Raises
    ------
    MaskError
        The picture cannot be read, or the mask shows no roads.
    """
    location = subject.location
    views = [*([_draw_place(subject)] if subject.has_place else []), _draw_frame(subject)]
    parts = [
        _explain(subject),
        section(f"In the {subject.kind}", "".join(views[1:])),
        section("Where on the map", _draw_overview(subject)),
        section("Numbers", label_values(_numbers(subject))),
        section("Corners", _corners(subject)) if subject.has_place else "",
        section("Matched intersections", _matches(subject)),
        f"<details><summary>Everything else</summary>{label_values(_details(subject))}</details>",
    ]
    name = bare_name(location.query) or "mask"
    reason = _sentence(without_folders(location.reason, location.query))
    status = (location.status, STATUS[location.status])
    return render_page(name, reason, views[0], parts, subject.attribution, status)


def render_page(
    title: str, text: str, view: str, parts: Iterable[str], attribution: str = "", status: tuple[str, str] | None = None
) -> str:
    """Put a view and the HTML that stands beside it into a page of its own, which may load nothing from anywhere.

    Parameters
    ----------
    title, text : str
        Heading, and a sentence below it.
    attribution : str
        Whom the map's licence asks to name.
    status : (str, str), optional
        Name of a status, by which it is coloured, and how it is shown beside the heading.
    """
    badge = "" if status is None else f'<span class="status {status[0]}">{status[1]}</span>'
    credit = f"Map: {in_html(attribution)}. " if attribution else ""
    style, script = (Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    allowed = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{allowed}">
<meta name="generator" content="roadgeo {__version__}">
<link rel="icon" href="data:,">
<title>{in_html(title)}</title>
<style>
{stylesheet()}{style}</style>
<noscript><style>.buttons, .legend input {{ display: none }}</style></noscript>
</head>
<body>
<header><h1>{in_html(title)}</h1>{badge}<p>{in_html(text)}</p></header>
<main>{view}<aside>{"".join(parts)}
<footer>{credit}Made by roadgeo {__version__}. This file needs no network.</footer></aside></main>
<script>
{script}</script>
</body>
</html>
"""


def name_owners(indexes: Iterable[ReferenceIndex]) -> str:
    """Name whom the licences of maps ask to name, each once."""
    names = dict.fromkeys(str(index.meta.get("attribution") or "") for index in indexes)
    return "; ".join(filter(None, names))


def section(title: str, content: str) -> str:
    """Put a heading over HTML; nothing for nothing."""
    return f"<section><h2>{in_html(title)}</h2>{content}</section>" if content else ""


def label_values(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of labels and values (HTML)."""
    body = "".join(f'<tr><th scope="row">{in_html(label)}</th><td>{value}</td></tr>' for label, value in rows)
    return f'<table class="numbers">{body}</table>'


def table(heads: Iterable[str], rows: Iterable[Iterable[str]], name: str = "") -> str:
    """Return heads and cells (HTML) as a table that is scrolled."""
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    head = "".join(f'<th scope="col">{in_html(text)}</th>' for text in heads)
    whole = f'<table class="{name}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return f'<div class="scroll" tabindex="0">{whole}</div>'


# --- views ------------------------------------------------------------------------------------------------------------


def _draw_frame(subject: Subject) -> str:
    """Draw the mask, or its photograph, with the roads and intersections seen in it: an HTML figure."""
    picture, *marks = frame_layers(subject)
    layers = [picture, *probability_layer(subject), *marks]
    text = f"The {subject.kind} {bare_name(subject.location.query)}, with the roads and intersections seen in it"
    return draw_viewer(text, subject.box, layers, width_px=_MASK_PX)


def _draw_place(subject: Subject) -> str:
    """Draw the map around a footprint, and the footprint on it: an HTML figure."""
    window, location = _window(subject), subject.location
    text = f"Map, north up: the footprint of {bare_name(location.query)} over the roads of {location.reference}"
    homography = window.matrix() @ subject.place.homography
    layers, arrows = place_layers(subject, window), _arrow_scale(location)
    return draw_viewer(text, window, layers, subject.attribution, arrows=arrows, homography=homography)


def _window(subject: Subject) -> Window:
    return Window.around(subject.place.footprint, subject.views.margin, subject.runner_up())


def _arrow_scale(location: Location) -> float:
    """Screen pixels for a metre of residual, or of a corner's circle."""
    matches, sigma = location.place and location.place.matches, location.corner_sigma_m
    scales = [1000.0]
    if matches:
        scales.append(_ARROW_PX / max(float(np.percentile(matches.residual_m, 90)), 1e-3))
    if sigma is not None and np.isfinite(sigma).any():
        scales.append(_CIRCLE_PX / max(SIGMAS * float(np.nanmax(sigma)), 1e-3))
    return min(scales)


def _draw_overview(subject: Subject) -> str:
    """Draw all of the map, and where on it the mask and the runner-up lie."""
    index, location = subject.index, subject.location
    if index.name != location.reference:  # several were searched
        return f"<p>Searched: {in_html(location.reference)}.</p>"
    picture, window = whole_map(index, subject.views.overview_bytes, 2 * _OVERVIEW_PX)
    layers, size = [picture], np.array((window.width, window.height))
    low, high = np.zeros(2), size
    if subject.has_place:
        ring = window.place(subject.place.footprint)
        layers.append(Layer(location.status, "", [Ring(ring)]))
        within = np.clip(ring, -size, 2 * size)  # it may lie over the edge, or reach to the horizon
        low, high = np.minimum(low, within.min(axis=0)), np.maximum(high, within.max(axis=0))
    rings = [place.footprint_lonlat for place in location.alternatives if place.reference in ("", index.name)]
    grounds = [transform("EPSG:4326", index.plane.crs, ring) for ring in rings]
    others: list[Cross | Ring] = [Ring(window.place(ground)) for ground in grounds if np.isfinite(ground).all()]
    middle = subject.runner_up()
    if middle is not None:
        others.append(Cross(window.place(middle), "runner-up" if subject.has_place else "best"))
    if others:
        layers.append(Layer("runner-up", "", others))
    text = f"All of the map {index.name}" + (", with the footprint" if subject.has_place else "")
    box = " ".join(f"{value:.0f}" for value in (*low, *(high - low)))
    return (
        f'<svg class="overview" viewBox="{box}" role="img" aria-label="{in_html(text)}" '
        f'style="--u:{(high - low)[0] / _OVERVIEW_PX:.4g}">{"".join(map(draw_layer, layers))}</svg>'
        f'<p class="faint">{in_html(index.name)}: {len(index):,} intersections, '
        f"{window.width / 1000:.0f} × {window.height / 1000:.0f} km</p>"
    )


# --- words ------------------------------------------------------------------------------------------------------------


def _explain(subject: Subject) -> str:
    """Return the meaning of the answer, and the advice where there is no place: HTML."""
    location = subject.location
    if location.status == "located":
        rate = location.error_rate
        texts = [_rival(location), "" if rate is None else _sentence(str(rate))]
    elif location.status == "chosen":
        texts = [
            "Nothing stands out here: this is a place that you chose. How often such places are wrong is not known."
        ]
    elif location.reason_code is Reason.HALF_A_PLACE:
        texts = [
            "The place is known in one direction only. Nothing was georeferenced; shown is the likeliest.",
            f"A {subject.kind} of more ground, with roads in other directions, would tell where along them it lies.",
        ]
    elif location.status == "ambiguous":
        texts = [
            "Two places fit, and which one is right cannot be told. Nothing was georeferenced; shown is the better.",
            _rival(location),
            f"A {subject.kind} of more ground, or a hint (--near, --gsd, --north-up), may decide between them.",
            _TAKING,
        ]
    else:
        texts = _advice(subject)
    return "".join(f"<p>{text}</p>" for text in texts if text)


def _advice(subject: Subject) -> list[str]:
    """Return what to look at where nothing was found: HTML."""
    location, called = subject.location, subject.kind
    n, places = location.n_intersections, location.alternatives
    few = f": few. {_FEW} or more, of more ground, would help" if n < _FEW else ""
    return [
        "Nothing was georeferenced. What to look at:",
        _listed(places),
        f"{counted(n, 'intersection')} {'is' if n == 1 else 'are'} seen in the {called}{few}.",
        f"Do the coloured lines follow its roads? If not, a cleaner {called}, --threshold or --band may help.",
        f"Was the right map searched? It was {in_html(location.reference)}.",
        f"Whatever is known shortens the search and may save a {called}: --near, --gsd, --north-up, --max-tilt.",
    ]


def _listed(places: Sequence[Placement]) -> str:
    """List the best places of a refusal with their scores: HTML."""
    if not places:
        return ""
    several = len({place.reference for place in places}) > 1
    lines = [
        f"{n}. {_link(place.center)} <small>score {min(place.score, places[0].score):.1f}"
        + (f", on the map {in_html(place.reference)}" if several else "")
        + f", {in_html(place.crs) if place.crs.startswith('EPSG:') else 'a plane of its own'}</small>"
        for n, place in enumerate(places, 1)
    ]
    return "<br>".join(["The best places that it had, though not sure enough:", *lines, _TAKING])


def _rival(location: Location) -> str:
    """Describe the best other place, where odds were computed: HTML."""
    other, center = location.runner_up, location.center
    if location.log10_odds is None or center is None:
        return ""
    if other is None:
        return "No other place came close."
    azimuth, _, apart = Geod(ellps="WGS84").inv(center.lon, center.lat, other.center.lon, other.center.lat)
    way = f"{write_distance(apart)} to the {_WINDS[round(azimuth / 45.0) % 8]}"
    way += "" if other.reference == location.reference else f", on the map {in_html(other.reference)}"
    behind = max(location.log10_odds, 0.0)
    return f"The best other place lies {way}, {behind:.1f} behind by the score: {_link(other.center)}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


# --- numbers ----------------------------------------------------------------------------------------------------------


def _numbers(subject: Subject) -> list[tuple[str, str]]:
    """Label and value (HTML) of the main results."""
    # The place and the camera, where they are known.
    location, place = subject.location, subject.place if subject.has_place else None
    width, height = subject.mask_size
    frame = f"{width} × {height} pixels"
    rows = []
    if place is not None and location.center is not None:
        rows.append(("Middle", _link(location.center)))
        frame += f", {polygon_area(place.footprint) / 1e6:.3g} km²"
        rows.append(("Sampling", f"{place.gsd_m:.3g} m per pixel at the middle"))
    rows.append(("Frame", frame))
    if location.rotation_deg is not None:
        mirrored = ", mirrored" * location.mirrored
        rows.append(("Image's up", f"{round(location.rotation_deg) % 360}° clockwise from north{mirrored}"))
    if location.tilt_deg is not None:
        source = f" <small>({in_html(location.tilt_source)})</small>" if location.tilt_source else ""
        rows.append(("Tilt", f"{location.tilt_deg:.1f}° from the vertical{source}"))
    sigma = location.corner_sigma_m
    if sigma is not None and np.isfinite(sigma).all():
        rows.append(("Corners", f"{write_sigma(sigma.max())} <small>(standard deviation, at worst)</small>"))
    # Support.
    matched = f"{location.n_matched} of {location.n_intersections} matched"
    rows.append(("Intersections", matched if place else f"{location.n_intersections} seen"))
    if place is not None and place.matches:
        middle, worst = np.percentile(place.matches.residual_m, (50, 100))
        rows.append(("Residuals", f"median {write_distance(middle)}, largest {write_distance(worst)}"))
    if location.log10_odds is not None:
        rows.append(("Score", f"{location.log10_odds:z.1f} <small>(powers of ten ahead of any other place)</small>"))
    rows.append(("Time", f"{location.seconds.total - location.seconds.write:.2f} s"))
    return rows


def _link(place: Center) -> str:
    """Give a place in degrees, with a link to a map of it, and in the CRS."""
    url = f"https://www.openstreetmap.org/?mlat={place.lat:.6f}&mlon={place.lon:.6f}#map=16/{place.lat:.5f}/{place.lon:.5f}"
    where = f'<a href="{html.escape(url)}" rel="noreferrer">{format_lonlat(place.lon, place.lat)}</a>'
    return f"{where}<br><small>{place.x:,.1f}, {place.y:,.1f}</small>"


def _corners(subject: Subject) -> str:
    """List the corners, each with a button that shows it on the map."""
    location, place = subject.location, subject.place
    positions = _window(subject).place(place.footprint)
    lonlat = np.full((4, 2), np.nan) if location.footprint_lonlat is None else location.footprint_lonlat
    sigma = np.full(4, np.nan) if location.corner_sigma_m is None else location.corner_sigma_m
    rows = []
    for name, at, xy, degrees, s in zip(_CORNERS, positions, place.footprint, lonlat, sigma, strict=True):
        span = 12 * s if math.isfinite(s) and s > 5 else 60
        show = f'<button type="button" data-x="{at[0]:.1f}" data-y="{at[1]:.1f}" data-span="{span:.0f}">{name}</button>'
        where = format_lonlat(*degrees) if np.isfinite(degrees).all() else ""
        where += f"<br><small>{xy[0]:,.1f}, {xy[1]:,.1f}</small>"
        rows.append(f"<tr><td>{show}</td><td>{where}</td><td>{write_sigma(s) or '–'}</td></tr>")
    crs = place.crs if place.crs.upper().startswith("EPSG:") else "a plane of its own, see below"
    return f'<table>{"".join(rows)}</table><p class="faint">Metres in {in_html(crs)}</p>'


def _matches(subject: Subject) -> str:
    """List the matches; the page's script takes their positions from here."""
    matches = subject.largest_residuals()
    if matches is None or len(matches.residual_m) == 0:
        return ""
    pixels = plane_to_pixel(matches.query_xy)
    values = np.column_stack([pixels, matches.reference_xy, matches.residual_m]).tolist()
    rows = [
        (f'<button type="button">{i}</button>', f"{column:.1f}", f"{row:.1f}", *(f"{value:.2f}" for value in more))
        for i, (column, row, *more) in enumerate(values, 1)
    ]
    left_out = subject.location.n_matched - len(rows)
    note = f'<p class="faint">{left_out} more, with smaller residuals, are not shown.</p>' if left_out > 0 else ""
    return (
        '<p class="faint">Choose one here or in a picture to see it in both. Arrows go from the map to the image.</p>'
        '<p class="chosen-match" role="status"></p>'
        f"<details><summary>All {len(rows)}, the largest residual first</summary>"
        f"{table(('No.', 'column', 'row', 'x', 'y', 'residual, m'), rows, 'matches')}</details>{note}"
    )


def _details(subject: Subject) -> list[tuple[str, str]]:
    """Label and value (HTML) of everything else, for those who want to check."""
    location = subject.location
    plain = location.to_dict()
    seconds = ", ".join(f"{step} {value:.3f}" for step, value in plain["seconds"].items())
    stats = ", ".join(f"{value:,} {name.replace('_', ' ')}" for name, value in plain["stats"].items())
    rows = [("Mask", in_html(bare_name(location.query))), ("Map", in_html(location.reference))]
    rows += [("Source", in_html(text)) for text in _sources(subject.index)]
    rows += [("Seconds", seconds), ("Search", stats)]
    if location.crs is not None:
        rows.append(("CRS", f"<code>{in_html(location.crs)}</code>"))
    if location.homography is not None:
        matrix = "\n".join("  ".join(f"{value: .9e}" for value in row) for row in location.homography)
        note = "takes (column, row, 1) to the CRS; the middle of the first pixel is (0.5, 0.5)"
        rows.append(("Homography", f"<pre>{matrix}</pre><small>{note}</small>"))
    if location.command:
        rows.append(("Made by", f"<code>{in_html(bare_command(location.command))}</code>"))
    return rows


def _sources(index: ReferenceIndex) -> list[str]:
    """Name the sources of the map, and its date where that is known."""
    sources = [source for source in index.meta.get("sources", []) if isinstance(source, dict)]
    names = [(str(source.get("name", "")), str(source.get("osm_timestamp", ""))) for source in sources[:20]]
    return [f"{name}, as of {time}" if time else name for name, time in names if name]
