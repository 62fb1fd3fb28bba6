"""Work for tests of clusters: squares numbers, and dies where it is told to."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Squares"]


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
