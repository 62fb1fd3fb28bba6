"""The findings of an evaluation: sentences and tables, as CSV and as one page of the layers that all pages show."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from roadgeo._text import in_html
from roadgeo.evaluation.scoring import Evaluation, Score, Share, Spread, Summary
from roadgeo.evaluation.truth import Truth
from roadgeo.geometry.frame import Frame
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.drawing.layers import Layer, Ring
from roadgeo.outputs.drawing.views import Window, map_layer
from roadgeo.outputs.names import table_cell, table_text
from roadgeo.outputs.report.page import name_owners, render_page, section, table
from roadgeo.outputs.report.viewer import draw_viewer

__all__ = ["TITLES", "masks_to_csv", "render_report", "summary_table", "verdicts"]

TITLES = {
    "kind": "Kind of mask",
    "n_intersections": "Intersections in the mask",
    "tilt_deg": "Tilt of the camera, degrees",
    "gsd_m": "Ground sampling, m per pixel",
    "density_km2": "Intersections per km²",
}

_NOTE = "In brackets: 95 % confidence. Metres, ms: median/95 %."
_OUTCOMES = ("right", "wrong", "ambiguous", "not_located")

#: Masks that are named on the page, vertices of the map's roads on it, and how much of the map lies around the masks.
_MOST_LOST, _VERTICES, _MARGIN = 200, 80_000, 0.05


# --- words and tables -------------------------------------------------------------------------------------------------


def summary_table(groups: Sequence[Summary]) -> tuple[list[str], list[list[str]]]:
    """Return the heads and the rows of a table of groups: shares with their intervals, median and 95th percentile.

    Where every mask has a place, no column counts those that were rightly refused.
    """
    absent = any(group.refused.of for group in groups)
    heads = ["", "masks", "precision %", "recall %", *(["refused"] if absent else []), "centre m", "corners m", "ms"]
    rows = [
        [
            group.name,
            str(group.queries),
            _percent(group.precision),
            _percent(group.recall),
            *([f"{group.refused.hits}/{group.refused.of}" if group.refused.of else "-"] if absent else []),
            _pair(group.center_m, 1),
            _pair(group.corners_rms_m, 1),
            _pair(group.compute_s, 0, 1000),
        ]
        for group in groups
    ]
    return heads, rows


def verdicts(evaluation: Evaluation) -> Iterator[str]:
    """Describe the numbers in the tables, and whether scores and standard deviations hold."""
    yield _NOTE
    wrong, located = (sum(getattr(band.wrong, name) for band in evaluation.bands) for name in ("hits", "of"))
    broken = next((band for band in evaluation.bands if not band.holds), None)
    if broken is not None:
        stated = f"{100 * broken.at_most:.2g} % is stated at most"
        counted = f"{broken.wrong.hits} of {broken.wrong.of}"
        yield f"Scores promise too much: {counted} located with scores from {broken.score:g} are wrong, {stated}."
    elif located:
        yield f"Scores hold: {wrong} of {located} located masks are wrong, no count contradicts their error rates."
    if evaluation.sigma.within_1.of:
        robust = f"robustly {evaluation.sigma.robust:.2f}"
        yield f"Corner errors are {evaluation.sigma.rms:.2f} times what is claimed ({robust})."


def _percent(estimate: Share) -> str:
    if not estimate.of:
        return "-"
    return f"{100 * estimate.value:.3g} ({100 * estimate.low:.0f}-{100 * estimate.high:.0f})"


def _pair(spread: Spread, digits: int, scale: float = 1.0) -> str:
    """Median and 95th percentile."""
    if math.isnan(spread.median):
        return "-"
    return f"{scale * spread.median:.{digits}f}/{scale * spread.p95:.{digits}f}"


def _outcome(entry: Score) -> str:
    """One of `_OUTCOMES`; a mask without a place is right where it is not located."""
    if entry.right or (not entry.on_map and not entry.located):
        return "right"
    return "wrong" if entry.located else "ambiguous" if entry.status == "ambiguous" else "not_located"


def masks_to_csv(evaluation: Evaluation) -> str:
    """Return a table of all masks: their properties, how each fared, and why."""
    names = list(dict.fromkeys(name for entry in evaluation.scores for name in entry.properties))
    own = ["file", "kind", "on_map", "status", "outcome", "center_m", "corners_rms_m", "log10_odds", "compute_s"]
    rows: list[list[object]] = [[*own, "reason", *names]]
    for entry in evaluation.scores:
        numbers = (entry.center_m, entry.corners_rms_m, entry.log10_odds, entry.compute_s)
        cells = [table_cell(entry.file), entry.kind, entry.on_map, entry.status, _outcome(entry)]
        cells += ["" if math.isnan(number) else f"{number:.6g}" for number in numbers]
        rows.append([*cells, table_cell(entry.reason), *(entry.properties.get(name, "") for name in names)])
    return table_text(rows)


# --- the page ---------------------------------------------------------------------------------------------------------


def render_report(
    evaluation: Evaluation, truths: Sequence[Truth], title: str, indexes: Sequence[ReferenceIndex] = ()
) -> str:
    """Render an evaluation as a whole HTML page.

    Parameters
    ----------
    truths : sequence of Truth
        In the order of `evaluation.scores`; for the map.
    indexes : sequence of ReferenceIndex, optional
        The map, or its parts that the masks lie on, to draw its roads.
    """
    settings = ", ".join(f"{name} {_text(value)}" for name, value in evaluation.settings.items())
    parts = ["".join(f"<p>{in_html(line)}</p>" for line in verdicts(evaluation))]
    for by, groups in evaluation.breakdowns.items():
        parts.append(
            section(TITLES[by], _table(*summary_table([*groups, evaluation.total] if by == "kind" else groups)))
        )
    parts.append(section("Masks that were lost", _lost(evaluation.scores)))
    credit = name_owners(indexes)
    return render_page(title, settings, _draw_map(evaluation.scores, truths, indexes, credit), parts, credit)


def _text(value: object) -> str:
    if isinstance(value, list | tuple):
        if len(value) == 2 and all(isinstance(part, int | float) for part in value):
            return f"{value[0]:g} or more" if value[1] >= 1e6 else f"{value[0]:g} to {value[1]:g}"
        return " ".join(_text(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return table(heads, (map(in_html, row) for row in rows))


def _lost(scores: Sequence[Score]) -> str:
    """Name the masks that were not located rightly, wrong ones first, and why not."""
    lost = [entry for outcome in _OUTCOMES[1:] for entry in scores if _outcome(entry) == outcome]
    if not lost:
        return "<p>All are right.</p>"
    rows = []
    for entry in lost[:_MOST_LOST]:
        numbers = ["-" if math.isnan(value) else f"{value:.1f}" for value in (entry.center_m, entry.log10_odds)]
        rows.append([entry.file, _outcome(entry).replace("_", " "), *numbers, entry.reason])
    more = f"<p>And {len(lost) - _MOST_LOST} more; see masks.csv.</p>" if len(lost) > _MOST_LOST else ""
    return _table(("", "outcome", "centre m", "score", "reason given"), rows) + more


def _draw_map(scores: Sequence[Score], truths: Sequence[Truth], indexes: Sequence[ReferenceIndex], credit: str) -> str:
    """Draw where the masks lie, by outcome, over the roads of the map; nothing where none has a place."""
    there = [(entry, truth) for entry, truth in zip(scores, truths, strict=True) if truth.on_map]
    if not there:
        return ""
    crs = indexes[0].plane.crs if indexes else there[0][1].crs
    rings = [truth.places(Frame(*truth.size).corners, crs) for _, truth in there]
    window = Window.around(np.concatenate(rings), _MARGIN)
    roads = [mark for index in indexes for mark in map_layer(index, window, window, _VERTICES).marks]
    layers = [Layer("map-roads", "roads of the map", roads)]
    for outcome in _OUTCOMES:
        name = outcome.replace("_", " ")
        marks = [
            Ring(window.place(ring), title=f"{entry.file}: {name}")
            for (entry, _), ring in zip(there, rings, strict=True)
            if _outcome(entry) == outcome
        ]
        layers.append(Layer(outcome, name, marks))
    return draw_viewer("Where the masks lie", window, layers, credit)
