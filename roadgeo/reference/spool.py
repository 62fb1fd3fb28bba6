"""Road lines on disk by cells of a grid: written as they come from sources of any size, read for any box.

A cell has one file, a row of blocks: number of lines, of coordinates and of bytes of text, the lines' numbers, how many
coordinates each has, those, and the name and kind of each as JSON. A line is stored in every cell that it
touches, and read once.
"""

from __future__ import annotations

import json
import math
import struct
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray, IntArray

__all__ = ["Bounds", "Cell", "Spool"]

#: Column and row.
Cell: TypeAlias = tuple[int, int]

#: x0, y0, x1, y1 in units of the spool's CRS.
Bounds: TypeAlias = tuple[float, float, float, float]

#: Numbers, lengths, (C, 2) coordinates, (L, 2) labels.
_Block: TypeAlias = tuple[IntArray, IntArray, FloatArray, AnyArray]

_HEADER = struct.Struct("<QQQ")

#: Lines whose bounds touch more cells are long, or astride 180 degrees: they are stored where their vertices lie.
_MOST_CELLS = 64


class Spool:
    """Lines in a folder, by square cells of `size`; one process writes, then any may read.

    Attributes
    ----------
    n_segments : dict of cell to int
        Straight pieces of lines that begin there: the amount of roads.
    """

    def __init__(self, folder: Path, size: float) -> None:
        """Use a folder, which must exist."""
        self.folder, self.size = folder, size
        self.n_lines = 0
        self.n_segments: dict[Cell, int] = defaultdict(int)

    def add(self, lines: AnyArray, labels: AnyArray | None = None) -> None:
        """Store (L,) LineStrings, and the name and kind of each, (L, 2) text, as far as they are known."""
        import shapely

        if not len(lines):
            return
        coords, owner = shapely.get_coordinates(lines, return_index=True)
        starts = np.searchsorted(owner, np.arange(len(lines) + 1))
        row, cells = self._cells_of(shapely.bounds(lines), coords, owner)
        begins = np.floor(coords[np.flatnonzero(owner[1:] == owner[:-1])] / self.size).astype(np.int64)
        for (x, y), n in zip(*np.unique(begins, axis=0, return_counts=True), strict=True):
            self.n_segments[int(x), int(y)] += int(n)
        order = np.lexsort((row, cells[:, 1], cells[:, 0]))
        row, cells = row[order], cells[order]
        cuts = np.flatnonzero((cells[1:] != cells[:-1]).any(axis=1)) + 1
        for members, cell in zip(np.split(row, cuts), cells[np.concatenate(([0], cuts))], strict=True):
            self._append((int(cell[0]), int(cell[1])), np.unique(members), (coords, starts), labels)
        self.n_lines += len(lines)

    def _cells_of(self, bounds: FloatArray, coords: FloatArray, owner: IntArray) -> tuple[IntArray, IntArray]:
        """Return pairs of a line and a cell that it may touch: (P,) rows and (P, 2) cells."""
        low = np.floor(bounds[:, :2] / self.size).astype(np.int64)
        sides = np.floor(bounds[:, 2:] / self.size).astype(np.int64) - low + 1
        n = sides.prod(axis=1)
        short = n <= _MOST_CELLS
        row = np.repeat(np.flatnonzero(short), n[short])
        k = np.arange(len(row)) - np.repeat(np.cumsum(n[short]) - n[short], n[short])
        cells = low[row] + np.stack([k % sides[row, 0], k // sides[row, 0]], axis=1)
        own = ~short[owner]
        return (
            np.concatenate([row, owner[own]]),
            np.concatenate([cells, np.floor(coords[own] / self.size).astype(np.int64)]),
        )

    def _append(
        self, cell: Cell, members: IntArray, drawn: tuple[FloatArray, IntArray], labels: AnyArray | None
    ) -> None:
        """Add a block to the file of a cell; `drawn` = coordinates of all lines, and where each line's start."""
        coords, starts = drawn
        lengths = starts[members + 1] - starts[members]
        first = np.repeat(starts[members] - np.cumsum(lengths) + lengths, lengths)
        taken = coords[first + np.arange(len(first))]
        with self._path(cell).open("ab") as file:
            text = b"" if labels is None else json.dumps(labels[members].tolist()).encode()
            file.write(_HEADER.pack(len(members), len(taken), len(text)))
            file.write((members + self.n_lines).astype("<u8").tobytes())
            file.write(lengths.astype("<u4").tobytes())
            file.write(taken.astype("<f8").tobytes())
            file.write(text)

    def read(self, box: Bounds) -> tuple[AnyArray, AnyArray]:
        """Return the lines that touch a box, cut at its border, in the order in which they came, and their labels."""
        import shapely

        from roadgeo.sources.lines import simple_lines

        x0, y0, x1, y1 = (math.floor(side / self.size) for side in box)
        near = sorted((x, y) for x, y in self.cells() if x0 <= x <= x1 and y0 <= y <= y1)
        lines, labels = _join([block for cell in near for block in _read_blocks(self._path(cell))])
        cut, place = simple_lines(shapely.clip_by_rect(lines, *box))
        return cut, labels[place]

    def choose(self, wanted: Callable[[AnyArray], BoolArray]) -> tuple[AnyArray, AnyArray]:
        """Return the lines whose labels (L, 2) are wanted, in the order in which they came, and their labels.

        Only they are held in memory.
        """
        blocks = []
        for cell in sorted(self.cells()):
            for numbers, lengths, coords, labels in _read_blocks(self._path(cell)):
                keep = wanted(labels)
                blocks.append((numbers[keep], lengths[keep], coords[np.repeat(keep, lengths)], labels[keep]))
        return _join(blocks)

    def cells(self) -> list[Cell]:
        """Return the cells that hold something."""
        names = (path.stem.split("_") for path in self.folder.glob("*.lines"))
        return [(int(x), int(y)) for x, y in names]

    def _path(self, cell: Cell) -> Path:
        return self.folder / f"{cell[0]}_{cell[1]}.lines"


def _join(blocks: Sequence[_Block]) -> tuple[AnyArray, AnyArray]:
    """Return the lines of blocks, each once, in the order in which they came, and their labels."""
    import shapely

    if not blocks:
        return np.empty(0, object), np.empty((0, 2), object)
    numbers, lengths, coords, labels = (np.concatenate(column) for column in zip(*blocks, strict=True))
    lines = shapely.linestrings(coords, indices=np.repeat(np.arange(len(lengths)), lengths))
    _, chosen = np.unique(numbers, return_index=True)
    return lines[chosen], labels[chosen]


def _read_blocks(path: Path) -> list[_Block]:
    """Return the blocks of a cell."""
    if not path.is_file():
        return []
    data, at, blocks = path.read_bytes(), 0, []
    while at < len(data):
        n, m, size = _HEADER.unpack_from(data, at)
        at += _HEADER.size
        numbers = np.frombuffer(data, "<u8", n, at).astype(np.int64)
        lengths = np.frombuffer(data, "<u4", n, at + 8 * n).astype(np.int64)
        coords = np.frombuffer(data, "<f8", 2 * m, at + 12 * n).reshape(m, 2)
        at += 12 * n + 16 * m
        labels = np.full((n, 2), "", object)
        if size:
            labels[:] = json.loads(data[at : at + size])
        at += size
        blocks.append((numbers, lengths, coords, labels))
    return blocks
