"""A picture of an explanation: the roads seen in the mask, the best places on the map, and the stage that failed."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._text import counted
from roadgeo.errors import OutputError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.matching.explanation import Explanation, Funnel, RejectedPlace, Story
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.outputs.drawing.layers import Color, Dots, Layer, Lines, Ring, rgb
from roadgeo.outputs.drawing.raster import FAINT, INK, Canvas, blank, draw_legend, write_png, write_text
from roadgeo.outputs.drawing.views import Window, map_layer, mask_layer
from roadgeo.outputs.names import bare_command, bare_name, without_folders
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.wording import format_lonlat

__all__ = ["draw_explanation", "write_explanation", "write_explanation_picture"]

BAR: Color = (150, 178, 204)
STARVED: Color = rgb("bad")

_WIDTH, _MARGIN, _HEAD = 2000, 30, 96
_MASK = 840  # side of the panel that shows the mask
_PLACE_VERTICES = 20_000  # of the map's roads in the picture of a place
_CAPTION = 132  # height of the text below a place

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
    left = np.vstack([_draw_seen(subject, explanation), _draw_funnel(story)])
    right = np.vstack([_draw_places(story.places, explanation.scene, index), _draw_notes(story)])
    height = max(len(left), len(right))
    picture = blank(_HEAD + height + _MARGIN, _WIDTH)
    picture[_HEAD : _HEAD + len(left), _MARGIN : _MARGIN + left.shape[1]] = left
    picture[_HEAD : _HEAD + len(right), -right.shape[1] - _MARGIN : -_MARGIN] = right
    location = explanation.location
    name = Path(location.query).name or "mask"
    title = f"{name} on {story.reference}: {location.status.replace('_', ' ')}"
    write_text(picture, title, (_MARGIN, 42), 30, INK, bold=True)
    write_text(picture, textwrap.shorten(location.reason, 150, placeholder="…"), (_MARGIN, 78), 21, FAINT)
    attribution = str(index.meta.get("attribution", ""))
    write_text(picture, attribution, (_WIDTH - right.shape[1] - _MARGIN, len(picture) - 12), 14, FAINT)
    return picture


# --- the mask ---------------------------------------------------------------------------------------------------------


def _draw_seen(subject: Subject, explanation: Explanation) -> AnyArray:
    """Draw the mask, its traced roads and its intersections, and a line of numbers below."""
    scene = explanation.scene
    roads = Lines([plane_to_pixel(line) for line in explanation.graph.polylines()])
    crossings = plane_to_pixel(scene.intersections.xy)
    canvas = Canvas.of(subject.box, _MASK, _MASK)
    canvas.draw([mask_layer(subject), Layer("query-roads", "", [roads]), Layer("matches", "", [Dots(crossings)])])
    panel, image = blank(_MASK + 40, _MASK), canvas.image[:_MASK, :_MASK]
    top, left = (_MASK - len(image)) // 2, (_MASK - image.shape[1]) // 2
    panel[top : top + len(image), left : left + image.shape[1]] = image
    unseen_share = 1.0 - float(scene.observed.mean())
    numbers = f"{subject.mask_size[0]} x {subject.mask_size[1]} px   ·   {counted(len(crossings), 'intersection')}"
    numbers += f"   ·   {counted(scene.n_edges, 'road')}"
    if unseen_share > 0.01:
        numbers += f"   ·   {unseen_share:.0%} not observed"
    write_text(panel, numbers, (0, _MASK + 28), 19, INK)
    return panel


def _draw_funnel(story: Story) -> AnyArray:
    """Draw a bar for each stage; its length is the logarithm of the number of candidates left."""
    stages = [field.name for field in fields(Funnel)]
    panel = blank(40 + 29 * len(stages), _MASK)
    write_text(panel, "How far the search got", (0, 24), 21, INK, bold=True)
    most = max(max(getattr(story.funnel, stage) for stage in stages), 10)
    for i, stage in enumerate(stages):
        count = getattr(story.funnel, stage)
        baseline = 60 + 29 * i
        starved = stage == story.starved_at or (stage == "verified" and story.starved_at == "camera")
        write_text(panel, _STAGES[stage], (0, baseline), 18, STARVED if starved else INK)
        room = _MASK - 400
        length = round(room * math.log10(1 + count) / math.log10(1 + most))
        cv2.rectangle(panel, (290, baseline - 15), (290 + length, baseline + 3), STARVED if starved else BAR, -1)
        write_text(panel, f"{count:,}", (300 + length, baseline), 18, INK)
    return panel


# --- the places -------------------------------------------------------------------------------------------------------


def _draw_places(places: Sequence[RejectedPlace], scene: Scene, index: ReferenceIndex) -> AnyArray:
    width = _WIDTH - _MASK - 3 * _MARGIN
    if not places:
        panel = blank(160, width, rgb("paper"))
        write_text(panel, "No place got as far as being compared with the map.", (_MARGIN, 90), 22, FAINT)
        return panel
    columns = min(max(len(places), 2), 3)
    side = (width - (columns - 1) * _MARGIN) // columns
    rows = -(-len(places) // columns)
    panel = blank(rows * (side + _CAPTION), width)
    for i, place in enumerate(places):
        top, left = i // columns * (side + _CAPTION), i % columns * (side + _MARGIN)
        panel[top : top + side, left : left + side] = _draw_place(place, scene, index, side)
        _caption(panel, (left, top + side), side, i + 1, place)
    return panel


def _draw_place(place: RejectedPlace, scene: Scene, index: ReferenceIndex, side: int) -> AnyArray:
    """Draw the map around a place, and on it the mask's roads: (side, side, 3)."""
    middle = place.footprint.min(axis=0) / 2 + place.footprint.max(axis=0) / 2
    reach = 0.57 * float(np.ptp(place.footprint, axis=0).max())
    # Its window in the map's CRS, as the layers have it, which is the plane shifted.
    west, south = index.plane.to_crs(middle - reach).tolist()
    window = Window(west, south + 2 * reach, 2 * reach, 2 * reach)
    corners = window.place(index.plane.to_crs(place.footprint))
    canvas = Canvas.of(window.box, side, side)
    canvas.draw([Layer("ground", "", [Ring(corners)]), map_layer(index, window, window, _PLACE_VERTICES)])
    for name, agrees in (("query-roads", False), ("agreeing-roads", True)):
        strokes = window.place(index.plane.to_crs(_strokes(scene, place, place.agrees == agrees)))
        canvas.draw([Layer(name, "", [Lines(list(strokes))])])
    canvas.draw([Layer("footprint", "", [Ring(corners, up=True)])])
    return canvas.image[:side, :side]


def _strokes(scene: Scene, place: RejectedPlace, chosen: AnyArray) -> FloatArray:
    """Map (C, 2, 2) short strokes along the mask's roads around the chosen road points to the plane."""
    half = 0.5 * scene.road_length_px / max(len(scene.points), 1) * scene.directions[chosen]
    ends = np.stack([scene.points[chosen] - half, scene.points[chosen] + half], axis=1)
    strokes = Homography(place.scored.model.matrix)(ends)
    return strokes[np.isfinite(strokes).all(axis=(1, 2))]


def _caption(panel: AnyArray, origin: tuple[int, int], side: int, number: int, place: RejectedPlace) -> None:
    x, y = origin
    log10_odds = place.scored.log10_odds
    odds = f"score {round(log10_odds, 1) + 0.0:.1f}" if math.isfinite(log10_odds) else "no fit"
    write_text(panel, f"{number}   {odds}", (x, y + 24), 19, INK, bold=True)
    where = f"{format_lonlat(place.center.lon, place.center.lat)}   ·   {place.camera.gsd_m:.2f} m/px"
    write_text(panel, where, (x, y + 48), 15, FAINT)
    for i, line in enumerate(textwrap.wrap(place.why, side // 8)[:3]):
        write_text(panel, line, (x, y + 70 + 19 * i), 15, INK)


# --- notes ------------------------------------------------------------------------------------------------------------


def _draw_notes(story: Story) -> AnyArray:
    """Write the stage that failed, and the meaning of the colours."""
    width = _WIDTH - _MASK - 3 * _MARGIN
    wrapped = partial(textwrap.wrap, width=width // 10, initial_indent="·  ", subsequent_indent="    ")
    lines = [line for note in story.missing for line in wrapped(note)]
    panel = blank(114 + 27 * len(lines), width)
    y = 38
    if lines:
        write_text(panel, "What was missing", (0, y), 21, INK, bold=True)
        y += 32
    for line in lines:
        write_text(panel, line, (0, y), 18, INK)
        y += 27
    keys = [
        Layer("map-roads", "map", [Lines([])]),
        Layer("agreeing-roads", "mask, agrees", [Lines([])]),
        Layer("query-roads", "mask, does not", [Lines([])]),
        Layer("footprint", "frame, with its top", [Lines([])]),
        Layer("matches", "intersection", [Dots(np.empty((0, 2)))]),
    ]
    draw_legend(panel, keys, 0, y + 18, 17)
    return panel
