"""Many masks: what to locate, under which names the results go, in one process or several, in input order."""

from __future__ import annotations

import glob
import hashlib
import multiprocessing
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

__all__ = ["Task", "Work", "find_masks", "name_tasks", "run"]

#: What a folder is searched for, and what in it are our own results.
SUFFIXES = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".jp2", ".bmp", ".pgm", ".webp", ".vrt", ".img", ".npy")
RESULTS = ("_footprint", "_overlay", "_figure", "_explain", "_image", "_vectorized")

Result = TypeVar("Result", covariant=True)


@dataclass(frozen=True)
class Task:
    """One mask, and the stem of its results' names."""

    mask: str
    stem: str


def find_masks(arguments: Sequence[str]) -> list[str]:
    """Expand folders (their images, not our own results) and patterns, which not every shell expands; keep the rest."""
    found: list[str] = []
    for argument in arguments:
        if Path(argument).is_dir():
            found += sorted(str(path) for path in Path(argument).iterdir() if _is_mask(path))
        elif glob.has_magic(argument) and not Path(argument).exists():
            found += sorted(glob.glob(argument, recursive=True)) or [argument]  # noqa: PTH207 (patterns may be absolute)
        else:
            found.append(argument)
    return found


def _is_mask(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.stem.endswith(RESULTS) and not path.name.startswith(".")


def name_tasks(masks: Sequence[str]) -> list[Task]:
    """Give each mask the stem of its own name; those that would share one get more of their path, until none does.

    So a stem depends on the other masks only where names meet, and then on the mask's path, not on the others' order.
    """
    known = [_stems(mask, n) for n, mask in enumerate(masks)]
    used = [0] * len(masks)
    while True:
        stems = [stems[level] for stems, level in zip(known, used, strict=True)]
        taken = Counter(stem.casefold() for stem in stems)  # one name to file systems that do not tell cases apart
        shared = [n for n, stem in enumerate(stems) if taken[stem.casefold()] > 1 and used[n] < len(known[n]) - 1]
        if not shared:
            return [Task(mask, stem) for mask, stem in zip(masks, stems, strict=True)]
        for n in shared:
            used[n] += 1


def _stems(mask: str, n: int) -> list[str]:
    """Return longer and longer stems for the n-th mask: its name, its folder, its format, its path, its number."""
    path = Path(mask).absolute()
    folder = f"{path.parent.name}_{path.stem}"
    format_ = f"{folder}_{path.suffix.lower().removeprefix('.')}"
    whole = f"{format_}_{hashlib.blake2b(os.fsencode(path), digest_size=4).hexdigest()}"
    return [path.stem, folder, format_, whole, f"{whole}_{n + 1}"]


class Work(Protocol[Result]):
    """What is done with each task; it travels to other processes, so it can be pickled."""

    def prepare(self) -> Callable[[Task], Result]:
        """Make a process ready (open the references) and return what does one task."""

    def give_up(self, task: Task, reason: str) -> Result:
        """Make the result of a task whose process died."""


def run(tasks: Sequence[Task], work: Work[Result], jobs: int) -> Iterator[Result]:
    """Do all tasks and yield their results in the order of the tasks, each as soon as it and those before it are there.

    A process that dies (out of memory, a crash in a library) costs one result, not the others.
    """
    if jobs == 1 or len(tasks) == 1:
        do = work.prepare()
        yield from map(do, tasks)
        return
    rest = list(tasks)
    while rest:
        done = 0
        try:
            for result in _run_together(rest, work, jobs):
                yield result
                done += 1
        except BrokenProcessPool:
            # Any of those then running may be to blame, so the first that has no result runs again, alone.
            suspect = rest[done]
            try:
                yield from _run_together([suspect], work, 1)
            except BrokenProcessPool:
                yield work.give_up(suspect, "the process that worked on it died (out of memory?)")
            done += 1
        rest = rest[done:]


def _run_together(tasks: Sequence[Task], work: Work[Result], jobs: int) -> Iterator[Result]:
    # A fork server loads the libraries once for all; where there is none each process starts afresh.
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    if method == "forkserver":
        context.set_forkserver_preload(["roadgeo.workflows", "roadgeo.outputs.location_files", "roadgeo.sources.masks"])
    workers = min(jobs, len(tasks))
    with ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(work,)) as pool:
        futures = [pool.submit(_do, task) for task in tasks]
        try:
            for future in futures:
                yield future.result()
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            pool.shutdown(cancel_futures=True)
            raise


_prepared: list[Callable[[Task], object]] = []


def _start_worker(work: Work[object]) -> None:
    """Make a worker ready. Ctrl-C is the parent's to handle: it ends the workers, which clean up as they go."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    _prepared.append(work.prepare())


def _do(task: Task) -> Any:
    try:
        return _prepared[0](task)
    except SystemExit as end:  # the task has cleaned up; the pool would take this for its result, and go on
        os._exit(int(end.code or 0))
