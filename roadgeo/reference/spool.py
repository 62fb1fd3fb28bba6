"""Road lines on disk with a spatial index: written as they come from sources of any size, read for any box.

Each part that comes is a FlatGeobuf file, which GDAL reads by place; `number` keeps the order of its lines.
"""

from __future__ import annotations

import errno
import warnings
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray

__all__ = ["Bounds", "Cell", "Spool"]

#: Column and row.
Cell: TypeAlias = tuple[int, int]

#: x0, y0, x1, y1 in units of the spool's CRS.
Bounds: TypeAlias = tuple[float, float, float, float]

_FIELDS = ["number", "name", "kind"]

#: Lines that reach over more cells are long, or astride 180 degrees: they are found where their vertices lie.
_MOST_CELLS = 64


class Spool:
    """Lines in a folder; one process writes, then any may read.

    Attributes
    ----------
    size : float
        Side of the cells that roads are counted in.
    n_segments : dict of cell to int
        Straight pieces of lines that begin there: the amount of roads.
    """

    def __init__(self, folder: Path, size: float) -> None:
        """Use a folder, which must exist before anything is stored."""
        self.folder, self.size = folder, size
        self.n_segments: dict[Cell, int] = defaultdict(int)

    def add(self, lines: AnyArray, labels: AnyArray) -> None:
        """Store (L,) LineStrings, and the name and kind of each, (L, 2) text.

        Raises
        ------
        OSError
            They cannot be written.
        """
        import pyogrio
        import shapely

        if not len(lines):
            return
        coords, owner = shapely.get_coordinates(lines, return_index=True)
        begins = np.floor(coords[np.flatnonzero(owner[1:] == owner[:-1])] / self.size).astype(np.int64)
        for (x, y), n in zip(*np.unique(begins, axis=0, return_counts=True), strict=True):
            self.n_segments[int(x), int(y)] += int(n)
        columns, target = [np.arange(len(lines)), *labels.T], self.folder / f"{len(self._parts()):06}.fgb"
        form = {"driver": "FlatGeobuf", "geometry_type": "LineString", "crs": None}
        try:
            with warnings.catch_warnings(action="ignore", category=UserWarning):  # that it has no CRS
                pyogrio.raw.write(target, shapely.to_wkb(lines), columns, fields=_FIELDS, **form)
        except pyogrio.errors.DataSourceError as error:
            raise OSError(errno.ENOSPC, str(error)) from error

    def read(self, box: Bounds) -> tuple[AnyArray, AnyArray]:
        """Return the lines that touch a box, cut at its border, in the order in which they came, and their labels."""
        import shapely

        from roadgeo.sources.lines import simple_lines

        lines, labels = self._join(lambda _: True, box)
        reach = shapely.bounds(lines)
        far = (reach[:, 2:] - reach[:, :2] > _MOST_CELLS * self.size).any(axis=1)
        coords, line = shapely.get_coordinates(lines, return_index=True)
        inside = ((coords >= box[:2]) & (coords <= box[2:])).all(axis=1)
        kept = ~far | np.isin(np.arange(len(lines)), line[inside])
        cut, place = simple_lines(shapely.clip_by_rect(lines[kept], *box))
        return cut, labels[kept][place]

    def choose(self, wanted: Callable[[AnyArray], BoolArray]) -> tuple[AnyArray, AnyArray]:
        """Return the lines whose labels (L, 2) are wanted, in the order in which they came, and their labels.

        Only they, and one part, are held in memory.
        """
        return self._join(wanted)

    def _join(
        self, wanted: Callable[[AnyArray], BoolArray | bool], box: Bounds | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """Return the wanted lines of all parts that a box touches, and their labels."""
        import pyogrio
        import shapely

        lines, texts = [np.empty(0, object)], [np.empty((0, 2), object)]
        for part in self._parts():
            _, _, shapes, (number, *columns) = pyogrio.raw.read(part, bbox=box)
            order = np.argsort(number)
            labels = np.stack(columns, axis=1)[order]
            keep = np.flatnonzero(np.broadcast_to(wanted(labels), len(labels)))
            lines.append(shapely.from_wkb(shapes[order[keep]]))
            texts.append(labels[keep])
        return np.concatenate(lines), np.concatenate(texts)

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob("*.fgb"))
