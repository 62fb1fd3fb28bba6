"""Processes that locate for the server: a hostile image may break them, and then another one is started.

A bounded number of requests may work or wait at once; further ones are asked to come again. A process that breaks costs
nobody an answer, unless the next one breaks by the same image.
"""

from __future__ import annotations

import logging
import multiprocessing
import queue
import shutil
import signal
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from starlette.exceptions import HTTPException

from roadgeo._progress import Say, say_nothing
from roadgeo.running.processes import end_with_parent, without_interrupts

__all__ = ["Answer", "Asked", "Full", "Workers"]

_LOG = logging.getLogger(__name__)

#: A process that has not answered this long after its time limit is ended.
_GRACE_S = 15.0
#: The same where progress is reported, and the client may cancel: a busy machine is no fault.
_PATIENT_S = 90.0
#: Time to open its references.
_START_S = 120.0
#: Interval of checks whether the client still waits.
_GLANCE_S = 0.25
#: Processes that are given an image, one after another, as long as they break.
_TRIES = 2


class Full(HTTPException):
    """As many requests as may be are working or waiting."""

    def __init__(self) -> None:
        super().__init__(503, "as many requests as may be are waiting; come again")


@dataclass(frozen=True)
class Asked:
    """A request to locate.

    Attributes
    ----------
    path : str
        The file that holds it.
    hints : dict
        `near`, `within`, `gsd_m`, `max_tilt_deg`, `focal_px`, `north_up`, as far as they are known.
    name : str
        Name of the image in the answer.
    keeps : bool
        Whether progress is reported, and the page's view is kept beside the file (see `view`).
    wanted : str
        The name of an output of an answer that was kept so, which is asked for instead of a place.
    """

    path: str
    hints: dict[str, Any]
    time_limit_s: float
    max_pixels: int
    name: str = ""
    keeps: bool = False
    wanted: str = ""


@dataclass(frozen=True)
class Answer:
    """An HTTP status, and the document or, from 400 on, the sentence that describes the error.

    Attributes
    ----------
    lacks_view : bool
        Whether there was no room on the disk for the page's view of it.
    """

    status: int
    document: dict[str, Any]
    lacks_view: bool = False


class CalledOff(Exception):  # noqa: N818 (a wish, not a fault)
    """Nobody waits for an answer any more."""


class Workers:
    """Processes, each with its references open, and a network for photographs that is loaded.

    Attributes
    ----------
    folder : Path
        For images, until the processes are ended. If the server is killed they remove it.
    """

    def __init__(self, references: Sequence[str], count: int, waiting: int, threads: int = 1) -> None:
        """Start them; `waiting` more requests than there are processes may wait, and the network has `threads`."""
        context = multiprocessing.get_context("spawn")
        self._temporary = TemporaryDirectory(prefix="roadgeo-", ignore_cleanup_errors=True)
        self.folder = Path(self._temporary.name)
        given = (list(references), threads, self.folder)
        self._idle: queue.Queue[_Worker] = queue.Queue()
        self._places = threading.Semaphore(count + waiting)
        self._all: list[_Worker] = []
        self._lock = threading.Lock()
        self._closed = False
        try:
            for _ in range(count):
                self._all.append(_Worker(context, given))
            for worker in self._all:
                worker.wait_until_ready()
                self._idle.put(worker)
        except BaseException:
            self.close()
            raise

    def take_place(self) -> ExitStack:
        """Take the right of one request to wait for a process and to have it, until its context ends.

        Raises
        ------
        Full
            Too many work or wait already.
        """
        if not self._places.acquire(blocking=False):
            raise Full
        place = ExitStack()
        place.callback(self._places.release)
        return place

    def ask(self, asked: Asked, say: Say = say_nothing, called_off: threading.Event | None = None) -> Answer:
        """Have one process locate, as soon as one is free; who asks holds a place.

        Parameters
        ----------
        say
            Called with the progress.
        called_off : Event, optional
            Once it is set nobody waits for the answer any more.
        """
        worker = self._idle.get()
        try:
            return self._ask(worker, asked, say, called_off or threading.Event())
        finally:
            self._idle.put(worker)

    def _ask(self, worker: _Worker, asked: Asked, say: Say, called_off: threading.Event) -> Answer:
        """Ask a process; where it breaks start it anew and ask again, for it may have broken while it was idle."""
        try:
            for _ in range(_TRIES):
                if called_off.is_set():
                    break
                try:
                    return worker.ask(asked, say, called_off)
                except CalledOff:
                    self._restart(worker, "nobody waits for its answer any more")
                except TimeoutError as error:
                    self._restart(worker, f"it took {error}")
                    detail = f"it took {error} and was ended; reduce the image, or come again when less is asked"
                    return Answer(503, {"detail": detail})
                except (EOFError, OSError) as error:
                    self._restart(worker, f"it broke ({type(error).__name__})")
        except OSError as error:
            return Answer(503, {"detail": f"no process can be started: {error.strerror or error}; come again"})
        if called_off.is_set():
            return Answer(410, {"detail": "it was called off"})
        return Answer(500, {"detail": f"it broke {_TRIES} processes, one after another; send another image"})

    def _restart(self, worker: _Worker, why: str) -> None:
        with self._lock:
            if self._closed:
                raise OSError("the server is ending")
            _LOG.warning("a process of the server is started anew: %s", why)
            worker.end()
            worker.start()

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            self._closed = True
            for worker in self._all:
                worker.end()
        self._temporary.cleanup()


class _Worker:
    """One process, and the pipe to it."""

    def __init__(self, context: Any, given: tuple[list[str], int, Path]) -> None:
        self._context, self._given = context, given
        self.start()

    def start(self) -> None:
        """Start the process.

        Raises
        ------
        OSError
            The system has no room for it.
        """
        self._opened: Answer | None = None
        self._pipe, theirs = self._context.Pipe()
        try:
            process = self._context.Process(target=_serve, args=(theirs, *self._given), daemon=True)
            with without_interrupts():
                process.start()
        finally:
            theirs.close()
        self._process = process

    def wait_until_ready(self) -> None:
        """Wait for its references to be open.

        Raises
        ------
        IndexFormatError
            One cannot be opened.
        """
        from roadgeo.errors import IndexFormatError

        try:
            self._opened = self._hear(_START_S)
        except (EOFError, OSError):
            self._opened = Answer(503, {"detail": "a process of the server ended while it opened the references"})
        if self._opened.status != 200:
            raise IndexFormatError(self._opened.document["detail"])

    def ask(self, asked: Asked, say: Say, called_off: threading.Event) -> Answer:
        """Return its answer; of a fresh process whose references cannot be opened, the reason.

        Raises
        ------
        TimeoutError
            It takes too long.
        CalledOff
            Nobody waits any more.
        EOFError, OSError
            The process has ended.
        """
        self._opened = self._opened or self._hear(_START_S)
        if self._opened.status != 200:
            return self._opened
        self._pipe.send(asked)
        return self._hear(asked.time_limit_s + (_PATIENT_S if asked.keeps else _GRACE_S), say, called_off)

    def _hear(self, patience_s: float, say: Say = say_nothing, called_off: threading.Event | None = None) -> Answer:
        """Wait for an answer, the first of which is whether the references are open, and pass the progress on."""
        until = time.monotonic() + patience_s
        while time.monotonic() < until:
            if called_off is not None and called_off.is_set():
                raise CalledOff
            if self._pipe.poll(min(_GLANCE_S, patience_s)):
                message = self._pipe.recv()
                if isinstance(message, Answer):
                    return message
                say(*message)
        raise TimeoutError(f"longer than {patience_s:g} s")

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join(5.0)
        self._pipe.close()


# --- in the process ---------------------------------------------------------------------------------------------------


def _serve(pipe: Connection, names: list[str], threads: int, folder: Path) -> None:
    """Answer until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(partial(shutil.rmtree, folder, ignore_errors=True))
    import cv2

    from roadgeo.errors import ModelError, RoadgeoError
    from roadgeo.kernels.warmup import warm_up
    from roadgeo.running.batch import open_references
    from roadgeo.running.photographs import load_model

    cv2.setNumThreads(1)
    try:
        references = open_references(names)
        warm_up()
        with suppress(ModelError):  # masks are located without it
            load_model("", None, threads)
    except RoadgeoError as error:
        pipe.send(Answer(503, {"detail": str(error)}))
        return
    pipe.send(Answer(200, {}))
    try:
        while True:
            asked: Asked = pipe.recv()
            say = partial(_tell, pipe) if asked.keeps else say_nothing
            pipe.send(_answer(asked, references, say, threads))
    except (EOFError, OSError):
        return


def _tell(pipe: Connection, text: str, share: float | None = None) -> None:
    pipe.send((text, share))


def _answer(asked: Asked, references: Sequence[Any], say: Say = say_nothing, threads: int = 1) -> Answer:
    """Do what is asked; the one place where what goes wrong with an image is caught."""
    from roadgeo.errors import MaskError, ModelError, OutputError, RoadgeoError

    try:
        return _write(asked, references) if asked.wanted else _locate(asked, references, say, threads)
    except (MaskError, OutputError) as error:
        return Answer(422, {"detail": _without(asked.path, str(error))})
    except ModelError as error:  # the image is a photograph, and none are read here
        return Answer(415, {"detail": _without(asked.path, str(error))})
    except RoadgeoError as error:
        return Answer(500, {"detail": _without(asked.path, str(error))})
    except Exception as error:
        _LOG.exception("a fault of roadgeo")
        return Answer(
            500, {"detail": f"a fault of roadgeo: {type(error).__name__}: {_without(asked.path, str(error))}"}
        )


def _locate(asked: Asked, references: Sequence[Any], say: Say, threads: int) -> Answer:
    from dataclasses import replace

    from roadgeo.matching.hints import apply_hints
    from roadgeo.running.options import ReadOptions
    from roadgeo.running.queries import locate_query
    from roadgeo.serving.view import OWN, SEEN, write_view
    from roadgeo.sources.exif import focal_in_pixels
    from roadgeo.storage.rasters import raster_size
    from roadgeo.workflows import LocateOptions, locate

    def search(*asked_of: Any) -> Any:
        say("searching the map")
        return locate(*asked_of)

    def tell(text: str, share: float | None = None) -> None:
        say(_without(asked.path, text), share)

    width, height = raster_size(asked.path)
    if width * height > asked.max_pixels:
        detail = f"{width} x {height} pixels, expected at most {asked.max_pixels:,} in all: reduce it"
        return Answer(413, {"detail": detail})
    hints = {**asked.hints, "time_limit_s": asked.time_limit_s}
    if hints.get("focal_px") == "exif":
        hints["focal_px"] = focal_in_pixels(asked.path)
    options = replace(apply_hints(LocateOptions(), hints), take=hints.get("take"))
    # Which roads a photograph shows does not depend on where it lies: found once, they are not looked for again. How
    # large its pixels are would change what the network is shown.
    seen = Path(asked.path).parent.with_name(OWN) / SEEN
    is_known = seen.is_file() and not asked.hints.keys() & {"gsd_m", "focal_px"}
    say("reading the image")
    image, query = str(seen) if is_known else asked.path, ReadOptions(threads=threads)
    sighting = locate_query(image, references, options, query, how=search, say=tell)
    sighting = replace(sighting, of_photograph=sighting.of_photograph or is_known)
    location = replace(sighting.location, query=asked.name)
    location = replace(location, reason=_without(asked.path, _without(str(seen), location.reason)))
    lacks_view = False
    if asked.keeps:
        say("drawing the answer")
        try:
            write_view(Path(asked.path), replace(sighting, location=location), references)
        except OSError:  # a full disk: the place was found all the same
            _LOG.exception("an answer is kept without its view")
            lacks_view = True
    return Answer(200, location.to_dict(), lacks_view)


def _write(asked: Asked, references: Sequence[Any]) -> Answer:
    from roadgeo.serving.view import write_output

    return Answer(200, {"file": str(write_output(Path(asked.path), asked.wanted, references))})


def _without(path: str, message: str) -> str:
    """Leave out of a message where the server keeps files."""
    return message.replace(path, "the image").replace(str(Path(path).parent), "")
