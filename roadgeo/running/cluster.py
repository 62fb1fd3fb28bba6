"""Many tasks on a Dask cluster: results in the order of the tasks, as from one process; a worker that dies costs none.

Tasks travel in groups. No more groups are under way than keep all workers busy, so that neither the scheduler nor this
process holds more than those, whatever the number of tasks. A group whose worker dies is done again on another; when
that kills every worker, its tasks are done one by one with nothing beside them, and those that kill again are given up.

Workers read the same files under the same paths. Each has one thread; kernels are compiled on each host once.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import uuid
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from roadgeo.errors import RoadgeoError, how_to_install
from roadgeo.running.processes import Work, without_interrupts
from roadgeo.storage.folders import private_temporary_dir

__all__ = ["RETRIES", "Cluster", "Made", "Stream", "connected", "prepared", "run_on_cluster"]

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Most tasks in a group. A group should take seconds: shorter ones are dominated by sending.
_MOST_TOGETHER = 100

#: Groups under way for each worker, and the number of times that a group is repeated elsewhere.
_AHEAD, RETRIES = 2, 3

#: A scheduler must answer, and have a worker, within this time.
_PATIENCE_S = 30


@dataclass(frozen=True)
class Cluster:
    """Where tasks are done.

    Attributes
    ----------
    scheduler : str or None
        Address of a Dask scheduler, such as tcp://10.0.0.1:8786; None: processes on this machine, `workers` of them.
    workers : int
    together : int
        Most tasks in a group.
    divide_map : bool
        Each worker searches parts of the map for all masks, not all of the map for some (see `running.divided`).
    """

    scheduler: str | None = None
    workers: int = 1
    together: int = _MOST_TOGETHER
    divide_map: bool = False

    def run(self, tasks: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]:
        """Do all tasks and yield their results in order (see `run_on_cluster`)."""
        return run_on_cluster(tasks, work, self)


def run_on_cluster(tasks: Sequence[Task], work: Work[Task, Result], cluster: Cluster) -> Iterator[Result]:
    """Do all tasks on a cluster and yield their results in the order of the tasks, each group as it comes.

    Raises
    ------
    RoadgeoError
        Dask is not installed; there is no scheduler at the address, or it went away.
    """
    with connected(cluster) as client:
        yield from Stream(client, work, cluster.together).results(tasks)


@contextlib.contextmanager
def connected(cluster: Cluster) -> Iterator[Any]:
    """Connect to a cluster's scheduler, or start one; return Dask's client.

    Raises
    ------
    RoadgeoError
        Dask is not installed; there is no scheduler at the address.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise RoadgeoError(f"a cluster needs dask: {how_to_install('dask')}") from error

    with contextlib.ExitStack() as stack:
        address = cluster.scheduler or stack.enter_context(_local_cluster(cluster.workers))
        try:
            client = stack.enter_context(Client(address, timeout=_PATIENCE_S))
            client.wait_for_workers(1, timeout=_PATIENCE_S)
        except (OSError, ValueError) as error:
            what = " ".join(str(error).split())
            raise RoadgeoError(
                f"no Dask scheduler with workers at {address}: {what}; start them with `dask scheduler`, `dask worker`"
            ) from error
        yield client


@contextlib.contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """Start worker processes on this machine, for as long as they are needed."""
    import dask
    from distributed import LocalCluster

    told = {"distributed.worker.multiprocessing-method": "spawn", "distributed.logging.distributed": "error"}
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(told))
        with without_interrupts():
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},  # any port: one may be taken
                memory_limit=0,
                silence_logs=50,
            )
            stack.enter_context(cluster)
        yield cluster


class Stream:
    """Sends groups of tasks and takes their results, a bounded number at a time."""

    #: Why a task is given up.
    died = "the workers that it was given to died, one after another"

    def __init__(self, client: Any, work: Any, together: int) -> None:
        self.client, self.work, self.together = client, work, together
        self.made = Made(uuid.uuid4().hex, str(Path.cwd()), pickle.dumps(work))

    def results(self, tasks: Sequence[Task]) -> Iterator[Any]:
        """Yield the results of all tasks in order."""
        size = max(1, min(self.together, len(tasks) // (4 * self._n_workers())))
        groups = deque(tasks[first : first + size] for first in range(0, len(tasks), size))
        under_way: deque[tuple[Any, Sequence[Any]]] = deque()
        try:
            while groups or under_way:
                while groups and len(under_way) < _AHEAD * self._n_workers() + 1:
                    group = groups.popleft()
                    under_way.append((self._send(group), group))
                for found, group in self._next(under_way):
                    yield from self._one_by_one(group) if found is None else found
        finally:
            with contextlib.suppress(Exception):
                self.client.cancel([getattr(future, "futures", future) for future, _ in under_way])

    def _next(self, under_way: deque[tuple[Any, Sequence[Any]]]) -> list[tuple[list[Any] | None, Sequence[Any]]]:
        """Take the next group off; where its workers died, also all others, so that nothing is left under way."""
        taken: list[tuple[list[Any] | None, Sequence[Any]]] = []
        while under_way and (not taken or taken[0][0] is None):
            future, group = under_way.popleft()
            taken.append((self._wait_for(future), group))
        return taken

    def _n_workers(self) -> int:
        """Return how many workers there are now: they may come and go."""
        return max(1, len(self.client.nthreads()))

    def _send(self, group: Sequence[Any]) -> Any:
        return self.client.submit(_do_group, self.made, list(group), pure=False, retries=RETRIES)

    def _results_of(self, future: Any) -> list[Any] | None:
        return list(future.result())

    def _wait_for(self, future: Any) -> list[Any] | None:
        """Return a group's results; None: worker after worker died of it, or beside it."""
        from concurrent.futures import CancelledError

        from distributed.scheduler import KilledWorker

        try:
            return self._results_of(future)
        except KilledWorker:
            return None
        except (CancelledError, OSError) as error:
            raise RoadgeoError("the Dask scheduler went away; the same command with --skip-existing goes on") from error

    def _one_by_one(self, group: Sequence[Any]) -> Iterator[Any]:
        """Do tasks while nothing else is under way: the scheduler blames all that a dead worker had before it."""
        for task in group:
            found = self._wait_for(self._send([task]))
            yield from [self.work.give_up(task, self.died)] if found is None else found


# --- on a worker ------------------------------------------------------------------------------------------------------

_prepared: dict[str, Any] = {}


@dataclass(frozen=True)
class Made:
    """Work on its way to the workers: a name for it, the folder that it was asked for in, and itself."""

    token: str
    folder: str
    pickled: bytes


def _do_group(made: Made, tasks: Sequence[Any]) -> list[Any]:
    """Do tasks one after another."""
    do = prepared(made)
    return [do(task) for task in tasks]


def prepared(made: Made) -> Any:
    """Return work that is ready, in the folder where it was asked for; make it and this worker ready first, once."""
    if made.token not in _prepared:
        os.chdir(made.folder)
        import cv2

        from roadgeo.kernels.warmup import warm_up

        cv2.setNumThreads(1)
        with _one_of_host():
            warm_up()
        _prepared.clear()  # of earlier runs, whose maps are no longer needed
        _prepared[made.token] = pickle.loads(made.pickled).prepare()  # noqa: S301 (from our own client)
    return _prepared[made.token]


@contextlib.contextmanager
def _one_of_host() -> Iterator[None]:
    """Let one process of this host compile kernels while the others wait for its files."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with (private_temporary_dir() / "compiling.lock").open("ab") as lock:  # where nobody else can take it
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
