"""Running a locator over a query set: in this process or in several, and on where an interrupted run left off."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.errors import MaskError, OutputError
from roadgeo.evaluation.landscape import Landscape
from roadgeo.evaluation.simulation import SimulationOptions, simulate_query
from roadgeo.evaluation.truth import Truth, truth_from_record, truth_to_record
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.projection import to_plane
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.running.pool import Lost
from roadgeo.running.processes import run
from roadgeo.storage.files import write_text, writing
from roadgeo.workflows import LocateOptions, locate

__all__ = [
    "DrawnMasks",
    "Locator",
    "Mask",
    "MaskFiles",
    "QuerySet",
    "ReferenceLocator",
    "Trial",
    "count_elsewhere",
    "read_landscape",
    "run_trials",
]

SCHEMA = "roadgeo.trials/1"

#: A mask, or the path of one.
Mask: TypeAlias = AnyArray | str

#: Result of a trial: `Location.to_dict`.
Answer: TypeAlias = dict[str, Any]


class QuerySet(Protocol):
    """Masks with truth. It is sent to other processes, so it holds paths and options; each process opens it once."""

    def __len__(self) -> int:
        """How many queries there are."""

    def open(self) -> Callable[[int], tuple[Truth, Mask]]:
        """Read what is needed and return the function that gives the k-th query."""


class Locator(Protocol):
    """A way of locating masks, sent to other processes like a `QuerySet`."""

    def open(self) -> Callable[[Mask], Answer]:
        """Open the references and return the function that locates a mask."""


@dataclass(frozen=True)
class MaskFiles:
    """Masks in a folder."""

    folder: Path
    truths: tuple[Truth, ...]

    def __len__(self) -> int:
        """How many masks there are."""
        return len(self.truths)

    def open(self) -> Callable[[int], tuple[Truth, Mask]]:
        """Return the function that names the k-th file."""
        return lambda k: (self.truths[k], str(self.folder / self.truths[k].file))


def count_elsewhere(truths: Sequence[Truth], reference: Path) -> int:
    """Count masks whose place lies beyond the bounds of a reference, although their truth claims otherwise."""
    network = read_network(reference)
    low, high = network.graph.coords.min(axis=0), network.graph.coords.max(axis=0)
    placed = [truth for truth in truths if truth.on_map]
    centers = [truth.places(Frame(*truth.size).center, network.plane.crs) for truth in placed]
    xy = network.plane.from_crs(np.reshape(centers, (-1, 2)))
    return int((~((xy >= low) & (xy <= high)).all(axis=1)).sum())


def read_landscape(geopackage: Path, roads: Path | None = None) -> Landscape:
    """Read the roads to draw masks from: a reference's own, or a file's, where the reference covers them.

    Raises
    ------
    IndexFormatError, RoadSourceError, CrsError
        The reference or the file cannot be read.
    """
    network = read_network(geopackage)
    if roads is None:
        return Landscape.from_network(network)
    from roadgeo.sources.roads import read_roads

    roads_read = read_roads(roads)
    rings = (to_plane(network.plane.crs, roads_read.plane, network.plane.to_crs(ring)) for ring in network.coverage)
    return Landscape.from_lines(roads_read.lines, roads_read.plane, tuple(rings))


@dataclass(frozen=True)
class DrawnMasks:
    """Masks drawn when they are needed.

    Attributes
    ----------
    geopackage : Path
        `REF.gpkg`.
    sets : tuple of (SimulationOptions, int)
        Options and number of queries, set by set.
    roads : Path, optional
        Roads to draw instead of the reference's own.
    centers : tuple of (float, float)
        Middles of the frames, metres on the reference's plane; without them masks lie anywhere.
    first : int
        Number of the first query: others draw other noise.
    """

    geopackage: Path
    sets: tuple[tuple[SimulationOptions, int], ...]
    roads: Path | None = None
    centers: tuple[tuple[float, float], ...] = ()
    first: int = 0

    def __len__(self) -> int:
        """How many queries there are."""
        return sum(count for _, count in self.sets)

    def open(self) -> Callable[[int], tuple[Truth, Mask]]:
        """Read the roads and return the function that draws the k-th query."""
        landscape = read_landscape(self.geopackage, self.roads)
        numbered = [(options, k) for options, count in self.sets for k in range(count)]

        def draw(k: int) -> tuple[Truth, Mask]:
            options, number = numbered[k]
            center = self.centers[number] if self.centers else None
            query = simulate_query(landscape, options, self.first + number, center)
            return query.truth, query.mask

        return draw


@dataclass(frozen=True)
class ReferenceLocator:
    """`roadgeo.locate` on one or more references; a mask that it cannot use counts as not located."""

    references: tuple[Path, ...]
    options: LocateOptions = field(default_factory=LocateOptions)

    def open(self) -> Callable[[Mask], Answer]:
        """Open the references."""
        references = [open_reference(path) for path in self.references]

        def answer(mask: Mask) -> Answer:
            try:
                return locate(mask, references, self.options).to_dict()
            except MaskError as error:
                return {"status": "not_located", "reason": str(error)}

        return answer


@dataclass(frozen=True)
class Trial:
    """The truth and the answer of one query."""

    truth: Truth
    answer: Answer

    @property
    def status(self) -> str:
        """Status in the answer, in words."""
        return str(self.answer["status"]).replace("_", " ")


def run_trials(
    queries: QuerySet,
    locator: Locator,
    jobs: int = 1,
    record: Path | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> list[Trial]:
    """Locate every query.

    Parameters
    ----------
    jobs : int
        Processes. The answers do not depend on it, but for the times in them.
    record : Path, optional
        JSON lines file that gets every trial as it ends. Trials that it holds already, from a run with the same
        settings, are not repeated.
    settings : mapping, optional
        Plain values that identify this run.
    progress : callable, optional
        Called with the status in every answer, the recorded ones too, in order.

    Raises
    ------
    OutputError
        The record cannot be written, or belongs to a run with other settings.
    """
    done = [] if record is None else _read_record(record, dict(settings or {}))
    for trial in done:
        progress(trial.status)
    pending = range(len(done), len(queries))
    for trial in run(pending, _Trying(queries, locator), jobs) if pending else ():
        if record is not None:
            _append(record, trial)
        done.append(trial)
        progress(trial.status)
    return done


# --- running ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Trying:
    """The work done for each query; travels to other processes."""

    queries: QuerySet
    locator: Locator

    def prepare(self) -> Callable[[int], Trial]:
        """Open what a process needs, once."""
        draw, locate = self.queries.open(), self.locator.open()

        def attempt(k: int) -> Trial:
            truth, mask = draw(k)
            return Trial(truth, locate(mask))

        return attempt

    def give_up(self, task: int, lost: Lost) -> Trial:
        """Count a query whose process died as not located."""
        truth, _ = self.queries.open()(task)
        return Trial(truth, {"status": "not_located", "reason": lost.said})


# --- the record -------------------------------------------------------------------------------------------------------


def _read_record(path: Path, settings: dict[str, Any]) -> list[Trial]:
    """Read the trials of an earlier run, or start a record; a line that was cut off is dropped."""
    head = json.dumps({"schema": SCHEMA, "settings": settings}, sort_keys=True)
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    if lines and lines[0] != head:
        raise OutputError(
            f"{path} holds trials of another run; choose another folder, or delete the file to begin anew"
        )
    trials, kept = [], [head]
    for line in lines[1:]:
        try:
            entry = json.loads(line)
        except ValueError:
            break
        trials.append(Trial(truth_from_record(entry["truth"]), entry["answer"]))
        kept.append(line)
    write_text(path, "\n".join(kept) + "\n")
    return trials


def _append(path: Path, trial: Trial) -> None:
    line = json.dumps({"truth": truth_to_record(trial.truth), "answer": trial.answer})
    with writing(path), path.open("a", encoding="utf-8") as file:
        file.write(line + "\n")
