"""The report of one mask: its views, the numbers, the reason in words, put into a page that needs nothing else.

`page.css` and `page.js` are the style and the behaviour of every report. Without JavaScript only zooming and choosing
are missing.
"""

from __future__ import annotations

import html
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from roadgeo import __version__
from roadgeo._text import counted
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.geometry.pinhole import polygon_area
from roadgeo.location import Location, Place, Reason
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.names import bare_command, bare_name, without_folders
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.report.place_view import draw_place
from roadgeo.outputs.report.views import (
    ReportOptions,
    Shown,
    Window,
    draw_mask,
    draw_overview,
    draw_probability,
)
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.wording import format_lonlat

__all__ = ["STATUS", "footer", "render_page", "render_report", "section", "write_report"]

#: How each status is shown: by a sign and a word, not by colour alone.
STATUS = {"located": "✓ located", "ambiguous": "≈ ambiguous", "not_located": "✕ not located", "error": "! failed"}

_CORNERS = ("top left", "top right", "bottom right", "bottom left")
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")

#: Below this number of intersections a report recommends a larger frame.
_FEW = 12


def write_report(path: Path, subject: Subject) -> None:
    """Write `render_report`."""
    page = render_report(subject.location, subject.mask, subject.index, subject.attribution, subject.photo)
    path.write_text(page, encoding="utf-8", newline="\n")


def render_report(
    location: Location,
    mask: RoadMask,
    index: ReferenceIndex,
    attribution: str = "",
    picture: str | os.PathLike[str] | None = None,
    options: ReportOptions | None = None,
) -> str:
    """Render what became of a mask, located or not, as a whole HTML page.

    Parameters
    ----------
    index : ReferenceIndex
        The map that it lies on, or one that was searched.
    attribution : str
        Whom the map's licence asks to name.
    picture : path, optional
        The photograph that the mask was made of: the same frame at any scale.

    Raises
    ------
    MaskError
        The picture cannot be read, or the mask shows no roads.
    """
    subject = Shown.of(location, mask, index, picture, options or ReportOptions(), attribution)
    place = subject.place
    views = [draw_mask(subject)] if place is None else [draw_place(subject, place), draw_mask(subject)]
    parts = [
        _explain(location),
        section("In the mask" if mask.probability is None else "In the photograph", "".join(views[1:])),
        section("Roads seen in it", draw_probability(subject)),
        section("Where on the map", draw_overview(subject)),
        section("Numbers", _table(_numbers(subject))),
        "" if place is None else section("Corners", _corners(subject, place)),
        section("Matched intersections", _matches(subject)),
        f"<details><summary>Everything else</summary>{_table(_details(subject))}</details>",
    ]
    name = bare_name(location.query) or "mask"
    header = (
        f'<h1>{html.escape(name)}</h1><span class="status {location.status}">{STATUS[location.status]}</span>'
        f"<p>{html.escape(_sentence(without_folders(location.reason, location.query)))}</p>"
    )
    return render_page(name, header, f"<main>{views[0]}<aside>{''.join(parts)}{footer(attribution)}</aside></main>")


def render_page(title: str, header: str, body: str) -> str:
    """Put HTML into a page with the style and the behaviour of all reports; it may load nothing from anywhere."""
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
<title>{html.escape(title)}</title>
<style>
{style}</style>
<noscript><style>.buttons, .legend input {{ display: none }}</style></noscript>
</head>
<body>
<header>{header}</header>
{body}
<script>
{script}</script>
</body>
</html>
"""


def section(title: str, content: str) -> str:
    """Put a heading over HTML; nothing for nothing."""
    return f"<section><h2>{html.escape(title)}</h2>{content}</section>" if content else ""


def footer(attribution: str) -> str:
    """Name whom the map's licence asks to name, and the program."""
    credit = f"Map: {html.escape(attribution)}. " if attribution else ""
    return f"<footer>{credit}Made by roadgeo {__version__}. This file needs no network.</footer>"


# --- words ------------------------------------------------------------------------------------------------------------


def _explain(location: Location) -> str:
    """Return the meaning of the answer, and the advice where there is no place."""
    if location.status == "located":
        texts = [_rival(location)]
    elif location.reason_code is Reason.HALF_A_PLACE:
        texts = [
            "The place is known in one direction only. Nothing was georeferenced; shown is the likeliest.",
            "A mask of more ground, with roads in other directions, would tell where along them it lies.",
        ]
    elif location.status == "ambiguous":
        texts = [
            "Two places fit, and which one is right cannot be told. Nothing was georeferenced; shown is the better.",
            _rival(location),
            "A mask of more ground, or whatever is known of it (--near, --gsd, --north-up), may decide between them.",
        ]
    else:
        few = (
            f": few. {_FEW} or more, from a mask of more ground, would help" if location.n_intersections < _FEW else ""
        )
        n, best = location.n_intersections, next(iter(location.alternatives), None)
        texts = [
            "Nothing was georeferenced. What to look at:",
            *([f"The best place that it had, though not sure enough: {_link(best)}."] if best else []),
            f"{counted(n, 'intersection')} {'is' if n == 1 else 'are'} seen in the mask{few}.",
            "Do the coloured lines follow the mask's roads? If not, a cleaner mask, --threshold or --band may help.",
            f"Was the right map searched? It was {location.reference}.",
            "Whatever is known shortens the search and may save a mask: --near, --gsd, --north-up, --max-tilt.",
        ]
    return "".join(f"<p>{html.escape(text)}</p>" for text in texts if text)


def _rival(location: Location) -> str:
    """Describe the best other place, where odds were computed."""
    other, center = location.runner_up, location.center
    if location.log10_odds is None or center is None:
        return ""
    if other is None:
        return "No other place came close."
    lead = f"10^{location.log10_odds - other.log10_odds:.1f} times less likely"
    return f"The best other place lies {_way(center, other)}, {lead}: {format_lonlat(other.lon, other.lat)}."


def _way(here: Place, there: Place) -> str:
    """Return distance and direction: 1.3 km to the north-east."""
    dx, dy = there.x - here.x, there.y - here.y
    wind = _WINDS[round(math.degrees(math.atan2(dx, dy)) / 45.0) % 8]
    distance = math.hypot(dx, dy)
    return f"{distance:.0f} m to the {wind}" if distance < 1000 else f"{distance / 1000:.1f} km to the {wind}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


# --- numbers ----------------------------------------------------------------------------------------------------------


def _table(rows: Sequence[tuple[str, str]]) -> str:
    body = "".join(f'<tr><th scope="row">{html.escape(label)}</th><td>{value}</td></tr>' for label, value in rows)
    return f'<table class="numbers">{body}</table>'


def _numbers(subject: Shown) -> list[tuple[str, str]]:
    """Label and value (HTML) of the main results."""
    # The place and the camera, where they are known.
    location, place = subject.location, subject.place
    width, height = subject.size
    frame = f"{width} × {height} pixels"
    rows = []
    if place is not None and location.center is not None:
        rows.append(("Middle", _link(location.center)))
        frame += f", {polygon_area(place.footprint) / 1e6:.3g} km²"
        rows.append(("Sampling", f"{place.gsd_m:.3g} m per pixel at the middle"))
    rows.append(("Frame", frame))
    if location.rotation_deg is not None:
        rows.append(("Image's up", f"{location.rotation_deg % 360:.1f}° clockwise from north"))
    if location.tilt_deg is not None:
        source = f" <small>({html.escape(location.tilt_source)})</small>" if location.tilt_source else ""
        rows.append(("Tilt", f"{location.tilt_deg:.1f}° from the vertical{source}"))
    sigma = location.corner_sigma_m
    if sigma is not None and np.isfinite(sigma).all():
        low, high = sigma.min(), sigma.max()
        rows.append(("Corners", f"± {low:.1f} to {high:.1f} m <small>(standard deviation)</small>"))
    # Support.
    matched = f"{location.n_matched} of {location.n_intersections} matched"
    rows.append(("Intersections", matched if place else f"{location.n_intersections} seen"))
    if location.evidence is not None and len(location.evidence.residual_m):
        middle, worst = np.percentile(location.evidence.residual_m, (50, 100))
        rows.append(("Residuals", f"median {middle:.1f} m, largest {worst:.1f} m"))
    if location.log10_odds is not None:
        rows.append(("Odds", f"10<sup>{location.log10_odds:.1f}</sup> : 1 against any other place"))
    if location.runner_up is not None:
        rows.append(
            ("Runner-up", f"10<sup>{location.runner_up.log10_odds:.1f}</sup> : 1<br>{_link(location.runner_up)}")
        )
    rows.append(("Time", f"{location.seconds.total - location.seconds.write:.2f} s"))
    return rows


def _link(place: Place) -> str:
    """Give a place in degrees, with a link to a map of it, and in the CRS."""
    url = f"https://www.openstreetmap.org/?mlat={place.lat:.6f}&mlon={place.lon:.6f}#map=16/{place.lat:.5f}/{place.lon:.5f}"
    where = f'<a href="{html.escape(url)}" rel="noreferrer">{format_lonlat(place.lon, place.lat)}</a>'
    return f"{where}<br><small>{place.x:,.1f}, {place.y:,.1f}</small>"


def _corners(subject: Shown, place: Placement) -> str:
    """List the corners, each with a button that shows it on the map."""
    location = subject.location
    positions = Window.around(subject, place, subject.options.margin).to_svg(place.footprint)
    lonlat = np.full((4, 2), np.nan) if location.footprint_lonlat is None else location.footprint_lonlat
    sigma = np.full(4, np.nan) if location.corner_sigma_m is None else location.corner_sigma_m
    rows = []
    for name, at, xy, degrees, s in zip(_CORNERS, positions, place.footprint, lonlat, sigma, strict=True):
        span = 12 * s if math.isfinite(s) and s > 5 else 60
        show = f'<button type="button" data-x="{at[0]:.1f}" data-y="{at[1]:.1f}" data-span="{span:.0f}">{name}</button>'
        where = format_lonlat(*degrees) if np.isfinite(degrees).all() else ""
        where += f"<br><small>{xy[0]:,.1f}, {xy[1]:,.1f}</small>"
        rows.append(f"<tr><td>{show}</td><td>{where}</td><td>{f'± {s:.1f} m' if math.isfinite(s) else '–'}</td></tr>")
    crs = place.crs if place.crs.upper().startswith("EPSG:") else "a plane of its own, see below"
    return f'<table>{"".join(rows)}</table><p class="faint">Metres in {html.escape(crs)}</p>'


def _matches(subject: Shown) -> str:
    """List the matches; the page's script takes their positions from here."""
    matches = subject.matches()
    if matches is None or len(matches.residual_m) == 0:
        return ""
    pixels = plane_to_pixel(matches.query_xy)
    values = np.column_stack([pixels, matches.reference_xy, matches.residual_m]).tolist()
    rows = [
        f'<tr><td><button type="button">{i}</button></td><td>{column:.1f}</td><td>{row:.1f}</td>'
        f"<td>{x:.2f}</td><td>{y:.2f}</td><td>{residual:.2f}</td></tr>"
        for i, (column, row, x, y, residual) in enumerate(values, 1)
    ]
    heads = "".join(f'<th scope="col">{name}</th>' for name in ("No.", "column", "row", "x", "y", "residual, m"))
    left_out = subject.location.n_matched - len(rows)
    note = f'<p class="faint">{left_out} more, with smaller residuals, are not shown.</p>' if left_out > 0 else ""
    return (
        '<p class="faint">Choose one here or in a picture to see it in both. Arrows go from the map to the mask.</p>'
        '<p class="chosen-match" role="status"></p>'
        f"<details><summary>All {len(rows)}, the largest residual first</summary>"
        f'<div class="scroll" tabindex="0"><table class="matches"><thead><tr>{heads}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div></details>{note}"
    )


def _details(subject: Shown) -> list[tuple[str, str]]:
    """Label and value (HTML) of everything else, for those who want to check."""
    location = subject.location
    plain = location.to_dict()
    seconds = ", ".join(f"{step} {value:.3f}" for step, value in plain["seconds"].items())
    stats = ", ".join(f"{value:,} {name.replace('_', ' ')}" for name, value in plain["stats"].items())
    rows = [("Mask", html.escape(bare_name(location.query))), ("Map", html.escape(location.reference))]
    rows += [("Source", html.escape(text)) for text in _sources(subject.index)]
    rows += [("Seconds", seconds), ("Search", stats)]
    if location.crs is not None:
        rows.append(("CRS", f"<code>{html.escape(location.crs)}</code>"))
    if location.homography is not None:
        matrix = "\n".join("  ".join(f"{value: .9e}" for value in row) for row in location.homography)
        note = "takes (column, row, 1) to the CRS; the middle of the first pixel is (0.5, 0.5)"
        rows.append(("Homography", f"<pre>{matrix}</pre><small>{note}</small>"))
    if location.command:
        rows.append(("Made by", f"<code>{html.escape(bare_command(location.command))}</code>"))
    return rows


def _sources(index: ReferenceIndex) -> list[str]:
    """Name the sources of the map, and its date where that is known."""
    sources = [source for source in index.meta.get("sources", []) if isinstance(source, dict)]
    names = [(str(source.get("name", "")), str(source.get("osm_timestamp", ""))) for source in sources[:20]]
    return [f"{name}, as of {time}" if time else name for name, time in names if name]
