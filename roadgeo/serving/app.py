"""Routes of the server, each a few lines; processes locate (`workers`)."""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import shutil
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
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
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from roadgeo import __version__
from roadgeo.reference.reference import AnyReference
from roadgeo.serving.documents import documents_of
from roadgeo.serving.guard import COOKIE, Guard, is_same, pass_of, refusal, require_body
from roadgeo.serving.jobs import Job, Jobs
from roadgeo.serving.options import ServeOptions
from roadgeo.serving.page import page_file, page_text, policy_of
from roadgeo.serving.requests import (
    LIMIT,
    Refused,
    ending_of,
    read_execution,
    read_hints,
    read_query_string,
)
from roadgeo.serving.tiles import MAX_ZOOM, Tiles
from roadgeo.serving.view import OFFERED, OWN, PICTURE, SEEN, SENT, VIEW, WARPED, safe_stem
from roadgeo.serving.workers import Answer, Asked, Place, Workers

__all__ = ["Service"]

_LOG = logging.getLogger(__name__)

_CHUNK = 1 << 16
#: Time to make a file of an answer, seconds; length of a token.
_WRITE_S, _MOST_TOKEN = 60.0, 4096

#: Headers of files that never change under their address, and of those that change with roadgeo itself.
_FOR_EVER = {"Cache-Control": "private, max-age=86400, immutable"}
_AS_IT_IS = {"Cache-Control": "no-cache"}

#: Hears of each place that is found: of its document, and when its request came.
Told = Callable[[dict[str, Any], float], None]


class Service:
    """The routes, and their shared state.

    Attributes
    ----------
    app : Starlette
        Answers requests.
    """

    def __init__(
        self,
        workers: Workers,
        references: Sequence[AnyReference],
        options: ServeOptions,
        folder: Path,
        told: Told | None = None,
    ) -> None:
        """Make the routes; images, and answers that are kept, lie in `folder`."""
        self._workers, self._options, self._told = workers, options, told
        self._jobs, self._tiles = Jobs(folder, options), Tiles(references)
        self._threads = ThreadPoolExecutor(options.workers + options.waiting + 4)
        self._drawing = ThreadPoolExecutor(1)  # whatever maps are looked at, the rest of the machine searches
        self._documents, self._policy = documents_of([one.name for one in references]), policy_of(options)
        self._tasks: set[asyncio.Task[None]] = set()
        self.app = Starlette(
            routes=[*self._routes(), *_document_routes(self._documents)],
            middleware=[Middleware(Guard, options=options)],
            exception_handlers={HTTPException: _no_route},
        )

    def _routes(self) -> list[Route]:
        job = "/jobs/{job}"
        return [
            Route("/", self._landing),
            Route("/page/{name}", self._page),
            Route("/session", self._open_session, methods=["POST"]),
            Route("/references", self._references),
            Route("/tiles/{reference:int}/{zoom:int}/{column:int}/{row:int}.mvt", self._tile),
            Route("/health", self._health),
            Route("/locate", self._locate, methods=["POST"]),
            Route("/processes/locate/execution", self._execute, methods=["POST"]),
            Route(job, self._job, methods=["GET"]),
            Route(job, self._dismiss, methods=["DELETE"]),
            Route(f"{job}/results", self._results),
            Route(f"{job}/events", self._events),
            Route(f"{job}/again", self._again, methods=["POST"]),
            Route(f"{job}/files", self._files),
            Route(f"{job}/files/{{name}}", self._file),
            Route(f"{job}/{{name}}", self._shown),
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
            raise self._make_room(error) from error
        finally:
            if not is_kept:
                place.give_back()
                shutil.rmtree(folder, ignore_errors=True)

    def _make_folder(self) -> Path:
        try:
            return self._jobs.make_folder()
        except OSError as error:
            raise self._make_room(error) from error

    def _make_room(self, error: OSError) -> Refused:
        """Let the oldest answer go where the disk is full; return what its sender is asked for: to come again."""
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            self._jobs.make_room()
        return Refused(503, f"the image cannot be kept: {error.strerror or error}; come again", 1)

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
            hints |= read_hints({key: value for key, value in form.items() if isinstance(value, str)})
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

    async def _ask(self, job: Job, came: float, keeps: bool = False) -> Answer:
        """Have a process locate an image, and report its place to listeners."""
        loop, hints = asyncio.get_running_loop(), dict(job.hints)
        limit = min(hints.pop(LIMIT, self._options.time_limit_s), self._options.time_limit_s)
        asked = Asked(str(job.path), hints, limit, self._options.max_pixels, job.name, keeps)

        def say(text: str, share: float | None = None) -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(job.tell, text, share)

        ask = partial(self._workers.ask, asked, say, job.called_off)
        answer = await loop.run_in_executor(self._threads, ask)
        if answer.status == 200 and self._told is not None:
            await loop.run_in_executor(self._threads, self._tell, self._told, answer.document, came)
        return answer

    def _tell(self, told: Told, document: dict[str, Any], came: float) -> None:
        """Report a place to listeners; their errors do not concern the client."""
        try:
            told(document, came)
        except Exception:
            _LOG.exception("a place could not be told")

    def _start(self, job: Job, place: Place, came: float) -> None:
        """Locate while nobody waits."""

        async def work() -> None:
            try:
                answer = await self._ask(job, came, keeps=True)
                if answer.lacks_view:
                    self._jobs.make_room()
                job.end(answer)
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
        """Send a job's state whenever it changes, as server-sent events."""
        job = self._find(request)

        async def tell() -> AsyncIterator[str]:
            async for state in job.watch():
                yield ": still here\n\n" if state is None else f"data: {json.dumps(state)}\n\n"

        return StreamingResponse(tell(), headers={"Cache-Control": "no-store"}, media_type="text/event-stream")

    async def _again(self, request: Request) -> Response:
        """Search for an image again, with other hints, as another job."""
        old, came = self._find(request), time.time()
        hints = read_query_string(request.url.query)
        place, folder = self._workers.take_place(), self._make_folder()
        try:
            await asyncio.to_thread(_copy, old, folder)
        except OSError as error:
            place.give_back()
            shutil.rmtree(folder, ignore_errors=True)
            raise self._make_room(error) from error
        job = Job(folder, old.image, old.name, hints)
        self._start(job, place, came)
        return _created(job)

    async def _shown(self, request: Request) -> Response:
        """Return the page's view of an answer."""
        job, name = self._find(request), request.path_params["name"]
        path = job.folder / OWN / name
        if name not in (PICTURE, WARPED, VIEW) or job.status != "successful" or not path.is_file():
            raise Refused(404, f"the job is {job.status}: there is nothing to show")
        return FileResponse(path, headers=_FOR_EVER)

    async def _files(self, request: Request) -> Response:
        """List the files that may be had of an answer."""
        job = self._find(request)
        document = job.answer.document if job.answer is not None and job.status == "successful" else {}
        located, camera = document.get("status") == "located", document.get("camera") is not None
        offered = [
            {"name": one.name, "summary": one.summary, "href": f"/jobs/{job.id}/files/{one.name}"}
            for one in OFFERED.values()
            if document and (located or not one.needs_place) and (camera or not one.needs_camera)
        ]
        return JSONResponse({"files": offered})

    async def _file(self, request: Request) -> Response:
        """Return one of them, made when it is first asked for."""
        job, name = self._find(request), request.path_params["name"]
        if name not in OFFERED or job.status != "successful":
            raise Refused(404, f"there is no such file; {', '.join(OFFERED)} may be had of what was located")
        asked = Asked(str(job.path), {}, _WRITE_S, self._options.max_pixels, wanted=name)
        with self._workers.take_place():
            ask = partial(self._workers.ask, asked)
            answer = await asyncio.get_running_loop().run_in_executor(self._threads, ask)
        if answer.status >= 400:
            return _said(answer, dict)
        path = Path(answer.document["file"])
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    # --- the page -----------------------------------------------------------------------------------------------------

    async def _landing(self, request: Request) -> Response:
        """Return the page to people, to programs what it is."""
        if "text/html" not in request.headers.get("accept", ""):
            return JSONResponse(self._documents["/"])
        return HTMLResponse(page_text("index.html"), headers={"Content-Security-Policy": self._policy, **_AS_IT_IS})

    async def _page(self, request: Request) -> Response:
        name = request.path_params["name"]
        path = page_file(name)
        if path is None:
            raise Refused(404, "there is nothing of that name; begin at /")
        kind = {".css": "text/css", ".html": "text/html"}.get(Path(name).suffix, "text/javascript")
        packed = {"Content-Encoding": "gzip"} if path.suffix == ".gz" else {}
        headers = {"Content-Security-Policy": self._policy, **_AS_IT_IS, **packed}
        return FileResponse(path, media_type=kind, headers=headers)

    async def _open_session(self, request: Request) -> Response:
        """Give a browser a pass for the token that its user typed, once."""
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > _MOST_TOKEN:
                raise Refused(413, "expected a token")
        given = body.decode("utf-8", "replace").strip()
        if self._options.token and not is_same(given, self._options.token):
            raise Refused(401, "this is not the token")
        response = JSONResponse({"status": "ok"})
        if self._options.token:
            response.set_cookie(COOKIE, pass_of(self._options.token), httponly=True, samesite="strict")
        return response

    async def _references(self, _: Request) -> Response:
        loop = asyncio.get_running_loop()
        told = await loop.run_in_executor(self._drawing, self._tiles.describe)
        limits = {"max_bytes": self._options.max_bytes, "kept": self._options.kept_jobs}
        shown = {"references": told, "max_zoom": MAX_ZOOM, "basemap": self._options.basemap}
        return JSONResponse({**shown, "basemap_attribution": self._options.basemap_attribution, **limits})

    async def _tile(self, request: Request) -> Response:
        """Return the roads of a map as a vector tile."""
        asked = request.path_params
        where = (asked["reference"], asked["zoom"], asked["column"], asked["row"])
        try:
            tile = await asyncio.get_running_loop().run_in_executor(self._drawing, self._tiles.tile, *where)
        except KeyError as error:
            raise Refused(404, "there is no such tile") from error
        headers = {"Cache-Control": "private, max-age=3600"}
        return Response(tile, media_type="application/vnd.mapbox-vector-tile", headers=headers)

    def close(self) -> None:
        """Wait for nobody any more."""
        for pool in (self._threads, self._drawing):
            pool.shutdown(wait=False, cancel_futures=True)


def _document_routes(documents: dict[str, dict[str, Any]]) -> list[Route]:
    def route(path: str) -> Route:
        async def answer(_: Request) -> Response:
            return JSONResponse(documents[path])

        return Route(path, answer)

    return [route(path) for path in documents if path != "/"]


def _copy(old: Job, folder: Path) -> None:
    """Copy an image, and what was seen in it, into another folder."""
    shutil.copyfile(old.path, folder / SENT / old.image)
    seen = old.folder / OWN / SEEN
    if seen.is_file():
        (folder / OWN).mkdir()
        shutil.copyfile(seen, folder / OWN / SEEN)


async def _keep_body(request: Request, folder: Path) -> Path:
    """Write a body to a file as it comes."""
    path = folder / "body"
    with path.open("wb") as file:
        async for chunk in request.stream():
            file.write(chunk)
    return path


def _job_of(folder: Path, part: Path, name: str, hints: dict[str, Any]) -> Job:
    """Return the job of an image that has come, under a name with its ending."""
    with part.open("rb") as file:
        ending = ending_of(file.read(16))
    image = part.rename(folder / SENT / f"{safe_stem(name)}{ending}")
    return Job(folder, image.name, Path(name.replace("\\", "/")).name[:200], hints)


def _created(job: Job) -> Response:
    headers = {"Location": f"/jobs/{job.id}", "Preference-Applied": "respond-async"}
    return JSONResponse(job.to_dict(), 201, headers)


def _said(answer: Answer, show: Callable[[dict[str, Any]], dict[str, Any]]) -> Response:
    if answer.status >= 400:
        return refusal(Refused(answer.status, answer.document["detail"], 1 if answer.status == 503 else None))
    return JSONResponse(show(answer.document))


async def _no_route(request: Request, error: Exception) -> Response:
    """Answer that there is nothing, or nothing of this kind."""
    status = getattr(error, "status_code", 404)
    if status == 405:
        allowed = (getattr(error, "headers", None) or {}).get("Allow", "GET")
        response = refusal(Refused(405, f"expected {allowed}"))
        response.headers["Allow"] = allowed
        return response
    if status != 404:
        return refusal(Refused(status, str(getattr(error, "detail", error))[:200]))
    return refusal(Refused(404, f"there is nothing at {request.scope['path'][:80]}; begin at /"))
