"""Processes that locate for the server: a hostile image may break them, and then another one is started.

A bounded number of requests may work or wait at once; further ones are asked to come again. A process that breaks costs
nobody an answer, unless the next one breaks by the same image.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from starlette.exceptions import HTTPException

from roadgeo._progress import Say, say_nothing
from roadgeo._text import log_of
from roadgeo.errors import MaskError, ModelError, NotLocatedError, OutputError, RoadgeoError
from roadgeo.running.pool import Asker, Lost
from roadgeo.running.processes import Processes, tell
from roadgeo.storage.fence import Fence

__all__ = ["ImageRequest", "ImageWorkers", "Reply", "Serving"]

_LOG = log_of(__name__)

#: A process that has not answered this long after its time limit is ended.
_GRACE_S = 15.0
#: The same where progress is reported, and the client may cancel: a busy machine is no fault.
_PATIENT_S = 90.0

#: The status of an error about an image; of others it is 500. Photographs need a network that may not be there.
_STATUSES: dict[type[RoadgeoError], int] = {
    MaskError: 422,
    NotLocatedError: 422,
    OutputError: 422,
    ModelError: 415,
}
#: The status of a lost task, and the sentence about it.
_LOST = {
    "died": (500, "it broke two processes, one after another; send another image"),
    "late": (503, "it took {} and was ended; reduce the image, or come again when less is asked"),
    "called off": (410, "it was called off"),
    "no worker": (503, "{}; come again"),
}


@dataclass(frozen=True)
class ImageRequest:
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
class Reply:
    """An HTTP status, and the document or, from 400 on, the sentence that describes the error.

    Attributes
    ----------
    lacks_view : bool
        Whether there was no room on the disk for the page's view of it.
    """

    status: int
    document: dict[str, Any]
    lacks_view: bool = False


class ImageWorkers:
    """Processes, each with its references open, and a network for photographs that is loaded.

    Attributes
    ----------
    folder : Path
        For images, until the processes are ended. If the server is killed they remove it.
    """

    def __init__(
        self, references: Sequence[str], count: int, waiting: int, threads: int = 1, fence: Fence | None = None
    ) -> None:
        """Start them, each inside a fence.

        `waiting` more requests than there are processes may wait, and the network has `threads`.

        Raises
        ------
        RoadgeoError
            A reference cannot be opened.
        """
        self._temporary = TemporaryDirectory(prefix="roadgeo-", ignore_cleanup_errors=True)
        own = self._temporary.name
        self.folder = Path(own)
        within = fence and replace(fence, write=(*fence.write, own), temporary=own)
        self._processes = Processes(Serving(tuple(references), threads), count, own, within)
        self._places = threading.Semaphore(count + waiting)
        try:
            self._processes.wait_until_ready()
        except BaseException:
            self.close()
            raise

    def take_place(self) -> ExitStack:
        """Take the right of one request to wait for a process and to have it, until its context ends.

        Raises
        ------
        HTTPException
            Too many work or wait already.
        """
        if not self._places.acquire(blocking=False):
            raise HTTPException(503, "as many requests as may be are waiting; come again")
        place = ExitStack()
        place.callback(self._places.release)
        return place

    def ask(self, request: ImageRequest, say: Say = say_nothing, called_off: threading.Event | None = None) -> Reply:
        """Have one process locate, as soon as one is free; who asks holds a place.

        Parameters
        ----------
        say
            Called with the progress.
        called_off : Event, optional
            Once it is set nobody waits for the answer any more.
        """
        patience_s = request.time_limit_s + (_PATIENT_S if request.keeps else _GRACE_S)
        asker = Asker(patience_s, say, called_off or threading.Event())
        try:
            reply: Reply = next(self._processes.run([request], asker))
        except RoadgeoError as error:  # a process that was started anew cannot open the references any more
            return Reply(503, {"detail": str(error)})
        return reply

    def close(self) -> None:
        """End all processes."""
        self._processes.close()
        self._temporary.cleanup()


# --- in the process ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Serving:
    """The work of a process."""

    references: tuple[str, ...]
    threads: int

    def prepare(self) -> Callable[[ImageRequest], Reply]:
        """Open the references, and load the network."""
        from roadgeo.kernels.warmup import warm_up
        from roadgeo.reference.opening import open_references
        from roadgeo.running.photographs import load_model

        references = open_references(self.references)
        warm_up()
        with suppress(ModelError):  # masks are located without it
            load_model("", None, self.threads)
        return lambda request: _reply(request, references, tell if request.keeps else say_nothing, self.threads)

    def give_up(self, task: ImageRequest, lost: Lost) -> Reply:  # noqa: ARG002 (it says the same of each)
        """Tell why there is no answer."""
        _LOG.warning("no answer: %s", lost.said)
        status, sentence = _LOST[lost.why]
        return Reply(status, {"detail": sentence.format(lost.said)})


def _reply(request: ImageRequest, references: Sequence[Any], say: Say = say_nothing, threads: int = 1) -> Reply:
    """Locate the image, or write an output; the one place where what goes wrong with an image is caught."""
    try:
        return _write(request, references) if request.wanted else _locate(request, references, say, threads)
    except RoadgeoError as error:
        status = next((status for kind, status in _STATUSES.items() if isinstance(error, kind)), 500)
        detail = str(error)
    except Exception as error:
        _LOG.exception("a fault of roadgeo")
        status, detail = 500, f"a fault of roadgeo: {type(error).__name__}: {error}"
    return Reply(status, {"detail": _without(request.path, detail)})


def _locate(request: ImageRequest, references: Sequence[Any], say: Say, threads: int) -> Reply:
    import numpy as np

    from roadgeo.matching.hints import apply_hints, asked_of_camera
    from roadgeo.reference.opening import digest_of, say_swapped
    from roadgeo.running.choosing import place_by_points, take_place
    from roadgeo.running.locating import changed_options
    from roadgeo.running.options import ReadOptions
    from roadgeo.running.queries import locate_query
    from roadgeo.serving.view import OWN, SEEN, read_sighting, write_view
    from roadgeo.sources.camera import read_stated
    from roadgeo.storage.rasters import raster_size
    from roadgeo.workflows import LocateOptions, locate

    def search(*arguments: Any) -> Any:
        say("searching the map")
        return partial(locate, say=say)(*arguments)

    def tell(text: str, share: float | None = None) -> None:
        say(_without(request.path, text), share)

    width, height = raster_size(request.path)
    if width * height > request.max_pixels:
        detail = f"{width} x {height} pixels, expected at most {request.max_pixels:,} in all: reduce it"
        return Reply(413, {"detail": detail})
    hints = {**request.hints, "time_limit_s": request.time_limit_s}
    hints.update(read_stated(asked_of_camera(hints), request.path))
    taken, points = hints.pop("take", None), hints.pop("points", None)
    options = apply_hints(LocateOptions(), hints)
    if said := say_swapped(options.near, references):
        return Reply(400, {"detail": said})
    # Which roads a photograph shows does not depend on where it lies: found once, they are not looked for again. How
    # large its pixels are would change what the network is shown.
    kept = Path(request.path).parent.with_name(OWN) / SEEN
    has_probability = kept.is_file() and not request.hints.keys() & {"gsd_m", "focal_px"}
    say("reading the image")
    image, query = str(kept) if has_probability else request.path, ReadOptions(threads=threads)
    # Of an answer whose place is taken, or whose image is placed by points.
    sighting = None if taken is None and points is None else read_sighting(Path(request.path))
    if sighting is None:
        sighting = locate_query(image, references, options, query, how=search, say=tell)
        sighting = sighting.showing(kind="photograph") if has_probability else sighting
    if taken is not None:
        sighting = sighting.answering(take_place(sighting.location, taken, options))
    if points is not None:
        sighting = sighting.answering(place_by_points(sighting.location, np.array(points), references))
    location = replace(
        sighting.location,
        query=request.name,
        options=changed_options(options, LocateOptions()),
        reference_digest=digest_of(references, sighting.location.reference),
    )
    location = replace(location, reason=_without(request.path, _without(str(kept), location.reason)))
    lacks_view = False
    if request.keeps:
        say("drawing the answer")
        try:
            write_view(Path(request.path), replace(sighting, location=location), references)
        except OSError:  # a full disk: the place was found all the same
            _LOG.exception("an answer is kept without its view")
            lacks_view = True
    return Reply(200, location.to_dict(), lacks_view)


def _write(request: ImageRequest, references: Sequence[Any]) -> Reply:
    from roadgeo.serving.view import write_output

    return Reply(200, {"file": str(write_output(Path(request.path), request.wanted, references))})


def _without(path: str, message: str) -> str:
    """Leave out of a message where the server keeps files."""
    return message.replace(path, "the image").replace(str(Path(path).parent), "")
