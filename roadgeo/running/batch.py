"""Many masks, in one process or several: each is located, in input order.

`locate_masks` runs `roadgeo locate`. No fault of one mask stops the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roadgeo._progress import Say, say_nothing
from roadgeo.outputs.registry import REPORT
from roadgeo.running.locating import Locating, Outcome
from roadgeo.running.options import BatchOptions
from roadgeo.running.processes import run
from roadgeo.running.tasks import Task

if TYPE_CHECKING:
    from roadgeo.reference.opening import AnyReference
    from roadgeo.running.cluster import Cluster

__all__ = ["locate_masks", "write_overview"]


def locate_masks(
    tasks: Sequence[Task],
    references: Sequence[str] = (),
    out_dir: str | Path = ".",
    options: BatchOptions | None = None,
    *,
    jobs: int = 1,
    cluster: Cluster | None = None,
    say: Say = say_nothing,
) -> Iterator[Outcome]:
    """Locate masks and write their results; yield the outcome of each in the order of the tasks.

    No fault of one mask stops the others: its status is "error".

    Parameters
    ----------
    references : sequence of str
        Paths, or names in the library; none: all of the library.
    jobs : int
        Processes; the results do not depend on it. In a script, several need `if __name__ == "__main__":` around the
        call, for each of them imports the script.
    cluster : Cluster, optional
        Where it is done instead; the results do not depend on that either.
    say
        Called with the share of a photograph whose roads are found; not in other processes.

    Raises
    ------
    IndexFormatError
        A reference is missing or unusable.
    """
    if cluster is not None:
        references = _named_for_workers(references)
    heard = say if cluster is None and (jobs == 1 or len(tasks) == 1) else say_nothing
    work = Locating(tuple(references), str(out_dir), options or BatchOptions(), heard)
    if cluster is None:
        return run(tasks, work, jobs)
    if cluster.divide_map:
        from roadgeo.running.divided import run_divided

        return run_divided(tasks, work, cluster)
    return cluster.run(tasks, work)


def _named_for_workers(names: Sequence[str]) -> list[str]:
    """Name references by their paths, for workers may have another library; each host fetches those at a URL."""
    from roadgeo.reference.library import resolve_references
    from roadgeo.reference.remote import is_remote

    if not names:
        return [str(path.absolute()) for path in resolve_references(names)]
    return [name if is_remote(name) else str(resolve_references([name])[0].absolute()) for name in names]


# --- all of them ------------------------------------------------------------------------------------------------------


def write_overview(
    out_dir: str | Path,
    tasks: Sequence[Task],
    outcomes: Sequence[Outcome],
    references: Sequence[AnyReference] | None,
) -> list[Path]:
    """Write all footprints in one GeoPackage and one table, and where references are given a page of all reports.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    from roadgeo.outputs.summary import write_summary

    folder, documents = Path(out_dir), [outcome.document for outcome in outcomes]
    files = write_summary(folder, documents)
    if references is not None:
        from roadgeo.outputs.report import Entry, write_batch

        reports = [REPORT.path(folder, task.stem) for task in tasks]
        there = [path.exists() and outcome.status != "error" for path, outcome in zip(reports, outcomes, strict=True)]
        links = [path.name if here else "" for path, here in zip(reports, there, strict=True)]
        files.append(folder / "roadgeo_report.html")
        indexes = [
            index for reference in references for index in reference.indexes_at(_places_on(reference.name, documents))
        ]
        write_batch(files[-1], list(map(Entry, documents, links)), indexes)
    return files


def _places_on(name: str, documents: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """Return longitude and latitude of a place on a reference."""
    centers = [
        document["center"] for document in documents if document.get("center") and document.get("reference") == name
    ]
    return [(center["lon"], center["lat"]) for center in centers]
