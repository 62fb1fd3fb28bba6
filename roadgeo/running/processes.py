"""Many tasks in one process or several: results in the order of the tasks; a process that dies costs one of them."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeVar

from roadgeo.errors import RoadgeoError
from roadgeo.storage.files import remove_own

__all__ = ["Work", "end_with_parent", "outlive", "run", "without_interrupts"]

Task = TypeVar("Task")
TaskIn = TypeVar("TaskIn", contravariant=True)
Result = TypeVar("Result")
ResultOut = TypeVar("ResultOut", covariant=True)

#: Modules that nearly every task needs: a fork server loads them once for all processes.
_PRELOAD = ["roadgeo.workflows", "roadgeo.outputs.location_files", "roadgeo.sources.masks"]


#: Time in which a process whose parent is gone removes half-written files.
_GRACE_S = 5.0


class Work(Protocol[TaskIn, ResultOut]):
    """The work done for each task; it travels to other processes, so it can be pickled."""

    def prepare(self) -> Callable[[TaskIn], ResultOut]:
        """Make a process ready (open the references) and return the function that does one task."""

    def give_up(self, task: TaskIn, reason: str) -> ResultOut:
        """Make the result of a task whose process died."""


def run(tasks: Sequence[Task], work: Work[Task, Result], jobs: int) -> Iterator[Result]:
    """Do all tasks and yield their results in the order of the tasks, each as soon as it and those before it are there.

    A process that dies (out of memory, a crash in a library) costs one result, not the others.
    """
    if jobs == 1 or len(tasks) == 1:
        do = work.prepare()
        yield from map(do, tasks)
        return
    _require_guard()
    together = functools.partial(_run_together, work=work, jobs=jobs)
    yield from outlive(tasks, work, together, BrokenProcessPool, "the process that worked on it died (out of memory?)")


def outlive(
    tasks: Sequence[Task],
    work: Work[Task, Result],
    together: Callable[[Sequence[Task]], Iterator[Result]],
    died: type[Exception],
    reason: str,
) -> Iterator[Result]:
    """Yield the results of all tasks in order, though processes die of some: these are given up.

    Parameters
    ----------
    together : callable
        Does tasks in other processes, and yields their results in order.
    died : type
        Raised by `together` where processes died. Any task then running may be to blame, so the first that has no
        result runs again, alone.
    reason : str
        Why a task is given up.
    """
    rest = list(tasks)
    while rest:
        done = 0
        try:
            for result in together(rest):
                yield result
                done += 1
        except died:
            suspect = rest[done]
            try:
                yield from together([suspect])
            except died:
                yield work.give_up(suspect, reason)
            done += 1
        rest = rest[done:]


def _require_guard() -> None:
    """Refuse to start processes from a script that would, imported by each of them, start them again.

    Raises
    ------
    RoadgeoError
        It has no `if __name__ == "__main__":`.
    """
    script = getattr(sys.modules.get("__main__"), "__file__", None)
    with contextlib.suppress(OSError):
        if script and script.endswith(".py") and "__name__" not in Path(script).read_text("utf-8", "replace"):
            raise RoadgeoError(
                f"{script}: several processes import this script again, each of them: put what it does under "
                'if __name__ == "__main__":, or use jobs=1'
            )


def _run_together(tasks: Sequence[Task], work: Work[Task, Result], jobs: int) -> Iterator[Result]:
    # A fork server loads the libraries once for all; elsewhere each process starts afresh.
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    if method == "forkserver":
        context.set_forkserver_preload(_PRELOAD)
    workers = min(jobs, len(tasks))
    with ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(work,)) as pool:
        try:
            with without_interrupts():
                futures = [pool.submit(_do, task) for task in tasks]
            for future in futures:
                yield future.result()
        except BaseException:
            for process in list((pool._processes or {}).values()):  # ours alone: a program may have others
                process.terminate()
            pool.shutdown(cancel_futures=True)
            raise


_prepared: list[Callable[[Any], Any]] = []


def _start_worker(work: Work[Any, Any]) -> None:
    """Make a worker ready. Ctrl-C is the parent's to handle: it ends the workers, which clean up as they go."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    try:
        end_with_parent()
        import cv2

        cv2.setNumThreads(1)  # the processes share the processors already
        _prepared.append(work.prepare())
    except SystemExit:  # the pool would report it as a fault
        _leave()


def _do(task: Any) -> Any:
    try:
        return _prepared[0](task)
    except SystemExit:  # the task has cleaned up; the pool would take this for its result, and go on
        _leave()


def _leave() -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it is on its way
    remove_own()
    os._exit(128 + signal.SIGTERM)


def end_with_parent(clean: Callable[[], None] = lambda: None) -> None:
    """End this process when the one that started it is gone, however it went: nobody waits for its results.

    It does the remaining work of the parent (`clean`), and ends its main thread first (SIGTERM), so that it
    may remove half-written files.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        clean()
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(main, signal.SIGTERM)
            time.sleep(_GRACE_S)
        os._exit(1)

    main = threading.main_thread().ident or 0
    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from processes that are started meanwhile: it reaches them before they can ignore it.

    To this process it comes afterwards, and so does SIGTERM: one that is half started is known to nobody who ends it.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which every first child starts, and which takes the block away
    came: list[int] = []
    kept = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not None:
                kept[number] = signal.signal(number, lambda number, _: came.append(number))
    # Children inherit what this thread blocks. Other threads may take the signal all the same, hence the handlers.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in kept.items():
            signal.signal(number, handler)
    for each in dict.fromkeys(came):
        signal.raise_signal(each)
