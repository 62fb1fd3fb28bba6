"""The names of the files of a result."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from roadgeo.outputs.registry import FOOTPRINT, GEOPACKAGE, JSON, Output

__all__ = ["OutputPaths", "output_paths"]


@dataclass(frozen=True)
class OutputPaths:
    """Paths of the files of one result; their names begin with `stem`."""

    folder: Path
    stem: str

    def of(self, output: Output, picture: str = "") -> Path:
        """Name the file of an output; `picture` is the name of the photograph's or the mask's own file."""
        return output.path(self.folder, self.stem, picture)

    @property
    def footprint(self) -> Path:
        """The picture or the mask on the map."""
        return self.of(FOOTPRINT)

    @property
    def geopackage(self) -> Path:
        """Footprint, matches and roads."""
        return self.of(GEOPACKAGE)

    @property
    def json(self) -> Path:
        """The `Location`."""
        return self.of(JSON)


def output_paths(folder: str | os.PathLike[str], stem: str) -> OutputPaths:
    """Name the outputs of the mask `stem` in a folder."""
    return OutputPaths(Path(folder), stem)
