"""One HTML file that shows an evaluation: tables and charts (inline SVG), readable offline and on a phone."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from roadgeo.evaluation.scoring import Calibration, Evaluation, OddsStep, Score, Share, Spread, Summary
from roadgeo.evaluation.truth import Truth

__all__ = ["TITLES", "render_report"]

TITLES = {
    "kind": "Kind of mask",
    "n_intersections": "Intersections in the mask",
    "tilt_deg": "Tilt of the camera, degrees",
    "gsd_m": "Ground sampling, m per pixel",
    "density_km2": "Intersections per km²",
}

_NOTE = (
    "In brackets: 95 % confidence (Wilson). Metres and milliseconds: median / 95 %; errors of masks located rightly,"
    " time of vectorizing, matching and refining. Refused: of the masks that have no place on the map."
)

_BLUE, _ORANGE, _GREEN, _RED, _GREY = "#1f6fb4", "#e4572e", "#2e8b57", "#c62828", "#9aa0a6"
_OUTCOMES = {"right": _GREEN, "wrong": _RED, "ambiguous": _ORANGE, "not located": _GREY}

#: Order of the masks that were lost, and how many of them are named.
_LOST = ["wrong", "ambiguous", "not located"]
_MOST_LOST = 200

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light; }}
body {{ font: 15px/1.5 system-ui, sans-serif; color: #262a30; background: #f7f6f3; margin: 0; }}
main {{ max-width: 1080px; margin: 0 auto; padding: 1.2rem; }}
h1 {{ font-size: 1.5rem; margin: .2rem 0; }} h2 {{ font-size: 1.1rem; margin: 1.8rem 0 .4rem; }}
p, figcaption {{ max-width: 46rem; }} figcaption, .faint {{ color: #5f666e; font-size: .87rem; }}
.tiles {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(140px, 1fr)); gap: .6rem; margin: 1rem 0; }}
.tile {{ background: #fff; border: 1px solid #e2e0da; border-radius: 8px; padding: .6rem .8rem; }}
.tile b {{ display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; }}
.scroll {{ overflow-x: auto; }}
table {{ border-collapse: collapse; background: #fff; font-size: .88rem; font-variant-numeric: tabular-nums; }}
th, td {{ border: 1px solid #e2e0da; padding: .25rem .55rem; text-align: right; white-space: nowrap; }}
th:first-child, td:first-child {{ text-align: left; }} thead th {{ background: #efede7; }}
td.words {{ text-align: left; white-space: normal; min-width: 20rem; }}
.charts {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 430px), 1fr)); gap: 1rem; }}
figure {{ margin: 0; background: #fff; border: 1px solid #e2e0da; border-radius: 8px; padding: .6rem; }}
svg {{ width: 100%; height: auto; display: block; }} svg text {{ font: 12px system-ui, sans-serif; fill: #40464d; }}
</style>
</head>
<body><main>
<h1>{title}</h1>
{body}
</main></body>
</html>
"""


def render_report(evaluation: Evaluation, truths: Sequence[Truth], title: str) -> str:
    """Render an evaluation as a whole HTML page.

    Parameters
    ----------
    truths : sequence of Truth
        In the order of `evaluation.scores`; for the map.
    """
    settings = ", ".join(f"{name} {_text(value)}" for name, value in evaluation.settings.items())
    parts = [f'<p class="faint">{html.escape(settings)}</p>', _tiles(evaluation)]
    for by, table in evaluation.breakdowns.items():
        parts.append(f"<h2>{TITLES[by]}</h2>{_summary_table([*table, evaluation.total] if by == 'kind' else table)}")
    parts.append(f'<p class="faint">{_NOTE}</p>')
    parts.append(_lost_table(evaluation.scores))
    charts = [
        *(_share_chart(by, table) for by, table in evaluation.breakdowns.items() if len(table) > 1),
        _odds_chart(evaluation.odds),
        _sigma_chart(evaluation.scores, evaluation.sigma),
        _error_chart(evaluation.scores),
        _time_chart(evaluation.scores),
        _map(evaluation.scores, truths),
    ]
    parts.append(f'<h2>Charts</h2><div class="charts">{"".join(charts)}</div>')
    return _PAGE.format(title=html.escape(title), body="\n".join(parts))


# --- words and numbers ------------------------------------------------------------------------------------------------


def _text(value: object) -> str:
    if isinstance(value, list | tuple):
        if len(value) == 2 and all(isinstance(part, int | float) for part in value):
            return f"{value[0]:g} or more" if value[1] >= 1e6 else f"{value[0]:g} to {value[1]:g}"
        return " ".join(_text(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _percent(estimate: Share) -> str:
    if not estimate.of:
        return "–"
    return f"{100 * estimate.value:.1f} % <small>({100 * estimate.low:.1f}–{100 * estimate.high:.1f})</small>"


def _number(value: float, digits: int = 1) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"


def _spread(spread: Spread, scale: float = 1.0, digits: int = 1) -> str:
    return f"{_number(scale * spread.median, digits)} / {_number(scale * spread.p95, digits)}"


def _tiles(evaluation: Evaluation) -> str:
    total = evaluation.total
    tiles = [
        ("precision", _percent(total.precision)),
        ("recall", _percent(total.recall)),
        ("centre error, median", f"{_number(total.center_m.median)} m"),
        ("corners rms, 95 %", f"{_number(total.corners_rms_m.p95)} m"),
        ("time per mask, median", f"{_number(1000 * total.compute_s.median, 0)} ms"),
        ("error / claimed sigma", _number(evaluation.sigma.rms, 2)),
    ]
    shown = "".join(f'<div class="tile">{name}<b>{value}</b></div>' for name, value in tiles)
    return f'<div class="tiles">{shown}</div>'


def _summary_table(table: Sequence[Summary]) -> str:
    heads = ["", "masks", "located", "ambiguous", "precision", "recall", "centre, m", "corners, m", "time, ms"]
    absent = any(group.refused.of for group in table)
    if absent:
        heads.append("refused")
    rows = []
    for group in table:
        cells = [
            html.escape(group.name),
            str(group.queries),
            str(group.located),
            str(group.ambiguous),
            _percent(group.precision),
            _percent(group.recall),
            _spread(group.center_m),
            _spread(group.corners_rms_m),
            _spread(group.compute_s, 1000, 0),
        ]
        if absent:
            cells.append(f"{group.refused.hits}/{group.refused.of}" if group.refused.of else "–")
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    head = "".join(f"<th>{name}</th>" for name in heads)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _lost_table(scores: Sequence[Score]) -> str:
    """Name the masks that were not located rightly, wrong ones first, and why not."""
    lost = sorted((s for s in scores if _outcome(s) != "right"), key=lambda s: _LOST.index(_outcome(s)))
    if not lost:
        return "<h2>Masks that were lost</h2><p>None.</p>"
    rows = []
    for entry in lost[:_MOST_LOST]:
        cells = [
            html.escape(entry.file),
            _outcome(entry),
            _number(entry.center_m),
            _number(entry.log10_odds),
            _number(entry.properties.get("n_intersections", math.nan), 0),
            _number(entry.properties.get("tilt_deg", math.nan), 0),
            _number(1000 * entry.compute_s, 0),
        ]
        reason = f'<td class="words">{html.escape(entry.reason)}</td>'
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + reason + "</tr>")
    heads = ["", "outcome", "centre, m", "log10 odds", "intersections", "tilt, °", "time, ms", "reason given"]
    head = "".join(f"<th>{name}</th>" for name in heads)
    more = f"<p>And {len(lost) - _MOST_LOST} more; see evaluation.json.</p>" if len(lost) > _MOST_LOST else ""
    return (
        f'<h2>Masks that were lost</h2><div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>{more}"
    )


# --- charts -----------------------------------------------------------------------------------------------------------

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 460, 300, 52, 12, 24, 46


@dataclass(frozen=True)
class _Plane:
    """A chart's frame: its ranges; the SVG drawn before is put between `open` and `close`."""

    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: float, y: float) -> tuple[float, float]:
        """SVG position of a value, kept inside the frame."""
        across = min(max((x - self.x[0]) / (self.x[1] - self.x[0]), 0.0), 1.0)
        up = min(max((y - self.y[0]) / (self.y[1] - self.y[0]), 0.0), 1.0)
        return _LEFT + across * (_WIDTH - _LEFT - _RIGHT), _HEIGHT - _BOTTOM - up * (_HEIGHT - _TOP - _BOTTOM)

    def line(self, xs: Sequence[float], ys: Sequence[float], color: str, dash: str = "") -> str:
        """Polyline through values."""
        points = " ".join("{:.1f},{:.1f}".format(*self.at(x, y)) for x, y in zip(xs, ys, strict=True))
        return f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2" stroke-dasharray="{dash}"/>'

    def whisker(self, x: float, low: float, value: float, high: float, color: str, shift: float = 0.0) -> str:
        """Dot with its interval, `shift` pixels aside."""
        (px, top), (_, middle), (_, bottom) = (self.at(x, v) for v in (high, value, low))
        px += shift
        return (
            f'<line x1="{px:.1f}" x2="{px:.1f}" y1="{top:.1f}" y2="{bottom:.1f}" stroke="{color}" stroke-width="2"/>'
            f'<circle cx="{px:.1f}" cy="{middle:.1f}" r="4" fill="{color}"/>'
        )

    def frame(
        self,
        x_ticks: Sequence[tuple[float, str]],
        y_ticks: Sequence[tuple[float, str]],
        x_label: str,
        legend: Sequence[tuple[str, str]],
    ) -> str:
        """Grid, tick labels, axis label and legend."""
        parts = []
        for y, label in y_ticks:
            px, py = self.at(self.x[0], y)
            parts.append(f'<line x1="{px}" x2="{_WIDTH - _RIGHT}" y1="{py:.1f}" y2="{py:.1f}" stroke="#e8e6e0"/>')
            parts.append(f'<text x="{px - 6}" y="{py + 4:.1f}" text-anchor="end">{html.escape(label)}</text>')
        for x, label in x_ticks:
            px, py = self.at(x, self.y[0])
            parts.append(f'<text x="{px:.1f}" y="{py + 17:.1f}" text-anchor="middle">{html.escape(label)}</text>')
        middle = (_LEFT + _WIDTH - _RIGHT) / 2
        parts.append(f'<text x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">{html.escape(x_label)}</text>')
        at = float(_LEFT)
        for label, color in legend:
            parts.append(f'<rect x="{at}" y="5" width="11" height="11" fill="{color}"/>')
            parts.append(f'<text x="{at + 15}" y="15">{html.escape(label)}</text>')
            at += 30 + 6.6 * len(label)
        return "".join(parts)


def _figure(title: str, svg: str, caption: str, height: float = _HEIGHT) -> str:
    name = html.escape(title)
    return (
        f'<figure><b>{name}</b><svg viewBox="0 0 {_WIDTH} {height:.0f}" role="img" aria-label="{name}">{svg}</svg>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


_SHARES = [(value / 4, f"{25 * value} %") for value in range(5)]


def _share_chart(by: str, table: Sequence[Summary]) -> str:
    plane = _Plane((-0.5, len(table) - 0.5), (0.0, 1.0))
    dots = [
        plane.frame(
            [(i, g.name) for i, g in enumerate(table)], _SHARES, TITLES[by], [("precision", _BLUE), ("recall", _ORANGE)]
        )
    ]
    for i, group in enumerate(table):
        for estimate, color, shift in ((group.precision, _BLUE, -6.0), (group.recall, _ORANGE, 6.0)):
            if estimate.of:
                dots.append(plane.whisker(i, estimate.low, estimate.value, estimate.high, color, shift))
    return _figure(f"Precision and recall: {TITLES[by].lower()}", "".join(dots), "Bars: 95 % confidence.")


def _odds_chart(steps: Sequence[OddsStep]) -> str:
    known = [step for step in steps if step.wrong.of]
    limit = max((step.at_least for step in known), default=1.0) or 1.0
    plane = _Plane((0.0, limit), (-4.0, 0.0))

    def log(value: float) -> float:
        return math.log10(max(value, 1e-4))

    fine = np.linspace(0.0, limit, 60).tolist()
    parts = [
        plane.frame(
            [(step.at_least, f"{step.at_least:g}") for step in known],
            [(k, f"{10.0 ** (k + 2):g} %") for k in range(-4, 1)],
            "located at log10 odds of at least",
            [("wrong", _BLUE), ("promised at most", _GREY)],
        ),
        plane.line(fine, [log(1 / (1 + 10**x)) for x in fine], _GREY, "5 4"),
    ]
    parts += [plane.whisker(s.at_least, log(s.wrong.low), log(s.wrong.value), log(s.wrong.high), _BLUE) for s in known]
    worst = [f"{step.at_least:g}" for step in known if not step.holds]
    verdict = f"The count contradicts the odds at {', '.join(worst)}." if worst else "No count contradicts the odds."
    return _figure(
        "Do the odds mean what they say?", "".join(parts), f"Share of wrong ones, 95 % confidence. {verdict}"
    )


def _sigma_chart(scores: Sequence[Score], calibration: Calibration) -> str:
    ratios = [
        error / sigma
        for s in scores
        if s.right
        for error, sigma in zip(s.corners_m, s.sigma_m, strict=True)
        if sigma > 0 and math.isfinite(error)
    ]
    fine = np.linspace(0.0, 4.0, 80).tolist()
    plane = _Plane((0.0, 4.0), (0.0, 1.0))
    svg = (
        plane.frame(
            [(k, str(k)) for k in range(5)], _SHARES, "corner error / claimed", [("measured", _BLUE), ("honest", _GREY)]
        )
        + plane.line(fine, [1 - math.exp(-x * x) for x in fine], _GREY, "5 4")
        + _cumulative(plane, ratios, _BLUE)
    )
    caption = f"Corner errors in units of sigma: rms {_number(calibration.rms, 2)}, 1 is honest."
    return _figure("Do the standard deviations mean what they say?", svg, caption)


def _error_chart(scores: Sequence[Score]) -> str:
    right = [s for s in scores if s.right]
    limit = max([2.0, *(s.corners_rms_m for s in right)])
    return _log_chart(
        "Errors of masks located rightly",
        "metres",
        (0.1, limit),
        [("centre", _BLUE, [s.center_m for s in right]), ("corners, rms", _ORANGE, [s.corners_rms_m for s in right])],
        lambda value: f"{value:g}",
    )


def _time_chart(scores: Sequence[Score]) -> str:
    seconds = [s.compute_s for s in scores if s.seconds]
    return _log_chart(
        "Time per mask",
        "vectorize + match + refine",
        (0.01, max([1.0, *seconds])),
        [("all masks", _BLUE, seconds)],
        lambda value: f"{value:g} s" if value >= 1 else f"{1000 * value:g} ms",
    )


def _log_chart(
    title: str,
    label: str,
    limits: tuple[float, float],
    curves: Sequence[tuple[str, str, Sequence[float]]],
    words: Callable[[float], str],
) -> str:
    """Draw cumulative shares over a logarithmic axis."""
    low, high = math.log10(limits[0]), math.ceil(math.log10(limits[1]))
    plane = _Plane((low, max(high, low + 1)), (0.0, 1.0))
    ticks = [(k, words(10.0**k)) for k in range(math.ceil(low), int(plane.x[1]) + 1)]
    svg = plane.frame(ticks, _SHARES, label, [(name, color) for name, color, _ in curves])
    for _, color, values in curves:
        svg += _cumulative(plane, [math.log10(max(value, limits[0])) for value in values], color)
    return _figure(title, svg, "Share of masks with at most this much.")


def _cumulative(plane: _Plane, values: Sequence[float], color: str) -> str:
    xs = sorted(values)
    n = len(xs)
    return plane.line([plane.x[0], *xs, plane.x[1]], [0.0, *((i + 1) / n for i in range(n)), 1.0], color) if n else ""


def _outcome(entry: Score) -> str:
    if entry.right or (not entry.on_map and not entry.located):
        return "right"
    if entry.located:
        return "wrong"
    return "ambiguous" if entry.status == "ambiguous" else "not located"


def _map(scores: Sequence[Score], truths: Sequence[Truth]) -> str:
    shown = [(entry, truth) for entry, truth in zip(scores, truths, strict=True) if truth.on_map]
    if not shown:
        return ""
    corners = np.concatenate([truth.footprint for _, truth in shown])
    low, size = corners.min(axis=0), np.ptp(corners, axis=0).max()
    scale = (_WIDTH - 20) / size
    height = np.ptp(corners[:, 1]) * scale + 40
    parts = []
    for name in ("not located", "right", "ambiguous", "wrong"):
        for entry, truth in shown:
            if _outcome(entry) == name:
                points = (truth.footprint - low) * (scale, -scale) + (10, height - 10)
                path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
                color = _OUTCOMES[name]
                style = f'fill="{color}" fill-opacity=".12" stroke="{color}"'
                name_of = html.escape(f"{entry.file}: {name}")
                parts.append(f'<polygon points="{path}" {style}><title>{name_of}</title></polygon>')
    at = 10.0
    for name, color in _OUTCOMES.items():
        parts.append(
            f'<rect x="{at}" y="5" width="11" height="11" fill="{color}"/><text x="{at + 15}" y="15">{name}</text>'
        )
        at += 30 + 6.6 * len(name)
    return _figure("Where the masks lie", "".join(parts), "Footprints, north up.", height)
