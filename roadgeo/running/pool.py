"""One pool: tasks in, results in order. A worker that dies, takes too long or is called off is a result like others.

Workers are processes of this machine (`Processes`) or of a cluster (`cluster`). A task whose worker died is done once
more, alone where memory may have been the cause; then it is lost. No more results wait to be read than some for each
worker, and no more tasks are under way than keep the workers busy.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any, Generic, Literal, Protocol, TypeVar

from roadgeo._progress import Say, say_nothing

__all__ = ["Died", "Ended", "Lost", "Pool", "Ready", "Work", "Workers"]

Task = TypeVar("Task")
TaskIn = TypeVar("TaskIn", contravariant=True)
Result = TypeVar("Result")
ResultOut = TypeVar("ResultOut", covariant=True)

#: Results for each worker that may wait until those before them are there.
_UNREAD = 16


class Ready(Protocol[TaskIn, ResultOut]):
    """Makes workers ready; it travels to other processes, so it can be pickled."""

    def prepare(self) -> Callable[[TaskIn], ResultOut]:
        """Make a process ready (open the references) and return the function that does one task."""


class Work(Ready[TaskIn, ResultOut], Protocol[TaskIn, ResultOut]):
    """The work done for each of many tasks."""

    def give_up(self, task: TaskIn, reason: str) -> ResultOut:
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


class Died(Exception):  # noqa: N818 (what happened, not a fault of the caller)
    """The worker died that had a task."""


class Ended(Exception):  # noqa: N818 (as above)
    """A task is not done, or no more, for a reason that doing it again would not change."""

    def __init__(self, why: Literal["late", "called off", "no worker"], said: str) -> None:
        super().__init__(said)
        self.lost = Lost(why, said)


class Workers(Protocol):
    """Those who do tasks.

    Attributes
    ----------
    died : str
        Why a task is lost that they died of.
    """

    died: str

    def busy(self) -> int:
        """Return how many tasks under way keep them busy; they may come and go."""

    def ask(self, task: Any, patience_s: float, say: Say, called_off: threading.Event) -> Any:
        """Have one do a task, and return its result, or raise what the task raised.

        Raises
        ------
        Died, Ended
            There is no result.
        """

    def close(self) -> None:
        """End all that they do."""


class Pool(Generic[Task, Result]):
    """Does tasks; may be asked from several threads."""

    def __init__(self, workers: Workers, *, again_alone: bool = True) -> None:
        """Take workers; where one died its task runs again with no other beside it, or at once."""
        self.workers, self._again_alone, self._gate = workers, again_alone, _Gate()

    def do(
        self,
        task: Task,
        patience_s: float = math.inf,
        say: Say = say_nothing,
        called_off: threading.Event | None = None,
    ) -> Result | Lost:
        """Do one task as soon as a worker is free.

        Parameters
        ----------
        patience_s : float
            Time for it; a worker that takes longer is ended.
        say
            Called with the progress.
        called_off : Event, optional
            Once it is set nobody waits for the result any more.
        """
        called_off = called_off or threading.Event()
        try:
            for alone in (False, self._again_alone):
                with suppress(Died), self._gate.passed(alone):
                    result: Result = self.workers.ask(task, patience_s, say, called_off)
                    return result
        except Ended as ended:
            return ended.lost
        return Lost("died", self.workers.died)

    def run(self, tasks: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]:
        """Do all tasks and yield their results in order, each as soon as it and those before it are there.

        Who stops reading ends the workers.
        """
        waiting, begun = iter(tasks), deque[Future[Result | Lost]]()
        threads = ThreadPoolExecutor(len(tasks) or 1, "roadgeo-pool")  # which starts no more than are busy

        def begin() -> list[Future[Result | Lost]]:
            busy, under_way = self.workers.busy(), [future for future in begun if not future.done()]
            room = min(busy - len(under_way), _UNREAD * busy - len(begun))
            more = [threads.submit(self.do, task) for task in islice(waiting, max(room, 0))]
            begun.extend(more)
            return under_way + more

        try:
            for task in tasks:
                under_way = begin()
                while not begun[0].done():
                    wait(under_way, return_when=FIRST_COMPLETED)
                    under_way = begin()
                result = begun.popleft().result()
                yield work.give_up(task, result.said) if isinstance(result, Lost) else result
        finally:
            self.workers.close()
            threads.shutdown(cancel_futures=True)


class _Gate:
    """Lets any number pass together, or one alone."""

    def __init__(self) -> None:
        self._changed, self._inside, self._closed = threading.Condition(), 0, False

    @contextmanager
    def passed(self, alone: bool) -> Iterator[None]:
        """Wait until it is open, and hold it open for others, or closed."""
        with self._changed:
            self._changed.wait_for(lambda: not self._closed)
            self._closed = alone
            self._changed.wait_for(lambda: not (alone and self._inside))
            self._inside += 1
        try:
            yield
        finally:
            with self._changed:
                self._inside -= 1
                self._closed = self._closed and not alone
                self._changed.notify_all()
