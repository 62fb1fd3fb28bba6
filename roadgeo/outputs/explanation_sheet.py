"""A picture of an explanation: the roads seen in the mask, the best places on the map, and the stage that failed."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._text import counted
from roadgeo.errors import OutputError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import metres_apart
from roadgeo.matching.explanation import Explanation, Story, Told
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.place import Place
from roadgeo.matching.scene import Scene
from roadgeo.outputs.drawing.layers import Color, Dots, Layer, Lines, Ring, rgb
from roadgeo.outputs.drawing.raster import (
    FAINT,
    INK,
    Canvas,
    below,
    beside,
    blank,
    draw_legend,
    framed,
    line,
    write_png,
)
from roadgeo.outputs.drawing.views import Window, map_layer, mask_layer
from roadgeo.outputs.names import bare_command, bare_name, without_folders
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.wording import format_lonlat

__all__ = ["draw_explanation", "numbered", "write_explanation", "write_explanation_picture"]

BAR: Color = (150, 178, 204)
STARVED: Color = rgb("bad")

#: Width of the picture, room around it, and widths of the mask's column and of the column of places.
_WIDTH, _MARGIN, _MASK = 2000, 30, 840
_PLACES = _WIDTH - _MASK - 3 * _MARGIN
_PLACE_VERTICES = 20_000  # of the map's roads in the picture of a place

#: Names of the stages of `Funnel` in the picture.
_STAGES = {
    "intersections": "intersections seen",
    "anchors": "tried as anchors",
    "tuples": "tuples looked up",
    "candidates": "like them on the map",
    "proposals": "places where several agree",
    "on_roads": "with roads around them",
    "grown": "followed outwards",
    "survived": "grown over the frame",
    "verified": "compared with the map",
    "measured": "promising",
}


def write_explanation(path: Path, subject: Subject) -> None:
    """Write `Explanation.to_dict` as JSON."""
    explained = _explained(subject).to_dict()
    query, reason, command = (str(explained[name]) for name in ("query", "reason", "command"))
    explained |= {"query": bare_name(query), "reason": without_folders(reason, query), "command": bare_command(command)}
    text = json.dumps(explained, indent=2, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8", newline="\n")


def write_explanation_picture(path: Path, subject: Subject) -> None:
    """Write `draw_explanation` as PNG."""
    write_png(path, draw_explanation(subject))


def _explained(subject: Subject) -> Explanation:
    if subject.explanation is None:
        raise OutputError(f"{subject.location.query}: there is no explanation to write; locate it with `explain`")
    return subject.explanation


def draw_explanation(subject: Subject) -> AnyArray:
    """Draw why a mask was or was not located, on the reference that came nearest to an answer.

    Returns
    -------
    (height, 2000, 3) uint8
        Red, green, blue. Left the mask, its traced roads and intersections, and below how many candidates each stage
        left; right the best places: the mask's roads on the map's, teal where they agree and orange where not.
    """
    explanation = _explained(subject)
    index, stories = subject.index_of(explanation.nearest.reference), explanation.stories
    story = next((each for each in stories if each.reference == index.name), stories[0])
    location = explanation.location
    title = f"{Path(location.query).name or 'mask'} on {story.reference}: {location.status.replace('_', ' ')}"
    reason = textwrap.shorten(location.reason, 150, placeholder="…")
    head = below(line(title, 30, bold=True), line(reason, 21, FAINT), width=_WIDTH - 2 * _MARGIN)
    credit = line(str(index.meta.get("attribution", "")), 14, FAINT)
    left = below(*_draw_seen(subject, explanation), *_draw_funnel(story), gap=6, width=_MASK)
    places = _draw_places(numbered(story, location.places), explanation.scene, index)
    right = below(*places, *_draw_notes(story), credit, gap=8, width=_PLACES)
    return framed(below(head, beside(left, right, gap=_MARGIN), gap=10), _MARGIN)


# --- the mask ---------------------------------------------------------------------------------------------------------


def _draw_seen(subject: Subject, explanation: Explanation) -> list[AnyArray]:
    """Draw the mask, its traced roads and its intersections, and a line of numbers."""
    scene = explanation.scene
    content = subject.location.content  # in the mask's own pixels, which the search may not have used
    graph, xy = explanation.graph, scene.intersections.xy
    graph, xy = (graph, xy) if content is None or content.graph is None else (content.graph, content.xy)
    roads = Lines([plane_to_pixel(road) for road in graph.polylines()])
    crossings = plane_to_pixel(xy)
    canvas = Canvas.of(subject.box, _MASK, _MASK)
    canvas.draw([mask_layer(subject), Layer("query-roads", "", [roads]), Layer("matches", "", [Dots(crossings)])])
    unseen_share = 1.0 - float(scene.observed.mean())
    numbers = [f"{subject.mask_size[0]} x {subject.mask_size[1]} px", counted(len(crossings), "intersection")]
    numbers += [counted(scene.n_edges, "road"), *([f"{unseen_share:.0%} not observed"] if unseen_share > 0.01 else [])]
    return [canvas.image, line("   ·   ".join(numbers), 19)]


def _draw_funnel(story: Story) -> list[AnyArray]:
    """Draw a bar for each stage; its length is the logarithm of the number of candidates left."""
    counts = {stage: int(getattr(story.funnel, stage)) for stage in _STAGES}
    most = max(*counts.values(), 10)
    rows = [line("How far the search got", 21, bold=True)]
    for stage, count in counts.items():
        starved = stage == story.starved_at or (stage == "verified" and story.starved_at == "camera")
        label = below(line(_STAGES[stage], 18, STARVED if starved else INK), width=290)
        bar = blank(len(label), 10 + round((_MASK - 400) * math.log10(1 + count) / math.log10(1 + most)))
        bar[4:22, :-10] = STARVED if starved else BAR
        rows.append(beside(label, bar, line(f"{count:,}", 18)))
    return rows


# --- the places -------------------------------------------------------------------------------------------------------


def numbered(story: Story, listed: Sequence[Placement]) -> list[tuple[int | None, Told]]:
    """Give each place of a story its number in the answer, by which `--take` knows it, or None; these come last."""
    left, found = list(story.places), []
    for number, one in enumerate(listed, 1):
        if one.reference != story.reference or not left:
            continue
        middle = np.array(one.center[2:])
        away, k = min((metres_apart(told.place.lonlat, middle), k) for k, told in enumerate(left))
        # A wrong number is worse than none, which is what a mask gets whose wide margins were cut off.
        if away < np.ptp(left[k].place.corners, axis=0).max() / 50:
            found.append((number, left.pop(k)))
    return [*found, *((None, told) for told in left)]


def _draw_places(places: Sequence[tuple[int | None, Told]], scene: Scene, index: ReferenceIndex) -> list[AnyArray]:
    """Draw the best places, two or three in a row."""
    if not places:
        return [line("No place got as far as being compared with the map.", 22, FAINT)]
    columns = min(max(len(places), 2), 3)
    side = (_PLACES - (columns - 1) * _MARGIN) // columns
    drawn = [
        below(_draw_place(entry.place, scene, index, side), *_caption(number, entry, side), width=side)
        for number, entry in places
    ]
    rows = [beside(*drawn[k : k + columns], gap=_MARGIN) for k in range(0, len(drawn), columns)]
    return [below(*rows, blank(0, 0), gap=20)]


def _draw_place(place: Place, scene: Scene, index: ReferenceIndex, side: int) -> AnyArray:
    """Draw the map around a place, and on it the mask's roads: (side, side, 3)."""
    middle = place.corners.min(axis=0) / 2 + place.corners.max(axis=0) / 2
    reach = 0.57 * float(np.ptp(place.corners, axis=0).max())
    # Its window in the map's CRS, as the layers have it, which is the plane shifted.
    west, south = index.plane.to_crs(middle - reach).tolist()
    window = Window(west, south + 2 * reach, 2 * reach, 2 * reach)
    corners = window.place(index.plane.to_crs(place.corners))
    canvas = Canvas.of(window.box, side, side)
    canvas.draw([Layer("ground", "", [Ring(corners)]), map_layer(index, window, window, _PLACE_VERTICES)])
    for name, agrees in (("query-roads", False), ("agreeing-roads", True)):
        strokes = window.place(index.plane.to_crs(_strokes(scene, place, place.on_roads == agrees)))
        canvas.draw([Layer(name, "", [Lines(list(strokes))])])
    canvas.draw([Layer("footprint", "", [Ring(corners, up=True)])])
    return canvas.image[:side, :side]


def _strokes(scene: Scene, place: Place, chosen: AnyArray) -> FloatArray:
    """Map (C, 2, 2) short strokes along the mask's roads around the chosen road points to the plane."""
    half = 0.5 * scene.road_length_px / max(len(scene.points), 1) * scene.directions[chosen]
    ends = np.stack([scene.points[chosen] - half, scene.points[chosen] + half], axis=1)
    strokes = Homography(place.matrix)(ends)
    return strokes[np.isfinite(strokes).all(axis=(1, 2))]


def _caption(number: int | None, entry: Told, side: int) -> list[AnyArray]:
    place, (lon, lat) = entry.place, entry.place.lonlat.tolist()
    score = f"score {round(place.score, 1) + 0.0:.1f}" if math.isfinite(place.score) else "no fit"
    where = f"{format_lonlat(lon, lat)}   ·   {place.gsd_m:.2f} m/px"
    why = [line(text, 15) for text in textwrap.wrap(entry.why, side // 8)[:3]]
    head = score if number is None else f"{number}   {score}"
    return [line(head, 19, bold=True), line(where, 15, FAINT), *why]


# --- notes ------------------------------------------------------------------------------------------------------------


def _draw_notes(story: Story) -> list[AnyArray]:
    """Write the stage that failed, and the meaning of the colours."""
    wrapped = partial(textwrap.wrap, width=_PLACES // 10, initial_indent="·  ", subsequent_indent="    ")
    lines = [line(text, 18) for note in story.missing for text in wrapped(note)]
    keys = [
        Layer("map-roads", "map", [Lines([])]),
        Layer("agreeing-roads", "mask, agrees", [Lines([])]),
        Layer("query-roads", "mask, does not", [Lines([])]),
        Layer("footprint", "frame, with its top", [Lines([])]),
        Layer("matches", "intersection", [Dots(np.empty((0, 2)))]),
    ]
    legend = blank(50, _PLACES)
    draw_legend(legend, keys, 0, 30, 17)
    return [*([line("What was missing", 21, bold=True)] if lines else []), *lines, legend]
