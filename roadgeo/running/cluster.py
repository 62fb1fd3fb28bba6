"""Tasks on a Dask cluster, for a pool.

Dask does a task again on another worker where one dies, and blames all that a dead worker had: a task that kills worker
after worker is done once more with nothing beside it, then given up.

Workers read the same files under the same paths. Each has one thread; kernels are compiled on each host once.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import threading
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from roadgeo._progress import Say
from roadgeo.errors import RoadgeoError, how_to_install
from roadgeo.running.pool import Lost, Pool, Work, enter
from roadgeo.running.processes import without_interrupts
from roadgeo.storage.fence import Fence, current
from roadgeo.storage.folders import private_temporary_dir

__all__ = ["Cluster", "DaskWorkers"]

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Tasks under way for each worker.
_AHEAD = 2

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
    divide_map : bool
        Each worker searches parts of the map for all masks, not all of the map for some (see `running.divided`).
    """

    scheduler: str | None = None
    workers: int = 1
    divide_map: bool = False

    def run(self, tasks: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]:
        """Do all tasks and yield their results in the order of the tasks.

        Raises
        ------
        RoadgeoError
            Dask is not installed; there is no scheduler at the address, or it went away.
        """
        with self.connected() as client:
            yield from DaskWorkers(client, work).run(tasks)

    @contextlib.contextmanager
    def connected(self) -> Iterator[Any]:
        """Connect to the scheduler, or start one; return Dask's client.

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
            address = self.scheduler or stack.enter_context(_local_cluster(self.workers))
            try:
                client = stack.enter_context(Client(address, timeout=_PATIENCE_S))
                client.wait_for_workers(1, timeout=_PATIENCE_S)
            except (OSError, ValueError) as error:
                what = " ".join(str(error).split())
                raise RoadgeoError(
                    f"no Dask scheduler with workers at {address}: {what}; "
                    "start them with `dask scheduler`, `dask worker`"
                ) from error
            yield client


@contextlib.contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """Start worker processes on this machine, for as long as they are needed."""
    import dask
    from distributed import LocalCluster

    settings = {"distributed.worker.multiprocessing-method": "spawn", "distributed.logging.distributed": "error"}
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
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


class DaskWorkers(Pool):
    """The workers of a cluster, ready for one kind of work."""

    def __init__(self, client: Any, work: Any) -> None:
        """Take them as Dask's client knows them."""
        self.work, self._client, self._made = work, client, Made.of(work)

    def names(self) -> list[str]:
        """Return their addresses, in order; at least one."""
        return sorted(self._client.nthreads()) or [""]

    def busy(self) -> int:
        """Return how many tasks keep them busy."""
        return _AHEAD * len(self._client.nthreads()) + 1

    def ask(self, task: Any, patience_s: float, say: Say, called_off: threading.Event) -> Any:  # noqa: ARG002
        """Have one do a task, the one whose address is `task.worker` if it is there.

        Raises
        ------
        RoadgeoError
            The scheduler went away.
        """
        from distributed.scheduler import KilledWorker

        worker = getattr(task, "worker", "")
        where = {"workers": [worker], "allow_other_workers": True} if worker else {}
        future = self._client.submit(do_prepared, self._made, task, pure=False, **where)
        try:
            return future.result()
        except KilledWorker:
            return Lost("died", "the workers that it was given to died, one after another")
        except (CancelledError, OSError) as error:
            raise RoadgeoError("the Dask scheduler went away; the same command with --skip-existing goes on") from error


# --- on a worker ------------------------------------------------------------------------------------------------------

#: For each work, the thread that does it, and how.
_prepared: dict[str, tuple[ThreadPoolExecutor, Any]] = {}


@dataclass(frozen=True)
class Made:
    """Work on its way to the workers: a name for it, the folder that it was asked for in, itself, and its fence."""

    token: str
    folder: str
    pickled: bytes
    fence: Fence | None

    @classmethod
    def of(cls, work: Any) -> Made:
        """Wrap work that can be pickled."""
        return cls(uuid.uuid4().hex, str(Path.cwd()), pickle.dumps(work), current())


def do_prepared(made: Made, task: Any) -> Any:
    """Do a task in the folder where it was asked for; make its work and this worker ready first, once.

    A worker outlives the work. So a thread of its own does it, inside the fence of whoever asked.
    """
    if made.token not in _prepared:
        for thread, _ in _prepared.values():  # of earlier runs, whose maps are no longer needed
            thread.shutdown()
        _prepared.clear()
        thread = ThreadPoolExecutor(1)
        _prepared[made.token] = thread, thread.submit(_prepare, made).result()
    thread, do = _prepared[made.token]
    return thread.submit(do, task).result()


def _prepare(made: Made) -> Any:
    """Make work ready on the thread that will do it."""
    os.chdir(made.folder)
    enter(made.fence)
    from roadgeo.kernels.warmup import warm_up

    with _one_of_host():
        warm_up()
    return pickle.loads(made.pickled).prepare()  # noqa: S301 (from our own client)


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
