"""Processes that locate for the server: what they are given may break them, and then another one is started.

Only so many requests may work or wait at once; whoever comes then is told to come again.
"""

from __future__ import annotations

import multiprocessing
import queue
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

__all__ = ["Answer", "Asked", "Full", "Workers"]

#: A process that has not answered so long after its time limit is ended.
_GRACE_S = 15.0


class Full(Exception):  # noqa: N818 (a state of the server, not a fault)
    """As many requests as may be are working or waiting."""


@dataclass(frozen=True)
class Asked:
    """What to locate.

    Attributes
    ----------
    path : str
        The file that holds it.
    hints : dict
        `near`, `gsd_m`, `max_tilt_deg`, `focal_px`, `north_up`, as far as they are known.
    """

    path: str
    hints: dict[str, Any]
    time_limit_s: float
    max_pixels: int


@dataclass(frozen=True)
class Answer:
    """An HTTP status, and the document or, from 400 on, the sentence that says what is wrong."""

    status: int
    document: dict[str, Any]


class Workers:
    """Processes, each with its references open."""

    def __init__(self, references: Sequence[str], count: int, waiting: int) -> None:
        """Start them; `waiting` more requests than there are processes may wait."""
        self._references = list(references)
        self._context = multiprocessing.get_context("spawn")
        self._idle: queue.Queue[_Worker] = queue.Queue()
        self._places = threading.Semaphore(count + waiting)
        self._all: list[_Worker] = []
        self._lock = threading.Lock()
        self._closed = False
        for worker in [_Worker(self._context, self._references) for _ in range(count)]:
            self._all.append(worker)
            worker.wait_until_ready()
            self._idle.put(worker)

    def is_full(self) -> bool:
        """Whether a request that came now would be refused."""
        if self._places.acquire(blocking=False):
            self._places.release()
            return False
        return True

    def ask(self, asked: Asked) -> Answer:
        """Have one process locate, as soon as one is free.

        Raises
        ------
        Full
            Too many wait already.
        """
        if not self._places.acquire(blocking=False):
            raise Full
        try:
            worker = self._idle.get()
            try:
                answer = worker.ask(asked)
                if answer is None:
                    worker = self._replace(worker)
                    return Answer(500, {"detail": "the process that worked on it was ended: it took too long or broke"})
                return answer
            finally:
                self._idle.put(worker)
        finally:
            self._places.release()

    def _replace(self, broken: _Worker) -> _Worker:
        broken.end()
        fresh = _Worker(self._context, self._references)
        with self._lock:
            self._all = [fresh if one is broken else one for one in self._all]
            if self._closed:
                fresh.end()
        return fresh

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            self._closed = True
            for worker in self._all:
                worker.end()


class _Worker:
    """One process, and the pipe to it."""

    def __init__(self, context: Any, references: list[str]) -> None:
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, references), daemon=True)
        self._process.start()
        theirs.close()

    def wait_until_ready(self) -> None:
        """Wait for its references to be open.

        Raises
        ------
        IndexFormatError
            One cannot be opened.
        """
        from roadgeo.errors import IndexFormatError

        try:
            said = self._pipe.recv()
        except EOFError:
            said = "a process of the server ended while it opened the references"
        if said is not True:
            raise IndexFormatError(str(said))

    def ask(self, asked: Asked) -> Answer | None:
        """Return its answer; None where it gave none."""
        try:
            self._pipe.send(asked)
            deadline = asked.time_limit_s + _GRACE_S
            while self._pipe.poll(deadline):
                said = self._pipe.recv()
                if isinstance(said, Answer):
                    return said
                if said is not True:  # a fresh process whose references cannot be opened
                    return Answer(503, {"detail": str(said)})
        except (EOFError, OSError):
            pass
        return None

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join(5.0)
        self._pipe.close()


# --- in the process ---------------------------------------------------------------------------------------------------


def _serve(pipe: Connection, names: list[str]) -> None:
    """Answer until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import cv2

    from roadgeo.errors import RoadgeoError
    from roadgeo.kernels.warmup import warm_up
    from roadgeo.running.batch import open_references

    cv2.setNumThreads(1)
    try:
        references = open_references(names)
        warm_up()
    except RoadgeoError as error:
        pipe.send(str(error))
        return
    pipe.send(True)
    try:
        while True:
            pipe.send(_locate(pipe.recv(), references))
    except (EOFError, OSError):
        return


def _locate(asked: Asked, references: Sequence[Any]) -> Answer:
    from dataclasses import replace

    from roadgeo.errors import MaskError, RoadgeoError
    from roadgeo.running.queries import locate_query
    from roadgeo.workflows import LocateOptions

    try:
        width, height = _size(asked.path)
        if width * height > asked.max_pixels:
            told = f"{width} x {height} pixels, expected at most {asked.max_pixels:,} in all: reduce it"
            return Answer(413, {"detail": told})
        default = LocateOptions()
        hints = dict(asked.hints)
        near = hints.pop("near", None)
        match = replace(default.match, camera=replace(default.match.camera, **hints))
        search = replace(default.search, time_limit_s=asked.time_limit_s)
        options = replace(default, near=near, match=match, search=search)
        location = replace(locate_query(asked.path, references, options).location, query="")
        return Answer(200, location.to_dict())
    except MaskError as error:
        return Answer(422, {"detail": _without(asked.path, str(error))})
    except RoadgeoError as error:
        return Answer(500, {"detail": _without(asked.path, str(error))})
    except Exception as error:
        return Answer(
            500, {"detail": f"a fault of roadgeo: {type(error).__name__}: {_without(asked.path, str(error))}"}
        )


def _size(path: str) -> tuple[int, int]:
    """Return (width, height) of an image without unpacking it."""
    from roadgeo.storage.rasters import image_size, open_raster

    told = image_size(Path(path))
    if told is not None:
        return told[0], told[1]
    with open_raster(path) as dataset:
        return int(dataset.width), int(dataset.height)


def _without(path: str, message: str) -> str:
    """Leave out of a message where the server keeps files."""
    return message.replace(path, "the image").replace(str(Path(path).parent), "")
