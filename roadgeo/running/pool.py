"""One pool: tasks in, results in order. A worker that dies, takes too long or is called off is a result like others.

Workers are processes of this machine (`processes`) or of a cluster (`cluster`). A task whose worker died is done once
more, in a batch with no other beside it, for memory may have been the cause; then it is lost. No more results wait to
be read than some for each worker, and no more tasks are under way than keep the workers busy.
"""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, Literal, Protocol, TypeVar

from roadgeo._progress import Say, say_nothing
from roadgeo.storage.fence import Fence, is_started_inside

__all__ = ["Lost", "Pool", "Work", "enter"]

TaskIn = TypeVar("TaskIn", contravariant=True)
ResultOut = TypeVar("ResultOut", covariant=True)

#: Results for each worker that may wait until those before them are there.
_UNREAD = 16


class Work(Protocol[TaskIn, ResultOut]):
    """The work done for each of many tasks; it travels to other processes, so it can be pickled."""

    def prepare(self) -> Callable[[TaskIn], ResultOut]:
        """Make a process ready (open the references) and return the function that does one task."""

    def give_up(self, task: TaskIn, lost: Lost) -> ResultOut:
        """Make the result of a task that is lost."""


@dataclass(frozen=True)
class Lost:
    """Stands for the result of a task that has none.

    Attributes
    ----------
    why : str
        Its workers died, it took too long, nobody waits for it, or there is no worker.
    said : str
        The same for people.
    """

    why: Literal["died", "late", "called off", "no worker"]
    said: str


class Pool(ABC):
    """Workers that are ready for one kind of work; may be asked from several threads.

    Attributes
    ----------
    work : Work
    """

    work: Any

    @abstractmethod
    def busy(self) -> int:
        """Return how many tasks under way keep the workers busy; they may come and go."""

    @abstractmethod
    def ask(self, task: Any, patience_s: float, say: Say, called_off: threading.Event) -> Any:
        """Have one do a task, and return its result, or why it is lost; raises what the task raised."""

    def run(
        self,
        tasks: Sequence[Any],
        patience_s: float = math.inf,
        say: Say = say_nothing,
        called_off: threading.Event | None = None,
    ) -> Iterator[Any]:
        """Do all tasks and yield their results in order, each as soon as it and those before it are there.

        Once nobody reads any more no task begins; those under way go on until the workers are ended.

        Parameters
        ----------
        patience_s : float
            Time for each task; a worker that takes longer is ended.
        say
            Called with the progress.
        called_off : Event, optional
            Once it is set nobody waits for the results any more.
        """
        waiting, begun = iter(tasks), deque[Future[Any]]()
        ask = partial(self.ask, patience_s=patience_s, say=say, called_off=called_off or threading.Event())
        threads = ThreadPoolExecutor(len(tasks) or 1, "roadgeo-pool")  # which starts no more than are busy

        try:
            for task in tasks:
                while True:
                    busy, under_way = self.busy(), [future for future in begun if not future.done()]
                    room = min(busy - len(under_way), _UNREAD * busy - len(begun))
                    more = [threads.submit(ask, each) for each in islice(waiting, max(room, 0))]
                    begun.extend(more)
                    if begun[0].done():
                        break
                    wait(under_way + more, return_when=FIRST_COMPLETED)
                result = begun.popleft().result()
                if isinstance(result, Lost) and result.why == "died":
                    wait(begun)
                    result = ask(task)
                yield self.work.give_up(task, result) if isinstance(result, Lost) else result
        finally:
            threads.shutdown(wait=False)


# --- in a worker ------------------------------------------------------------------------------------------------------


def enter(within: Fence | None) -> None:
    """Put the thread that works inside a fence, and leave the other processors to other workers."""
    if within is not None and not is_started_inside():
        within.enter()
    import cv2

    cv2.setNumThreads(1)
