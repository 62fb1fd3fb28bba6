"""One page for many masks: their footprints on the whole map, and a list with links to the report of each."""

from __future__ import annotations

import html
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any
from urllib.parse import quote

import numpy as np

from roadgeo._text import counted, in_html
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.columns import attributes
from roadgeo.outputs.drawing.layers import Layer, Ring
from roadgeo.outputs.drawing.views import whole_map
from roadgeo.outputs.report.page import STATUS, name_owners, render_page, section
from roadgeo.outputs.report.viewer import draw_viewer
from roadgeo.outputs.wording import format_lonlat, write_sigma
from roadgeo.storage.files import write_text

__all__ = ["Entry", "render_batch", "write_batch"]

#: More masks are only counted: the page stays below 3 MB.
_MAX_LISTED = 3000

#: Size of a map, and its width: twice what it is first drawn for.
_OVERVIEW_BYTES, _OVERVIEW_PX = 200_000, 1800


@dataclass(frozen=True)
class Entry:
    """One mask of a batch.

    Attributes
    ----------
    document : mapping
        `Location.to_dict`, or what the command line prints of a mask that failed.
    link : str
        File name of its report beside the page; "" where it has none.
    """

    document: Mapping[str, Any]
    link: str = ""

    @property
    def path(self) -> PurePath:
        """Path of the mask, as it was given."""
        return PurePath(str(self.document["query"]))

    @property
    def status(self) -> str:
        """As in the document."""
        return str(self.document["status"])

    def wrap(self, content: str) -> str:
        """Make HTML a link to the report."""
        return f'<a href="{html.escape(quote(self.link))}">{content}</a>' if self.link else content


def write_batch(path: str | os.PathLike[str], entries: Sequence[Entry], indexes: Sequence[ReferenceIndex]) -> None:
    """Write `render_batch`, in one step.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    write_text(path, render_batch(entries, indexes))


def render_batch(entries: Sequence[Entry], indexes: Sequence[ReferenceIndex]) -> str:
    """Render what became of many masks as a whole HTML page.

    Parameters
    ----------
    indexes : sequence of ReferenceIndex
        The maps that were searched; those on which nothing was found are left out, but for the first.
    """
    counts = Counter(entry.status for entry in entries)
    states = ", ".join(f"{counts[status]} {words[2:]}" for status, words in STATUS.items() if counts[status])
    shown = entries[:_MAX_LISTED]
    left_out = len(entries) - len(shown)
    maps = [(index, [entry for entry in shown if entry.document.get("reference") == index.name]) for index in indexes]
    maps = [(index, placed) for i, (index, placed) in enumerate(maps) if i == 0 or any(map(_has_place, placed))]
    views = [_draw_map(index, placed) for index, placed in maps]
    others = [section(f"On {index.name}", view) for (index, _), view in zip(maps[1:], views[1:], strict=True)]
    note = f'<p class="faint">{left_out} more are not listed; all are in the tables beside this page.</p>'
    shared = Counter(entry.path.name for entry in shown)
    items = "".join(_item(entry, shared[entry.path.name] > 1) for entry in shown)
    listed = f'<ol class="list">{items}</ol>{note if left_out else ""}'
    credit = name_owners(index for index, _ in maps)
    return render_page(counted(len(entries), "image"), states, views[0], [section("Images", listed), *others], credit)


def _has_place(entry: Entry) -> bool:
    return bool(entry.document.get("footprint"))


def _draw_map(index: ReferenceIndex, entries: Sequence[Entry]) -> str:
    """Draw a whole map with the footprints that lie on it, each a link."""
    picture, window = whole_map(index, _OVERVIEW_BYTES, _OVERVIEW_PX)
    layers = [picture]
    for status in ("ambiguous", "chosen", "located"):
        there = [entry for entry in entries if entry.status == status and _has_place(entry)]
        rings = [
            Ring(window.place(np.array(entry.document["footprint"], float)), title=entry.path.name, link=entry.link)
            for entry in there
        ]
        layers.append(Layer(status, STATUS[status][2:], rings))
    return draw_viewer(f"The footprints on the map {index.name}", window, layers, name_owners([index]))


def _item(entry: Entry, with_folder: bool) -> str:
    name = "/".join(entry.path.parts[-2:]) if with_folder else entry.path.name
    document = entry.document
    center, sigma, odds = document.get("center"), document.get("corner_sigma_m"), document.get("log10_odds")
    parts = []
    if entry.status in ("located", "chosen") and center:
        parts.append(format_lonlat(center["lon"], center["lat"]))
        if sigma:
            parts.append(f"corners {write_sigma(max(sigma))}")
        if odds is not None:
            parts.append(f"score {odds:z.1f}")
    text = " · ".join(parts) or in_html(str(attributes(document)["reason"]))
    status = f'<span class="status {entry.status}">{STATUS[entry.status]}</span>'
    return f"<li>{entry.wrap(in_html(name or 'mask'))} {status}<br><small>{text}</small></li>"
