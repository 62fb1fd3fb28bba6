"""A flight to look at in a browser: the map, the footprints one after another, and the pictures of the frames."""

from __future__ import annotations

import base64
import html
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.flights.rows import Row
from roadgeo.flights.tracker import Tracked
from roadgeo.geometry.mask import RoadMask
from roadgeo.outputs.report.page import footer, render_page, section
from roadgeo.outputs.report.svg import draw_lines, join_segments, thin_lines

__all__ = ["Thumbnails", "render_flight"]

#: Width of the map in SVG units, how much of it lies around the flight, and the vertices its roads may have.
_WIDTH, _MARGIN, _VERTICES = 1000.0, 0.12, 40_000
_THUMBNAIL, _MOST_THUMBNAILS = 220, 400
_COLORS = {"located": "#1b7f4d", "tracked": "#2a6fbb", "predicted": "#c77c11", "lost": "#b3261e"}
_SIGNS = {"located": "◎", "tracked": "✓", "predicted": "≈", "lost": "✕"}

_STYLE = """
.flight { display: grid; grid-template-columns: minmax(0, 3fr) minmax(16rem, 1fr); gap: 1rem; padding: 1rem }
.flight svg { width: 100%; height: auto; max-height: 80vh; background: #fbfaf7; border: 1px solid #ddd }
.flight .roads path { stroke: #a79f90; stroke-width: 1.5; fill: none; vector-effect: non-scaling-stroke }
.flight .done polygon { fill: none; stroke-width: 1; opacity: .35 }
.flight .way { fill: none; stroke: #333; stroke-width: 1.6; stroke-dasharray: 5 3 }
.flight .now { fill-opacity: .22; stroke-width: 3 }
.flight .seen { image-rendering: auto; width: 100%; background: #111; border-radius: 4px }
.flight .bar { display: flex; gap: .6rem; align-items: center; margin: .6rem 0 }
.flight .bar input { flex: 1 }
.flight .strip { display: flex; height: 12px; border-radius: 3px; overflow: hidden }
.flight .strip i { flex: 1 }
.flight td, .flight th { text-align: left; vertical-align: top; padding: .1rem .6rem .1rem 0 }
.flight .key span { white-space: nowrap; margin-right: .8rem }
@media (max-width: 50rem) { .flight { grid-template-columns: 1fr } }
"""

_SCRIPT = """
(() => {
  const data = JSON.parse(document.getElementById("frames").textContent);
  const at = document.getElementById("at"), play = document.getElementById("play");
  const now = document.getElementById("now"), seen = document.getElementById("seen");
  const drawn = [...document.querySelectorAll(".done polygon")];
  let timer = 0;
  const show = (k) => {
    const one = data.frames[k];
    at.value = k;
    now.setAttribute("points", one.points || "");
    now.style.fill = now.style.stroke = data.colors[one.status];
    drawn.forEach((each) => { each.style.display = +each.dataset.k <= k ? "" : "none"; });
    if (one.image) { seen.src = one.image; seen.style.visibility = ""; } else { seen.style.visibility = "hidden"; }
    seen.alt = "roads seen in " + one.name;
    for (const key of ["name", "status", "when", "place", "sigma", "heading", "odds", "reason"]) {
      document.getElementById("v-" + key).textContent = one[key];
    }
    document.getElementById("v-status").style.color = data.colors[one.status];
  };
  const stop = () => { clearInterval(timer); timer = 0; play.textContent = "▶ Play"; };
  play.onclick = () => {
    if (timer) { stop(); return; }
    if (+at.value >= data.frames.length - 1) { show(0); }
    play.textContent = "❚❚ Pause";
    timer = setInterval(() => {
      if (+at.value >= data.frames.length - 1) { stop(); } else { show(+at.value + 1); }
    }, 450);
  };
  at.oninput = () => { stop(); show(+at.value); };
  show(data.start);
})();
"""


class Thumbnails:
    """Small pictures of the frames, kept while the frames themselves go by."""

    def __init__(self) -> None:
        self.kept: dict[int, str] = {}

    def add(self, number: int, mask: RoadMask) -> None:
        """Keep a picture of a mask, up to a number of frames."""
        if len(self.kept) >= _MOST_THUMBNAILS:
            return
        height, width = mask.shape
        scale = min(1.0, _THUMBNAIL / max(height, width))
        grey: AnyArray = mask.roads.view(np.uint8) * np.uint8(255)
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        encoded = cv2.imencode(".webp", small, [cv2.IMWRITE_WEBP_QUALITY, 60])[1]
        self.kept[number] = f"data:image/webp;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def render_flight(
    title: str, tracked: Sequence[Tracked], rows: Sequence[Row], pictures: Mapping[int, str] | None = None
) -> str:
    """Render a flight as a whole HTML page that needs nothing else.

    Parameters
    ----------
    rows
        Of the same frames.
    pictures : mapping, optional
        Of frame number to a picture as data (see `Thumbnails`).
    """
    counts = Counter(row.status for row in rows)
    told = ", ".join(f"{counts[status]} {status}" for status in _COLORS if counts[status])
    header = f"<h1>{html.escape(title)}</h1><p>{len(rows)} frames: {told}</p><style>{_STYLE}</style>"
    drawing = _Drawing.of(tracked)
    if drawing is None:
        why = rows[-1].reason if rows else "no frames"
        return render_page(title, header, f"<main><p>The flight was not located: {html.escape(why)}</p></main>")
    values = _values(tracked, rows, drawing, pictures or {})
    owed = tracked[drawing.number].reference
    attribution = "" if owed is None else str(owed.index.meta.get("attribution") or "")
    body = (
        f'<main class="flight"><div>{drawing.svg(tracked)}{_bar(rows)}</div>'
        f"<aside>{section('Frame', _card())}{footer(attribution)}</aside></main>"
        f'<script type="application/json" id="frames">{values}</script><script>{_SCRIPT}</script>'
    )
    return render_page(title, header, body)


class _Drawing:
    """The map around the frames of one reference, the one that holds most of them; in SVG units, y down."""

    def __init__(self, number: int, low: FloatArray, high: FloatArray, segments: FloatArray) -> None:
        self.number, self.low, self.high = number, low, high
        self.scale = _WIDTH / float(high[0] - low[0])
        self.segments = segments

    @classmethod
    def of(cls, tracked: Sequence[Tracked]) -> _Drawing | None:
        """Return the map to draw; None where no frame has a place."""
        names = Counter(one.reference.name for one in tracked if one.reference is not None)
        if not names:
            return None
        usual = names.most_common(1)[0][0]
        shown = [k for k, one in enumerate(tracked) if one.reference is not None and one.reference.name == usual]
        reference = tracked[shown[0]].reference
        corners = np.concatenate([tracked[k].pose.corners for k in shown])  # type: ignore[union-attr]
        low, high = corners.min(axis=0), corners.max(axis=0)
        margin = _MARGIN * float((high - low).max())
        sides = np.maximum(high - low, 0.5 * float((high - low).max()))
        middle = (low + high) / 2.0
        low, high = middle - sides / 2.0 - margin, middle + sides / 2.0 + margin
        segments = reference.index.segments.astype(np.float64).reshape(-1, 2, 2)  # type: ignore[union-attr]
        inside = ((segments.max(axis=1) > low) & (segments.min(axis=1) < high)).all(axis=1)
        return cls(shown[0], low, high, segments[inside])

    def place(self, xy: FloatArray) -> FloatArray:
        """Take (..., 2) plane metres to the drawing."""
        return np.asarray((xy - (self.low[0], self.high[1])) * (self.scale, -self.scale))

    def svg(self, tracked: Sequence[Tracked]) -> str:
        """Draw roads, all footprints, the way, and the frame that is shown."""
        height = _WIDTH * float((self.high - self.low)[1] / (self.high - self.low)[0])
        lines = thin_lines([self.place(line) for line in join_segments(self.segments)], _VERTICES, 0.3)
        placed = [(k, one) for k, one in enumerate(tracked) if one.pose is not None and self._is_near(one)]
        done = "".join(
            f'<polygon data-k="{k}" points="{self.points(one)}" style="stroke:{_COLORS[one.status]}"/>'
            for k, one in placed
        )
        way = " ".join(_pair(self.place(one.pose.center)) for _, one in placed if one.pose is not None)
        metres = 10.0 ** math.floor(math.log10(0.3 * float((self.high - self.low)[0])))
        bar = metres * self.scale
        return (
            f'<svg viewBox="0 0 {_WIDTH:.0f} {height:.0f}" role="img" aria-label="the flight on the map">'
            f'<g class="roads">{draw_lines(lines)}</g><g class="done">{done}</g>'
            f'<polyline class="way" points="{way}"/><polygon class="now" id="now"/>'
            f'<g transform="translate(20 {height - 20:.0f})"><path d="M0 0h{bar:.1f}" stroke="#000" stroke-width="3"/>'
            f'<text y="-8" font-size="18">{metres:g} m</text></g></svg>'
        )

    def points(self, one: Tracked) -> str:
        """Return the footprint of a frame as the points of a polygon."""
        return "" if one.pose is None else " ".join(_pair(corner) for corner in self.place(one.pose.corners))

    def _is_near(self, one: Tracked) -> bool:
        corners = one.pose.corners if one.pose is not None else np.full((4, 2), np.nan)
        return bool(((corners > self.low) & (corners < self.high)).all())


def _pair(xy: FloatArray) -> str:
    return f"{xy[0]:.1f},{xy[1]:.1f}"


def _bar(rows: Sequence[Row]) -> str:
    """Return the player of the frames, and a strip of their statuses."""
    strip = "".join(f'<i style="background:{_COLORS[row.status]}" title="{html.escape(row.name)}"></i>' for row in rows)
    key = "".join(f'<span style="color:{color}">{_SIGNS[name]} {name}</span>' for name, color in _COLORS.items())
    return (
        f'<div class="bar"><button id="play">▶ Play</button>'
        f'<input id="at" type="range" min="0" max="{len(rows) - 1}" value="0" aria-label="frame"></div>'
        f'<div class="strip">{strip}</div><p class="key">{key}</p>'
    )


def _card() -> str:
    lines = {
        "name": "name", "status": "status", "when": "time", "place": "centre", "sigma": "sigma",
        "heading": "heading", "odds": "log10 odds", "reason": "why",
    }  # fmt: skip
    cells = "".join(f'<tr><th>{said}</th><td id="v-{key}"></td></tr>' for key, said in lines.items())
    return f'<img class="seen" id="seen" alt=""><table>{cells}</table>'


def _values(tracked: Sequence[Tracked], rows: Sequence[Row], drawing: _Drawing, pictures: Mapping[int, str]) -> str:
    """Return the data of each frame for the page's script, as JSON that may stand in HTML."""
    frames = [
        {
            "name": row.name,
            "status": row.status,
            "when": f"{row.time_s:.1f} s" if row.time is None else row.time.strftime("%Y-%m-%d %H:%M:%S UTC"),
            "place": "" if row.center is None else f"{row.center[1]:.6f}, {row.center[0]:.6f}",
            "sigma": "" if math.isnan(row.sigma_m) else f"{row.sigma_m:.1f} m",
            "heading": "" if math.isnan(row.heading_deg) else f"{row.heading_deg:.0f}°",
            "odds": "" if math.isnan(row.log10_odds) else f"{row.log10_odds:.1f}",
            "reason": row.reason,
            "points": drawing.points(one),
            "image": pictures.get(row.number, ""),
        }
        for one, row in zip(tracked, rows, strict=True)
    ]
    known = [k for k, row in enumerate(rows) if row.center is not None]
    text = json.dumps({"frames": frames, "colors": _COLORS, "start": known[-1] if known else 0})
    return text.replace("<", "\\u003c")
