"""Processes of this machine that do tasks for a pool, each made ready once; and many tasks in them, or in this one."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import pickle
import queue
import shutil
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from roadgeo.errors import RoadgeoError
from roadgeo.running.pool import Asker, Lost, Pool, ResultOut, TaskIn, Work, enter
from roadgeo.storage import fence
from roadgeo.storage.files import remove_own

__all__ = ["Processes", "run", "tell", "without_interrupts"]

_log = logging.getLogger("roadgeo")  # of all modules

#: Modules that nearly every task needs: a fork server loads them once for all processes.
_PRELOAD = ["roadgeo.workflows", "roadgeo.outputs.location_files", "roadgeo.sources.masks"]

#: Time in which a process that is to end, or whose parent is gone, removes half-written files.
_GRACE_S = 5.0
#: Time to become ready.
_START_S = 120.0
#: Interval of checks whether somebody still waits.
_GLANCE_S = 0.25
_CALLED_OFF, _ENDING = Lost("called off", "it was called off"), Lost("no worker", "it is ending")


def run(tasks: Sequence[TaskIn], work: Work[TaskIn, ResultOut], jobs: int) -> Iterator[ResultOut]:
    """Do all tasks in one process or several, and yield their results in the order of the tasks.

    A process that dies (out of memory, a crash in a library) costs one result, not the others.
    """
    if jobs == 1 or len(tasks) <= 1:
        yield from map(work.prepare(), tasks) if tasks else ()
        return
    _require_guard()
    with contextlib.closing(Processes(work, jobs)) as processes:
        yield from processes.run(tasks)


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


class Processes(Pool):
    """Processes of this machine, each ready for one kind of work."""

    def __init__(self, work: Any, count: int, folder: str = "", within: fence.Fence | None = None) -> None:
        """Take what they need; each is started when it is first asked.

        Parameters
        ----------
        folder : str
            Holds all files that they write, for this process to remove; they do it where it is killed.
        within : Fence, optional
            A fence that they enter; by default this process's own.
        """
        self.work, self._closed, self._lock = work, False, threading.Lock()
        self._grace_s = 0.0 if folder else _GRACE_S
        self.all = [_Process((work, folder, within or fence.current())) for _ in range(count)]
        self._idle = deque(self.all)
        self._threads = ThreadPoolExecutor(count, "roadgeo-pool")  # each has a process while it waits for its result

    def count(self) -> int:
        """Return how many there are."""
        return len(self.all)

    def wait_until_ready(self) -> None:
        """Wait until all have prepared.

        Raises
        ------
        RoadgeoError
            One cannot be started, or ends; or what the first raised that could not prepare.
        """
        asker = Asker(0.0)
        for future in [self.submit(None, asker) for _ in self.all]:
            if isinstance(lost := self.result(future, asker), Lost):
                raise RoadgeoError(f"a process ended before it was ready: {lost.said}")

    def submit(self, task: Any, asker: Asker) -> Future[Any] | None:
        """Have the next one that is free do a task, unless all are to end."""
        with contextlib.suppress(RuntimeError):
            return self._threads.submit(self._ask, task, asker)
        return None

    def result(self, future: Future[Any] | None, asker: Asker) -> Any:
        """Wait for the result of a task; once it is called off for no process."""
        if future is None:
            return _ENDING
        while not future.done():
            wait([future], _GLANCE_S)
            if asker.called_off.is_set():
                future.cancel()
        return _CALLED_OFF if future.cancelled() else future.result()

    def _ask(self, task: Any, asker: Asker) -> Any:
        """Have a process do a task. One that has no result for it is started anew."""
        if asker.called_off.is_set():
            return _CALLED_OFF
        process, kind = self._idle.popleft(), "lost"
        try:
            result: Any = self._start(process)
            if result is None:
                kind, result = process.ask(task, asker)
        finally:
            if kind == "lost":
                with self._lock:  # who closes the pool meanwhile waits until it has ended
                    process.end(0.0)
                self._start(process)
            self._idle.append(process)
        if kind == "failed":
            raise result
        return result

    def _start(self, process: _Process) -> Lost | None:
        """Start a process that has ended, unless all are to end."""
        with self._lock:
            return _ENDING if self._closed else process.start()

    def close(self) -> None:
        """End all."""
        with self._lock:
            self._closed = True
            for started in filter(None, [process.process for process in self.all]):
                started.terminate()
            until = time.monotonic() + self._grace_s
            for process in self.all:
                process.end(until - time.monotonic())
        self._threads.shutdown(wait=False)


@dataclass
class _Process:
    """One process, and the pipe to it."""

    given: tuple[Any, ...]
    process: Any = None

    def start(self) -> Lost | None:
        """Start it where it is not, and the system has room for it."""
        if self.process is not None:
            return None
        # A fork server loads the libraries once for all; on Windows each process starts afresh.
        context: Any = multiprocessing.get_context("spawn" if os.name == "nt" else "forkserver")
        context.set_forkserver_preload(_PRELOAD)
        try:
            self._pipe, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, _log.level, *self.given), daemon=True)
            with theirs, without_interrupts():
                process.start()
        except OSError as error:
            return Lost("no worker", f"no process can be started: {error.strerror or error}")
        self.process, self._start_s = process, _START_S
        return None

    def ask(self, task: Any, asker: Asker) -> tuple[str, Any]:
        """Return "done" and the result of a task, "failed" and what it raised, or "lost" and why.

        The first one waits until the process has prepared.
        """
        patience_s = self._start_s + asker.patience_s
        until = time.monotonic() + patience_s
        try:
            self._pipe.send(task)
            while not asker.called_off.is_set() and time.monotonic() < until:
                if self._pipe.poll(_GLANCE_S):
                    kind, said = self._pipe.recv()
                    if kind != "told":
                        self._start_s = 0.0
                        return kind, said
                    asker.say(*said)
        except (EOFError, OSError):
            return "lost", Lost("died", "the process that worked on it died (out of memory?)")
        return "lost", _CALLED_OFF if asker.called_off.is_set() else Lost("late", f"longer than {patience_s:g} s")

    def end(self, grace_s: float) -> None:
        """End it, at once or after a time in which it may clean up."""
        process, self.process = self.process, None
        if process is not None:
            process.join(max(grace_s, 0.0))
            process.kill()
            process.join(_GRACE_S)


# --- in the process ---------------------------------------------------------------------------------------------------

_parents: list[Connection] = []


def tell(text: str, share: float | None = None) -> None:
    """Report how far this process's task is, to the process that waits for it."""
    for pipe in _parents:
        pipe.send(("told", (text, share)))


def _serve(pipe: Connection, level: int, work: Any, folder: str, within: fence.Fence | None) -> None:
    """Do tasks until it is told to end. Ctrl-C is the parent's to handle: it ends the processes, which clean up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    tasks: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(pipe, tasks, folder), daemon=True).start()  # it stays outside the fence
    try:
        enter(within)  # the fork server may be older than the fence
        _log.setLevel(level)
        _parents[:] = [pipe]
        kind, do = _reply(work.prepare)
        while True:
            task = pickle.loads(tasks.get())  # noqa: S301 (from the parent)
            answer = (kind, do) if kind == "failed" else ("done", None) if task is None else _reply(do, task)
            with contextlib.suppress(OSError):  # the parent is gone
                pipe.send(answer)
    except SystemExit:  # the task has cleaned up
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it is on its way
        remove_own()
        os._exit(128 + signal.SIGTERM)


def _receive(pipe: Connection, tasks: queue.SimpleQueue[bytes], folder: str) -> None:
    """Take tasks, and end this process when the one that started it is gone, however it went.

    The parent's folder is removed, and the main thread ended first (SIGTERM), that it may remove half-written files.
    """
    with contextlib.suppress(EOFError, OSError):
        while True:
            tasks.put(pipe.recv_bytes())
    if folder:
        shutil.rmtree(folder, ignore_errors=True)
    os.kill(os.getpid(), signal.SIGTERM)  # on Windows it ends all at once
    time.sleep(_GRACE_S)
    os._exit(1)


def _reply(do: Callable[..., Any], *task: Any) -> tuple[str, Any]:
    """Return what is done, or the error as it can be sent."""
    try:
        return "done", do(*task)
    except Exception as error:
        with contextlib.suppress(Exception):
            return "failed", pickle.loads(pickle.dumps(error))  # noqa: S301 (from ourselves)
        return "failed", RuntimeError(f"{type(error).__name__}: {error}")


@contextlib.contextmanager
def without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from processes that are started meanwhile: it reaches them before they can ignore it."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which every first child starts, and which takes the block away
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # children inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
