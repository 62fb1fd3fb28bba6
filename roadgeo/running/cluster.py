"""Tasks on a Dask cluster, for a pool.

Dask does a task again on another worker where one dies, and blames all that a dead worker had: a task that kills worker
after worker is done once more with nothing beside it, then given up.

Workers read the same files under the same paths. Each has one thread; kernels are compiled on each host once.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from roadgeo.errors import RoadgeoError, how_to_install
from roadgeo.running.pool import Lost, Pool, ResultOut, TaskIn, Work, enter
from roadgeo.running.processes import without_interrupts
from roadgeo.storage.fence import Fence, current

__all__ = ["Cluster", "DaskWorkers"]

#: A scheduler must answer, and have a worker, within this time.
_PATIENCE_S = 30

#: Settings of a cluster on this machine. Its scheduler serves its status at any port, for one may be taken.
_SETTINGS = {"distributed.worker.multiprocessing-method": "spawn", "distributed.logging.distributed": "error"}
_LOCAL: dict[str, Any] = {
    "threads_per_worker": 1,
    "scheduler_kwargs": {"dashboard": False, "dashboard_address": "127.0.0.1:0"},
    "memory_limit": 0,
    "silence_logs": 50,
}


@dataclass(frozen=True)
class Cluster:
    """Where tasks are done.

    Attributes
    ----------
    scheduler : str or None
        Address of a Dask scheduler, such as tcp://10.0.0.1:8786; None: processes on this machine, `workers` of them.
    workers : int
    divide_map : bool
        Each worker searches parts of the map for all masks, not all of the map for some (see `running.divided`).
    """

    scheduler: str | None = None
    workers: int = 1
    divide_map: bool = False

    def run(self, tasks: Sequence[TaskIn], work: Work[TaskIn, ResultOut]) -> Iterator[ResultOut]:
        """Do all tasks and yield their results in the order of the tasks.

        Raises
        ------
        RoadgeoError
            Dask is not installed; there is no scheduler at the address, or it or all its workers went away.
        """
        with self.connected(work) as workers:
            yield from workers.run(tasks)

    @contextlib.contextmanager
    def connected(self, work: Any) -> Iterator[DaskWorkers]:
        """Connect to the scheduler, or start one; return its workers, for one kind of work.

        Raises
        ------
        RoadgeoError
            Dask is not installed; there is no scheduler at the address.
        """
        try:
            import dask
            from distributed import Client, LocalCluster
        except ImportError as error:
            raise RoadgeoError(f"a cluster needs dask: {how_to_install('dask')}") from error

        with contextlib.ExitStack() as stack:
            address = self.scheduler
            if address is None:
                stack.enter_context(dask.config.set(_SETTINGS))
                with without_interrupts():
                    address = stack.enter_context(LocalCluster(n_workers=self.workers, **_LOCAL))
            try:
                client = stack.enter_context(Client(address, timeout=_PATIENCE_S))
                client.wait_for_workers(1, timeout=_PATIENCE_S)
            except (OSError, ValueError) as error:
                what = " ".join(str(error).split())
                raise RoadgeoError(
                    f"no Dask scheduler with workers at {address}: {what}; "
                    "start them with `dask scheduler`, `dask worker`"
                ) from error
            yield DaskWorkers(client, work)


class DaskWorkers(Pool):
    """The workers of a cluster, ready for one kind of work."""

    def __init__(self, client: Any, work: Any) -> None:
        """Take them as Dask's client knows them."""
        self.work, self._client = work, client
        self._made = (uuid.uuid4().hex, str(Path.cwd()), pickle.dumps(work), current())

    def names(self) -> list[str]:
        """Return their addresses, in order; at least one."""
        return sorted(self._client.nthreads()) or [""]

    def count(self) -> int:
        """Return how many there are."""
        return len(self._client.nthreads())

    def submit(self, task: Any, *_: Any) -> Any:
        """Have one do a task, the one whose address is `task.worker` if it is there."""
        worker = getattr(task, "worker", "")
        where = {"workers": [worker], "allow_other_workers": True} if worker else {}
        return self._client.submit(do_prepared, self._made, task, pure=False, **where)

    def result(self, future: Any, *_: Any) -> Any:
        """Wait for the result of a task.

        Raises
        ------
        RoadgeoError
            The scheduler went away, or all workers for good: Dask restarts none that dies while it starts.
        """
        from distributed import wait
        from distributed.scheduler import KilledWorker

        try:
            while not future.done():
                try:
                    wait(future, _PATIENCE_S)
                except TimeoutError:
                    self._client.wait_for_workers(1, timeout=_PATIENCE_S)
            return future.result()
        except KilledWorker:
            return Lost("died", "the workers that it was given to died, one after another")
        except (CancelledError, OSError) as error:
            if future.status == "error":  # it is the task's
                raise
            what = "the Dask scheduler, or all its workers, went away"
            raise RoadgeoError(f"{what}; the same command with --skip-existing goes on") from error


# --- on a worker ------------------------------------------------------------------------------------------------------


def do_prepared(made: tuple[str, str, bytes, Fence | None], task: Any) -> Any:
    """Do a task in the folder where it was asked for; make its work and this worker ready first, once.

    The work is a name for it, that folder, itself, and its fence. A worker outlives it. So a thread of its own does it,
    inside the fence of whoever asked.
    """
    thread, do = _made_ready(*made)
    return thread.submit(do, task).result()


@lru_cache(maxsize=1)
def _made_ready(_: str, folder: str, pickled: bytes, fence: Fence | None) -> tuple[ThreadPoolExecutor, Any]:
    from distributed import Lock

    from roadgeo.kernels.warmup import warm_up

    _made_ready.cache_clear()  # maps of earlier runs go before others are opened
    with Lock(f"roadgeo: kernels of {socket.gethostname()}"):  # others wait for the files of the one that compiles
        warm_up()
    thread = ThreadPoolExecutor(1)
    return thread, thread.submit(_prepare, folder, pickled, fence).result()


def _prepare(folder: str, pickled: bytes, fence: Fence | None) -> Any:
    """Make work ready on the thread that will do it."""
    os.chdir(folder)
    enter(fence)
    return pickle.loads(pickled).prepare()  # noqa: S301 (from our own client)
