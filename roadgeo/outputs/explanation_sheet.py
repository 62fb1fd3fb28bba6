"""A picture of an explanation: the roads seen in the mask, the best places on the map, and the stage that failed."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._text import counted
from roadgeo.errors import OutputError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.matching.explanation import Explanation, Funnel, RejectedPlace, Story
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.outputs.canvas import (
    FAINT_INK,
    FRAME,
    INK,
    LIT,
    MAP_ROAD,
    MATCH,
    PAPER,
    QUERY_ROAD,
    SHIFT,
    Color,
    draw_dots,
    draw_outline,
    fixed_point,
    touching,
    write_png,
    write_text,
)
from roadgeo.outputs.names import bare_command, bare_name, without_folders
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.wording import format_lonlat

__all__ = ["draw_explanation", "write_explanation", "write_explanation_picture"]

AGREES: Color = (0, 128, 128)
ROAD_PIXEL: Color = (206, 208, 210)
UNSEEN: Color = (228, 224, 214)
BAR: Color = (150, 178, 204)
STARVED: Color = (200, 66, 40)

_WIDTH, _MARGIN, _HEAD = 2000, 30, 96
_MASK = 840  # side of the panel that shows the mask
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
    told = json.dumps(explained, indent=2, allow_nan=False)
    path.write_text(told + "\n", encoding="utf-8", newline="\n")


def write_explanation_picture(path: Path, subject: Subject) -> None:
    """Write `draw_explanation` as PNG, on the map that came nearest to an answer."""
    explanation = _explained(subject)
    write_png(path, draw_explanation(explanation, subject.mask, subject.index_of(explanation.nearest.reference)))


def _explained(subject: Subject) -> Explanation:
    if subject.explanation is None:
        raise OutputError(f"{subject.location.query}: there is no explanation to write; locate it with `explain`")
    return subject.explanation


def draw_explanation(explanation: Explanation, mask: RoadMask, index: ReferenceIndex) -> AnyArray:
    """Draw why a mask was or was not located on one reference.

    Parameters
    ----------
    index : ReferenceIndex
        The hypothesis that the picture explains.

    Returns
    -------
    (height, 2000, 3) uint8
        Red, green, blue. Left the mask, its traced roads and intersections, and below how many candidates each stage
        left; right the best places: the mask's roads on the map's, teal where they agree and orange where not.
    """
    told = explanation.stories
    story = next((one for one in told if one.reference == index.name), told[0])
    seen = _draw_seen(explanation.scene, mask, list(explanation.graph.polylines()))
    left = np.vstack([seen, _draw_funnel(story)])
    places = _draw_places(story.places, explanation.scene, index)
    notes = _draw_notes(story)
    right = np.vstack([places, notes])
    height = max(len(left), len(right))
    picture = np.full((_HEAD + height + _MARGIN, _WIDTH, 3), LIT, np.uint8)
    picture[_HEAD : _HEAD + len(left), _MARGIN : _MARGIN + left.shape[1]] = left
    picture[_HEAD : _HEAD + len(right), -right.shape[1] - _MARGIN : -_MARGIN] = right
    location = explanation.location
    name = Path(location.query).name or "mask"
    title = f"{name} on {story.reference}: {location.status.replace('_', ' ')}"
    write_text(picture, title, (_MARGIN, 42), 30, INK, bold=True)
    write_text(picture, _shorten(location.reason, 150), (_MARGIN, 78), 21, FAINT_INK)
    attribution = str(index.meta.get("attribution", ""))
    write_text(picture, attribution, (_WIDTH - right.shape[1] - _MARGIN, len(picture) - 12), 14, FAINT_INK)
    return picture


# --- the mask ---------------------------------------------------------------------------------------------------------


def _draw_seen(scene: Scene, mask: RoadMask, lines: Sequence[FloatArray]) -> AnyArray:
    """Draw the mask, its traced roads and its intersections, and a line of numbers below."""
    rows, columns = mask.shape
    scale = _MASK / max(rows, columns)
    size = (max(round(columns * scale), 1), max(round(rows * scale), 1))
    roads = cv2.resize(mask.roads.view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA)[..., None] / 255
    small = np.rint(np.array(PAPER) * (1 - roads) + np.array(ROAD_PIXEL) * roads).astype(np.uint8)
    if mask.observed is not None:
        unseen = cv2.resize((~mask.observed).view(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        small[unseen] = UNSEEN

    def pixels(xy: FloatArray) -> AnyArray:
        return fixed_point(plane_to_pixel(xy) * scale - 0.5)

    cv2.polylines(small, [pixels(line) for line in lines], False, QUERY_ROAD, 1, cv2.LINE_AA, SHIFT)
    n = len(scene.intersections)
    draw_dots(small, pixels(scene.intersections.xy), 3.2 if n < 200 else 1.8 if n < 1000 else 0.8)
    panel = np.full((_MASK + 40, _MASK, 3), LIT, np.uint8)
    top, left = (_MASK - size[1]) // 2, (_MASK - size[0]) // 2
    panel[top : top + size[1], left : left + size[0]] = small
    unseen_share = 1.0 - float(scene.observed.mean())
    numbers = f"{columns} x {rows} px   ·   {counted(n, 'intersection')}   ·   {counted(scene.n_edges, 'road')}"
    if unseen_share > 0.01:
        numbers += f"   ·   {unseen_share:.0%} not observed"
    write_text(panel, numbers, (0, _MASK + 28), 19, INK)
    return panel


def _draw_funnel(story: Story) -> AnyArray:
    """Draw a bar for each stage; its length is the logarithm of the number of candidates left."""
    stages = [field.name for field in fields(Funnel)]
    panel = np.full((40 + 29 * len(stages), _MASK, 3), LIT, np.uint8)
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


@dataclass(frozen=True)
class _Tile:
    """A square picture of the map; pixel = (plane - low) * scale, rows downwards."""

    image: AnyArray
    low: FloatArray
    scale: float

    def pixels(self, xy: FloatArray) -> AnyArray:
        """Take plane positions (..., 2) to fixed-point pixels."""
        at = (xy - self.low) * self.scale
        at[..., 1] = len(self.image) - at[..., 1]
        return fixed_point(np.clip(at - 0.5, -20_000, 20_000))


def _draw_places(places: Sequence[RejectedPlace], scene: Scene, index: ReferenceIndex) -> AnyArray:
    width = _WIDTH - _MASK - 3 * _MARGIN
    if not places:
        panel = np.full((160, width, 3), PAPER, np.uint8)
        write_text(panel, "No place got as far as being compared with the map.", (_MARGIN, 90), 22, FAINT_INK)
        return panel
    columns = min(max(len(places), 2), 3)
    side = (width - (columns - 1) * _MARGIN) // columns
    rows = -(-len(places) // columns)
    panel = np.full((rows * (side + _CAPTION), width, 3), LIT, np.uint8)
    for i, place in enumerate(places):
        top, left = i // columns * (side + _CAPTION), i % columns * (side + _MARGIN)
        panel[top : top + side, left : left + side] = _draw_place(place, scene, index, side)
        _caption(panel, (left, top + side), side, i + 1, place)
    return panel


def _draw_place(place: RejectedPlace, scene: Scene, index: ReferenceIndex, side: int) -> AnyArray:
    low, high = place.footprint.min(axis=0), place.footprint.max(axis=0)
    reach = 0.57 * float((high - low).max())
    middle = (low + high) / 2
    tile = _Tile(np.full((side, side, 3), PAPER, np.uint8), middle - reach, side / (2 * reach))
    frame = tile.pixels(place.footprint)
    cv2.fillPoly(tile.image, [frame], LIT, cv2.LINE_AA, SHIFT)
    ends = index.segments.reshape(-1, 2, 2)
    near = touching(ends, middle - reach, middle + reach)
    width = int(np.clip(round(9.0 * tile.scale), 2, 9))
    roads = list(tile.pixels(ends[near].astype(np.float64)))
    cv2.polylines(tile.image, roads, False, MAP_ROAD, width, cv2.LINE_AA, SHIFT)
    for agrees, color in ((False, QUERY_ROAD), (True, AGREES)):
        strokes = _strokes(scene, place, place.agrees == agrees)
        cv2.polylines(tile.image, list(tile.pixels(strokes)), False, color, 2, cv2.LINE_AA, SHIFT)
    draw_outline(tile.image, frame)
    return tile.image


def _strokes(scene: Scene, place: RejectedPlace, chosen: AnyArray) -> FloatArray:
    """Map (C, 2, 2) short strokes along the mask's roads around the chosen road points to the plane."""
    half = 0.5 * scene.road_length_px / max(len(scene.points), 1) * scene.directions[chosen]
    ends = np.stack([scene.points[chosen] - half, scene.points[chosen] + half], axis=1)
    strokes = Homography(place.scored.model.matrix)(ends)
    return strokes[np.isfinite(strokes).all(axis=(1, 2))]


def _caption(panel: AnyArray, origin: tuple[int, int], side: int, number: int, place: RejectedPlace) -> None:
    x, y = origin
    log10_odds = place.scored.log10_odds
    odds = f"log10 odds {round(log10_odds, 1) + 0.0:.1f}" if math.isfinite(log10_odds) else "no fit"
    write_text(panel, f"{number}   {odds}", (x, y + 24), 19, INK, bold=True)
    where = f"{format_lonlat(place.center.lon, place.center.lat)}   ·   {place.camera.gsd_m:.2f} m/px"
    write_text(panel, where, (x, y + 48), 15, FAINT_INK)
    for i, line in enumerate(_wrap(place.why, side // 8)[:3]):
        write_text(panel, line, (x, y + 70 + 19 * i), 15, INK)


# --- notes ------------------------------------------------------------------------------------------------------------


def _draw_notes(story: Story) -> AnyArray:
    """Write the stage that failed, and the meaning of the colours."""
    width = _WIDTH - _MASK - 3 * _MARGIN
    lines = [line for note in story.missing for line in _bullet(note, width // 10)]
    panel = np.full((114 + 27 * len(lines), width, 3), LIT, np.uint8)
    y = 38
    if lines:
        write_text(panel, "What was missing", (0, y), 21, INK, bold=True)
        y += 32
    for line in lines:
        write_text(panel, line, (0, y), 18, INK)
        y += 27
    x, y = 0, y + 18
    keys = (
        ("map", MAP_ROAD, 6),
        ("mask, agrees", AGREES, 3),
        ("mask, does not", QUERY_ROAD, 3),
        ("frame, with its top", FRAME, 4),
    )
    for label, color, thickness in keys:
        cv2.line(panel, (x + 3, y - 6), (x + 36, y - 6), color, thickness, cv2.LINE_AA)
        x = write_text(panel, label, (x + 46, y), 17, INK) + 34
    draw_dots(panel, np.array([[x + 6, y - 6]]) << SHIFT, 4.0)
    write_text(panel, "intersection", (x + 20, y), 17, MATCH)
    return panel


def _bullet(note: str, width: int) -> list[str]:
    """Wrap a note, later lines indented."""
    first, *rest = _wrap(note, width)
    return [f"·  {first}", *(f"    {line}" for line in rest)]


def _wrap(text: str, width: int) -> list[str]:
    """Break text into lines of at most `width` letters, at spaces."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def _shorten(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 1].rstrip()}…"
