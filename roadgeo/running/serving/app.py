"""What the server answers: routes, each a few lines; processes locate (`workers`)."""

from __future__ import annotations

import asyncio
import json
import logging
import shutil
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from roadgeo import __version__
from roadgeo.running.serving.documents import DOCUMENTS, documents_of
from roadgeo.running.serving.guard import Guard, refusal, require_body
from roadgeo.running.serving.jobs import Job, Jobs
from roadgeo.running.serving.options import ServeOptions
from roadgeo.running.serving.requests import (
    LIMIT,
    Refused,
    ending_of,
    read_execution,
    read_query_string,
    read_texts,
)
from roadgeo.running.serving.workers import Answer, Asked, Place, Workers

__all__ = ["Service"]

_LOG = logging.getLogger(__name__)

_CHUNK = 1 << 16

#: Hears of each place that is found: of its document, and when its request came.
Told = Callable[[dict[str, Any], float], None]


class Service:
    """The routes, and what they share.

    Attributes
    ----------
    app : Starlette
        Answers requests.
    """

    def __init__(
        self, workers: Workers, references: list[str], options: ServeOptions, folder: Path, told: Told | None = None
    ) -> None:
        """Make the routes; images, and answers that are kept, lie in `folder`."""
        self._workers, self._options, self._told = workers, options, told
        self._jobs, self._folder = Jobs(folder, options), folder
        self._threads = ThreadPoolExecutor(options.workers + options.waiting + 4)
        self._tasks: set[asyncio.Task[None]] = set()
        self.app = Starlette(
            routes=[*_documents(references), *self._routes()],
            middleware=[Middleware(Guard, options=options)],
            exception_handlers={HTTPException: _no_route},
        )

    def _routes(self) -> list[Route]:
        job = "/jobs/{job}"
        return [
            Route("/health", self._health),
            Route("/locate", self._locate, methods=["POST"]),
            Route("/processes/locate/execution", self._execute, methods=["POST"]),
            Route(job, self._job, methods=["GET"]),
            Route(job, self._dismiss, methods=["DELETE"]),
            Route(f"{job}/results", self._results),
            Route(f"{job}/events", self._events),
        ]

    # --- what is asked ------------------------------------------------------------------------------------------------

    async def _health(self, _: Request) -> Response:
        return JSONResponse({"status": "ok", "version": __version__})

    async def _locate(self, request: Request) -> Response:
        kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
        take = self._take_form if kind == "multipart/form-data" else self._take_image
        return await self._serve(request, take, self._options.max_bytes, lambda document: document)

    async def _execute(self, request: Request) -> Response:
        most = min(self._options.max_bytes, self._options.max_json_bytes)
        return await self._serve(request, self._take_execution, most, lambda document: {"location": document})

    async def _serve(
        self,
        request: Request,
        take: Callable[[Request, Path], Awaitable[Job]],
        most: int,
        show: Callable[[dict[str, Any]], dict[str, Any]],
    ) -> Response:
        """Take an image, and locate it at once, or as a job where its sender prefers not to wait."""
        came = time.time()
        require_body(request.headers, most)
        place = self._workers.take_place()
        folder, is_kept = self._make_folder(), False
        try:
            job = await take(request, folder)
            if "respond-async" in request.headers.get("prefer", "").lower():
                self._start(job, place, came)
                is_kept = True
                return _created(job)
            answer = await self._ask(job, came)
            return _said(answer, show)
        except OSError as error:
            if isinstance(error, TimeoutError | ConnectionError):
                raise
            raise Refused(503, f"the image cannot be kept: {error.strerror or error}; come again", 1) from error
        finally:
            if not is_kept:
                place.give_back()
                shutil.rmtree(folder, ignore_errors=True)

    def _make_folder(self) -> Path:
        try:
            return self._jobs.make_folder()
        except OSError as error:
            raise Refused(503, f"the image cannot be kept: {error.strerror or error}; come again", 1) from error

    async def _take_image(self, request: Request, folder: Path) -> Job:
        """Take an image that is the body; hints stand in the URL."""
        hints = read_query_string(request.url.query)
        return _job_of(folder, await _keep_body(request, folder), "", hints)

    async def _take_form(self, request: Request, folder: Path) -> Job:
        """Take a form as browsers and `curl -F` send it: an image, and hints beside it or in the URL."""
        hints = read_query_string(request.url.query)
        body, part = await _keep_body(request, folder), folder / "part"

        async def chunks() -> AsyncGenerator[bytes, None]:
            with body.open("rb") as file:
                while chunk := file.read(_CHUNK):
                    yield chunk

        parser = MultiPartParser(request.headers, chunks(), max_files=1, max_fields=20, max_part_size=4096)
        try:
            form = await parser.parse()
            image = form.get("image")
            if not isinstance(image, UploadFile):
                raise Refused(400, "expected a form with a file named image: curl -F image=@photo.jpg")
            hints |= read_texts({key: value for key, value in form.items() if isinstance(value, str)})
            with part.open("wb") as file:
                await asyncio.to_thread(shutil.copyfileobj, image.file, file)
        except MultiPartException as error:
            raise Refused(400, f"no form that can be read: {error.message}") from error
        finally:
            for spooled in parser._files_to_close_on_error:  # those of a torn form would stay open
                spooled.close()
        body.unlink()
        return _job_of(folder, part, image.filename or "", hints)

    async def _take_execution(self, request: Request, folder: Path) -> Job:
        """Take an execute request of OGC API - Processes: all of it is JSON."""
        most, body = min(self._options.max_bytes, self._options.max_json_bytes), bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > most:
                raise Refused(413, f"JSON of more than {most:,} bytes; post the image itself to /locate")
        image, hints = read_execution(bytes(body))
        part = folder / "image"
        part.write_bytes(image)
        return _job_of(folder, part, "", hints)

    # --- how it is located --------------------------------------------------------------------------------------------

    async def _ask(self, job: Job, came: float, tells: bool = False) -> Answer:
        """Have a process locate an image, and tell others of its place."""
        loop, hints = asyncio.get_running_loop(), dict(job.hints)
        limit = min(hints.pop(LIMIT, self._options.time_limit_s), self._options.time_limit_s)
        asked = Asked(str(job.path), hints, limit, self._options.max_pixels, job.name, tells)

        def say(text: str, share: float | None = None) -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(job.tell, text, share)

        ask = partial(self._workers.ask, asked, say, job.called_off)
        answer = await loop.run_in_executor(self._threads, ask)
        if answer.status == 200 and self._told is not None:
            await loop.run_in_executor(self._threads, self._tell, self._told, answer.document, came)
        return answer

    def _tell(self, told: Told, document: dict[str, Any], came: float) -> None:
        """Tell others of a place; what they make of it is not the matter of who asked."""
        try:
            told(document, came)
        except Exception:
            _LOG.exception("a place could not be told")

    def _start(self, job: Job, place: Place, came: float) -> None:
        """Locate while nobody waits."""

        async def work() -> None:
            try:
                job.end(await self._ask(job, came, tells=True))
            except Exception:
                _LOG.exception("a fault of the server at a job")
                job.end(Answer(500, {"detail": "a fault of roadgeo: its log tells which"}))
            finally:
                place.give_back()
                self._jobs.let_go()

        self._jobs.add(job)
        task = asyncio.get_running_loop().create_task(work())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # --- jobs ---------------------------------------------------------------------------------------------------------

    def _find(self, request: Request) -> Job:
        job = self._jobs.find(request.path_params["job"])
        if job is None:
            raise Refused(404, f"there is no such job; the latest {self._options.kept_jobs} are kept")
        return job

    async def _job(self, request: Request) -> Response:
        return JSONResponse(self._find(request).to_dict())

    async def _dismiss(self, request: Request) -> Response:
        job = self._find(request)
        self._jobs.remove(job)
        return JSONResponse({**job.to_dict(), "status": "dismissed"})

    async def _results(self, request: Request) -> Response:
        job = self._find(request)
        if job.answer is None:
            raise Refused(404, f"the job is {job.status}: there is no result yet")
        return _said(job.answer, lambda document: {"location": document})

    async def _events(self, request: Request) -> Response:
        """Tell a job's state whenever it changes, as server-sent events."""
        job = self._find(request)

        async def tell() -> AsyncIterator[str]:
            async for state in job.watch():
                yield ": still here\n\n" if state is None else f"data: {json.dumps(state)}\n\n"

        return StreamingResponse(tell(), headers={"Cache-Control": "no-store"}, media_type="text/event-stream")

    def close(self) -> None:
        """Wait for nobody any more."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _documents(references: list[str]) -> list[Route]:
    documents = documents_of(references)

    def route(path: str) -> Route:
        async def answer(_: Request) -> Response:
            return JSONResponse(documents[path])

        return Route(path, answer)

    return [route(path) for path in DOCUMENTS]


async def _keep_body(request: Request, folder: Path) -> Path:
    """Write a body to a file as it comes."""
    path = folder / "body"
    with path.open("wb") as file:
        async for chunk in request.stream():
            file.write(chunk)
    return path


def _job_of(folder: Path, part: Path, name: str, hints: dict[str, Any]) -> Job:
    """Return the job of an image that has come, under a name that says what it is."""
    with part.open("rb") as file:
        ending = ending_of(file.read(16))
    image = part.rename(folder / f"image{ending}")
    return Job(folder, image.name, Path(name.replace("\\", "/")).name[:200], hints)


def _created(job: Job) -> Response:
    headers = {"Location": f"/jobs/{job.id}", "Preference-Applied": "respond-async"}
    return JSONResponse(job.to_dict(), 201, headers)


def _said(answer: Answer, show: Callable[[dict[str, Any]], dict[str, Any]]) -> Response:
    if answer.status >= 400:
        return refusal(Refused(answer.status, answer.document["detail"], 1 if answer.status == 503 else None))
    return JSONResponse(show(answer.document))


async def _no_route(request: Request, error: Exception) -> Response:
    """Say that there is nothing, or nothing of this kind."""
    status = getattr(error, "status_code", 404)
    if status == 405:
        allowed = (getattr(error, "headers", None) or {}).get("Allow", "GET")
        response = refusal(Refused(405, f"expected {allowed}"))
        response.headers["Allow"] = allowed
        return response
    if status != 404:
        return refusal(Refused(status, str(getattr(error, "detail", error))[:200]))
    return refusal(Refused(404, f"there is nothing at {request.url.path[:80]}; begin at /"))
