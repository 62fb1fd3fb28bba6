"""One pool: tasks in, results in order. A worker that dies, takes too long or is called off is a result like others.

Workers are processes of this machine (`processes`) or of a cluster (`cluster`). A task whose worker died is done once
more, in a batch with no other beside it, for memory may have been the cause; then it is lost. No more tasks begin, or
wait with their results to be read, than some for each worker.
"""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Literal, Protocol, TypeVar

from roadgeo._progress import Say, say_nothing
from roadgeo.storage.fence import Fence, is_started_inside

__all__ = ["Asker", "Lost", "Pool", "ResultOut", "TaskIn", "Work", "enter"]

TaskIn = TypeVar("TaskIn", contravariant=True)
ResultOut = TypeVar("ResultOut", covariant=True)

#: Tasks for each worker that may have begun, or be done, before the result of the first of them is there.
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


@dataclass(frozen=True)
class Asker:
    """Who waits for results.

    Attributes
    ----------
    patience_s : float
        Time for each task; a worker that takes longer is ended.
    say
        Called with the progress.
    called_off : Event
        Once it is set nobody waits any more.
    """

    patience_s: float = math.inf
    say: Say = say_nothing
    called_off: threading.Event = field(default_factory=threading.Event)


#: Waits as long as it takes.
_PATIENT = Asker()


class Pool(ABC):
    """Workers that are ready for one kind of work; may be asked from several threads.

    Attributes
    ----------
    work : Work
    """

    work: Any

    @abstractmethod
    def count(self) -> int:
        """Return how many workers there are; they may come and go."""

    @abstractmethod
    def submit(self, task: Any, asker: Asker) -> Any:
        """Have one do a task, and return its future."""

    @abstractmethod
    def result(self, future: Any, asker: Asker) -> Any:
        """Wait for the result of a task, and return it, or why it is lost; raises what the task raised."""

    def run(self, tasks: Sequence[Any], asker: Asker = _PATIENT) -> Iterator[Any]:
        """Do all tasks and yield their results in order, each as soon as it and those before it are there.

        Those that were submitted go on until the workers are ended.
        """
        waiting, begun = iter(tasks), deque[Any]()
        for task in tasks:
            more = islice(waiting, max(_UNREAD * self.count() - len(begun), not begun))
            begun.extend(self.submit(each, asker) for each in more)
            result = self.result(begun.popleft(), asker)
            if isinstance(result, Lost) and result.why == "died":
                with suppress(Exception):  # each is raised in its turn
                    for other in begun:
                        self.result(other, asker)
                result = self.result(self.submit(task, asker), asker)
            yield self.work.give_up(task, result) if isinstance(result, Lost) else result


# --- in a worker ------------------------------------------------------------------------------------------------------


def enter(within: Fence | None) -> None:
    """Put the thread that works inside a fence, and leave the other processors to other workers."""
    if within is not None and not is_started_inside():
        within.enter()
    import cv2

    cv2.setNumThreads(1)
