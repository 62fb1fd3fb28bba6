"""Many tasks on a Dask cluster: results in the order of the tasks, as from one process; a worker that dies costs none.

No more tasks are under way than keep all workers busy, whatever their number. Dask does a task again on another worker
where one dies; a task that kills worker after worker is done once more with nothing beside it, then given up.

Workers read the same files under the same paths. Each has one thread; kernels are compiled on each host once.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import uuid
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from roadgeo.errors import RoadgeoError, how_to_install
from roadgeo.running.processes import Work, outlive, without_interrupts
from roadgeo.storage.folders import private_temporary_dir

__all__ = ["Cluster", "Made", "do_prepared"]

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Tasks under way for each worker.
_AHEAD = 2

#: A scheduler must answer, and have a worker, within this time.
_PATIENCE_S = 30

_DIED = "the workers that it was given to died, one after another"


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
            from distributed.scheduler import KilledWorker

            yield from outlive(tasks, work, partial(_in_order, client, Made.of(work)), KilledWorker, _DIED)

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


def _in_order(client: Any, made: Made, tasks: Sequence[Any]) -> Iterator[Any]:
    """Yield the results of tasks in order."""
    from distributed import wait
    from distributed.scheduler import KilledWorker

    # Dask's executor fails where a worker dies that holds a result that was just read.
    waiting, under_way = iter(tasks), deque[Any]()
    try:
        while True:
            room = _AHEAD * len(client.nthreads()) + 1 - len(under_way)  # workers come and go
            under_way += [client.submit(do_prepared, made, task, pure=False) for task in islice(waiting, max(room, 0))]
            if not under_way:
                return
            yield under_way.popleft().result()
    except KilledWorker:
        with contextlib.suppress(CancelledError):
            wait(list(under_way))  # the scheduler blames all that a dead worker had: nothing runs beside the suspect
        raise
    except (CancelledError, OSError) as error:
        raise RoadgeoError("the Dask scheduler went away; the same command with --skip-existing goes on") from error
    finally:
        for future in under_way:
            future.cancel()


# --- on a worker ------------------------------------------------------------------------------------------------------

_prepared: dict[str, Any] = {}


@dataclass(frozen=True)
class Made:
    """Work on its way to the workers: a name for it, the folder that it was asked for in, and itself."""

    token: str
    folder: str
    pickled: bytes

    @classmethod
    def of(cls, work: Any) -> Made:
        """Wrap work that can be pickled."""
        return cls(uuid.uuid4().hex, str(Path.cwd()), pickle.dumps(work))


def do_prepared(made: Made, *task: Any) -> Any:
    """Do a task in the folder where it was asked for; make its work and this worker ready first, once."""
    if made.token not in _prepared:
        os.chdir(made.folder)
        import cv2

        from roadgeo.kernels.warmup import warm_up

        cv2.setNumThreads(1)
        with _one_of_host():
            warm_up()
        _prepared.clear()  # of earlier runs, whose maps are no longer needed
        _prepared[made.token] = pickle.loads(made.pickled).prepare()  # noqa: S301 (from our own client)
    return _prepared[made.token](*task)


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
