"""Work for tests of clusters: squares numbers, and dies where it is told to."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from weakref import WeakSet

__all__ = ["Maps", "Squares"]


@dataclass(frozen=True)
class Squares:
    """Squares numbers; dies once at each of `once`, and always at `always`. Notes each number that it worked on."""

    folder: str
    once: tuple[int, ...] = ()
    always: int = -1

    def prepare(self):
        return self._square

    def give_up(self, task, lost):
        return f"{task}: {lost.said}"

    def _square(self, task):
        with (Path(self.folder) / f"{task}.txt").open("a") as file:
            file.write(f"{os.getpid()}\n")
        seen = Path(self.folder) / f"{task}.txt"
        if task == self.always or (task in self.once and seen.read_text().count("\n") == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        return task * task


class Map:
    """Takes memory."""

    def opened_beside(self, others):
        return others


_open = WeakSet()


class Maps:
    """Opens a map; each result is how many were open in its process already."""

    def prepare(self):
        others, mine = len(_open), Map()
        _open.add(mine)
        return lambda _: mine.opened_beside(others)
