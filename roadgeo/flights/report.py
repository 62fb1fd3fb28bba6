"""A flight to look at in a browser: the map, the footprints one after another, and the pictures of the frames."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._text import in_html
from roadgeo.flights.rows import Row
from roadgeo.flights.tracker import Tracked
from roadgeo.geometry.mask import RoadMask
from roadgeo.outputs.drawing.layers import Layer, Lines, Ring
from roadgeo.outputs.drawing.svg import encode_picture, ring_data
from roadgeo.outputs.drawing.views import Window, map_layer, mask_picture
from roadgeo.outputs.report.page import name_owners, render_page, section
from roadgeo.outputs.report.viewer import draw_viewer
from roadgeo.outputs.wording import write_distance
from roadgeo.reference.reference import Reference

__all__ = ["Thumbnails", "render_flight"]

#: How much of the map lies around the flight, and the vertices that its roads may have.
_MARGIN, _VERTICES = 0.12, 40_000
_THUMBNAIL_PX, _THUMBNAIL_BYTES, _MOST_THUMBNAILS = 220, 4000, 400
_SIGNS = {"located": "◎", "tracked": "✓", "predicted": "≈", "lost": "✕"}
_COLORS = {"located": "good", "tracked": "frame", "predicted": "fair", "lost": "bad"}

_SCRIPT = """
(() => {
  const data = JSON.parse(document.getElementById("frames").textContent);
  const at = document.getElementById("at"), play = document.getElementById("play");
  const now = document.querySelector(".now path"), seen = document.getElementById("seen");
  const drawn = [...document.querySelectorAll("[data-number]")];
  let timer = 0;
  const show = (k) => {
    const frame = data.frames[k];
    at.value = k;
    now.setAttribute("d", frame.ring);
    now.style.fill = now.style.stroke = `var(--${data.colors[frame.status]})`;
    drawn.forEach((each) => { each.style.display = +each.dataset.number <= k ? "" : "none"; });
    seen.style.visibility = frame.image ? "" : "hidden";
    if (frame.image) seen.src = frame.image;
    seen.alt = "roads seen in " + frame.name;
    for (const key of ["name", "status", "when", "place", "sigma", "heading", "score", "reason"])
      document.getElementById("v-" + key).textContent = frame[key];
  };
  const stop = () => { clearInterval(timer); timer = 0; play.textContent = "▶ Play"; };
  play.onclick = () => {
    if (timer) { stop(); return; }
    if (+at.value >= data.frames.length - 1) show(0);
    play.textContent = "❚❚ Pause";
    timer = setInterval(() => {
      if (+at.value >= data.frames.length - 1) stop(); else show(+at.value + 1);
    }, 450);
  };
  at.oninput = () => { stop(); show(+at.value); };
  show(data.start);
})();
"""


@dataclass
class Thumbnails:
    """Small pictures of the frames, kept while the frames themselves go by."""

    kept: dict[int, str] = field(default_factory=dict)

    def add(self, number: int, mask: RoadMask) -> None:
        """Keep a picture of a mask, up to a number of frames."""
        if len(self.kept) < _MOST_THUMBNAILS:
            picture = mask_picture(mask, (255, 255, 255), _THUMBNAIL_PX)
            self.kept[number] = encode_picture(picture, _THUMBNAIL_BYTES, lossless=True)


def render_flight(
    title: str, tracked: Sequence[Tracked], rows: Sequence[Row], pictures: Mapping[int, str] | None = None
) -> str:
    """Render a flight as a whole HTML page that needs nothing else.

    Parameters
    ----------
    rows
        Rows of the same frames.
    pictures : mapping, optional
        Frame number to a picture as data (see `Thumbnails`).
    """
    counts = Counter(row.status for row in rows)
    states = ", ".join(f"{counts[status]} {status}" for status in _SIGNS if counts[status])
    text = f"{len(rows)} frames: {states}"
    reference = _usual_map(tracked)
    if reference is None:
        why = in_html(rows[-1].reason if rows else "no frames")
        return render_page(title, text, "", [f"<p>The flight was not located: {why}</p>"])
    # Footprints in metres from the corner of the map that is shown.
    maps = [frame.reference for frame in tracked]
    there = [k for k, on_map in enumerate(maps) if on_map is not None and on_map.name == reference.name]
    corners = {k: _corners(tracked[k]) for k in there}
    window = Window.around(np.concatenate(list(corners.values())), _MARGIN).no_longer_than(2.0)
    rings = {k: window.place(ring) for k, ring in corners.items()}
    layers = [map_layer(reference.index, window, window, _VERTICES)]
    for status in _SIGNS:
        marks = [Ring(ring, number=k) for k, ring in rings.items() if tracked[k].status == status]
        layers.append(Layer(status, status, marks))
    layers.append(Layer("way", "way", [Lines([np.array([ring.mean(axis=0) for ring in rings.values()])])]))
    layers.append(Layer("now", "", [Ring(next(iter(rings.values())))]))
    credit = name_owners([reference.index])
    view = draw_viewer("The flight on the map", window, layers, credit)
    values = _values(rows, rings, pictures or {})
    script = f'<script type="application/json" id="frames">{values}</script><script>{_SCRIPT}</script>'
    return render_page(title, text, view, [_player(rows), section("Frame", _card()), script], credit)


def _usual_map(tracked: Sequence[Tracked]) -> Reference | None:
    """Return the map that holds most of the frames; None where no frame has a place."""
    maps = [frame.reference for frame in tracked if frame.reference is not None]
    names = Counter(reference.name for reference in maps)
    usual = names.most_common(1)[0][0] if names else ""
    return next((reference for reference in maps if reference.name == usual), None)


def _corners(tracked: Tracked) -> FloatArray:
    """Return the footprint (4, 2) of a frame in the CRS of its map."""
    assert tracked.pose is not None  # noqa: S101 - only such frames are drawn
    assert tracked.reference is not None  # noqa: S101
    return tracked.reference.index.plane.to_crs(tracked.pose.corners)


def _player(rows: Sequence[Row]) -> str:
    """Return the player of the frames, and a strip of their statuses."""
    strip = "".join(f'<i style="background:var(--{_COLORS[row.status]})"></i>' for row in rows)
    key = "".join(f'<span style="color:var(--{_COLORS[name]})">{sign} {name} </span>' for name, sign in _SIGNS.items())
    return (
        f'<div class="player"><button id="play">▶ Play</button>'
        f'<input id="at" type="range" min="0" max="{len(rows) - 1}" value="0" aria-label="frame"></div>'
        f'<div class="strip">{strip}</div><p>{key}</p>'
    )


def _card() -> str:
    lines = {
        "name": "Name", "status": "Status", "when": "Time", "place": "Middle", "sigma": "Sigma",
        "heading": "Heading", "score": "Score", "reason": "Why",
    }  # fmt: skip
    cells = "".join(f'<tr><th scope="row">{label}</th><td id="v-{key}"></td></tr>' for key, label in lines.items())
    return f'<img class="seen" id="seen" alt=""><table class="numbers">{cells}</table>'


def _values(rows: Sequence[Row], rings: Mapping[int, FloatArray], pictures: Mapping[int, str]) -> str:
    """Return the data of each frame for the page's script, as JSON that may stand in HTML."""
    frames = [
        {
            "name": row.name,
            "status": row.status,
            "when": f"{row.time_s:.1f} s" if row.time is None else row.time.strftime("%Y-%m-%d %H:%M:%S UTC"),
            "place": "" if row.center is None else f"{row.center[1]:.6f}, {row.center[0]:.6f}",
            "sigma": "" if math.isnan(row.sigma_m) else write_distance(row.sigma_m),
            "heading": "" if math.isnan(row.heading_deg) else f"{round(row.heading_deg) % 360}°",
            "score": "" if math.isnan(row.log10_odds) else f"{row.log10_odds:.1f}",
            "reason": row.reason,
            "ring": ring_data(rings[k]) if k in rings else "",
            "image": pictures.get(row.number, ""),
        }
        for k, row in enumerate(rows)
    ]
    placed = [k for k, row in enumerate(rows) if row.center is not None]
    text = json.dumps({"frames": frames, "colors": _COLORS, "start": placed[-1] if placed else 0})
    return text.replace("<", "\\u003c")
