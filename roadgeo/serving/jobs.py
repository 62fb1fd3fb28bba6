"""Requests without waiting: jobs, their progress, and their answers, kept for a while."""

from __future__ import annotations

import asyncio
import errno
import secrets
import shutil
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from starlette.exceptions import HTTPException

from roadgeo.serving.options import ServeOptions
from roadgeo.serving.view import SENT
from roadgeo.serving.workers import ImageRequest, Reply

__all__ = ["Job", "Jobs", "Status"]

Status = Literal["accepted", "running", "successful", "failed", "dismissed"]

#: The status of a job by its answer's; otherwise it failed.
_ENDS: dict[int, Status] = {200: "successful", 410: "dismissed"}

#: Interval of messages that keep a listener's connection, seconds.
_PULSE_S = 10.0


@dataclass
class Job:
    """One image that is being located, or was; known to whoever knows its name, which cannot be guessed.

    Attributes
    ----------
    folder : Path
        Holds the image in `sent`, and all of our own in folders beside that (see `view`). Its name is the job's.
    request : ImageRequest
        The task of a process.
    progress : int or None
        Percent; None before a process takes it.
    answer : Reply or None
        Once there is one nothing more will become of it.
    """

    folder: Path
    request: ImageRequest
    message: str = "waiting for a free process"
    progress: int | None = None
    answer: Reply | None = None
    called_off: threading.Event = field(default_factory=threading.Event)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def id(self) -> str:
        """The job's name."""
        return self.folder.name

    @property
    def status(self) -> Status:
        """How far it is."""
        if self.answer is None:
            return "accepted" if self.progress is None else "running"
        return _ENDS.get(self.answer.status, "failed")

    def tell(self, text: str, share: float | None = None) -> None:
        """Record the progress."""
        self._become(text, 0 if share is None else round(100 * min(max(share, 0.0), 1.0)))

    def end(self, answer: Reply) -> None:
        """Keep the answer."""
        message = str(answer.document.get("reason" if answer.status == 200 else "detail", ""))
        self._become(message, self.progress if answer.status == 410 else 100, answer)

    def call_off(self) -> None:
        """Have nobody wait for it any more."""
        self.called_off.set()
        self.end(Reply(410, {"detail": "it was called off"}))

    def _become(self, message: str, progress: int | None, answer: Reply | None = None) -> None:
        if self.answer is None:
            self.message, self.progress, self.answer = message, progress, answer
            old, self._changed = self._changed, asyncio.Event()
            old.set()

    def to_dict(self) -> dict[str, Any]:
        """Return its state as clients receive it."""
        return {"jobID": self.id, "status": self.status, "message": self.message, "progress": self.progress or 0}

    async def watch(self) -> AsyncIterator[dict[str, Any]]:
        """Yield its state now, whenever that changes, and when nothing happened for a while, until it is over."""
        while self.answer is None:
            changed = self._changed
            yield self.to_dict()
            with suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), _PULSE_S)
        yield self.to_dict()


class Jobs(dict[str, Job]):
    """All jobs by their names; of those that are over the latest are kept."""

    def __init__(self, folder: Path, options: ServeOptions) -> None:
        super().__init__()
        self._folder, self._options = folder, options

    @contextmanager
    def room(self) -> Iterator[Path]:
        """Make a folder for an image, which goes again unless a job is added that lies in it.

        Raises
        ------
        HTTPException
            The image cannot be kept. Where the disk is full the oldest answer goes, that the next one can.
        """
        folder = self._folder / secrets.token_hex(16)
        try:
            folder.mkdir(mode=0o700)
            (folder / SENT).mkdir()
            yield folder
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                self.make_room()
            raise HTTPException(503, f"the image cannot be kept: {error.strerror or error}; come again") from error
        finally:
            if folder.name not in self:
                shutil.rmtree(folder, ignore_errors=True)

    def __missing__(self, name: str) -> Job:
        """Refuse a name that no job has.

        Raises
        ------
        HTTPException
            Always.
        """
        raise HTTPException(404, f"there is no such job; the latest {self._options.kept_jobs} are kept")

    def remove(self, job: Job) -> None:
        """Call a job off, and forget it."""
        job.call_off()
        self.pop(job.id, None)
        shutil.rmtree(job.folder, ignore_errors=True)

    def make_room(self) -> None:
        """Forget the oldest that is over: the disk is full."""
        oldest = next((job for job in self.values() if job.answer is not None), None)
        if oldest is not None:
            self.remove(oldest)

    def let_go(self) -> None:
        """Forget the oldest that are over, as far as there are too many or they take too much room.

        Nothing is kept on disk of jobs that failed.
        """
        over, most = [job for job in self.values() if job.answer is not None], self._options
        for job in over:
            if job.status == "failed":
                shutil.rmtree(job.folder, ignore_errors=True)
        while len(over) > most.kept_jobs or (over[1:] and sum(_size(job.folder) for job in over) > most.kept_bytes):
            self.remove(over.pop(0))


def _size(folder: Path) -> int:
    with suppress(OSError):
        return sum(path.stat().st_size for path in folder.rglob("*"))
    return 0
