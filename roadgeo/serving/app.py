"""Routes of the server, each a few lines; processes locate (`workers`)."""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from roadgeo._text import log_of
from roadgeo._version import __version__
from roadgeo.reference.opening import AnyReference
from roadgeo.serving.guard import COOKIE, Guard, is_same, pass_of, problem
from roadgeo.serving.jobs import Job, Jobs
from roadgeo.serving.options import ServeOptions
from roadgeo.serving.page import page_file, page_text, policy_of
from roadgeo.serving.requests import LIMIT, OF_ANSWERS, ending_of, read_hints, read_query_string
from roadgeo.serving.tiles import MAX_ZOOM, Tiles
from roadgeo.serving.view import KEPT, OFFERED, OWN, PICTURE, SEEN, SENT, VIEW, WARPED, safe_stem
from roadgeo.serving.workers import ImageRequest, ImageWorkers, Reply

__all__ = ["Service"]

_LOG = log_of(__name__)

#: Time to make a file of an answer, seconds.
_WRITE_S = 60.0

#: Headers of files that never change under their address, and of those that change with roadgeo itself.
_FOR_EVER = {"Cache-Control": "private, max-age=86400, immutable"}
_AS_IT_IS = {"Cache-Control": "no-cache"}

#: Called with the document of each place that is found, and with the time of its request.
Listener = Callable[[dict[str, Any], float], None]


class Service:
    """The routes, and their shared state; `listener` is called with each place that is found.

    Attributes
    ----------
    app : Starlette
        Answers requests.
    """

    def __init__(
        self,
        workers: ImageWorkers,
        references: Sequence[AnyReference],
        options: ServeOptions,
        listener: Listener | None = None,
    ) -> None:
        self.workers, self.options, self._listener = workers, options, listener
        self._jobs, self._tiles = Jobs(workers.folder, options), Tiles(references)
        self._threads = ThreadPoolExecutor(options.workers + options.waiting + 4)
        self._drawing = ThreadPoolExecutor(1)  # whatever maps are looked at, the rest of the machine searches
        self._policy = policy_of(options)
        self._tasks: set[asyncio.Task[None]] = set()
        self.app = Starlette(
            routes=self._routes(),
            middleware=[Middleware(Guard, options=options)],
            exception_handlers={HTTPException: _refuse, ClientDisconnect: _hang_up, Exception: _fail},
        )
        self.app.router.redirect_slashes = False  # a redirect would name the host that the client claims

    def _routes(self) -> list[Route]:
        job = "/jobs/{job}"
        return [
            Route("/", self._landing),
            Route("/page/{name}", self._page),
            Route("/session", self._open_session, methods=["POST"]),
            Route("/references", self._references),
            Route("/tiles/{reference}/{zoom}/{column}/{row}.mvt", self._tile),
            Route("/health", self._health),
            Route("/locate", self._locate, methods=["POST"]),
            Route(job, self._job, methods=["GET"]),
            Route(job, self._dismiss, methods=["DELETE"]),
            Route(f"{job}/results", self._results),
            Route(f"{job}/events", self._events),
            Route(f"{job}/again", self._again, methods=["POST"]),
            Route(f"{job}/files", self._files),
            Route(f"{job}/files/{{name}}", self._file),
            Route(f"{job}/{{name}}", self._shown),
        ]

    async def _health(self, _: Request) -> Response:
        return JSONResponse({"status": "ok", "version": __version__})

    # --- locating -----------------------------------------------------------------------------------------------------

    async def _locate(self, request: Request) -> Response:
        """Locate an image at once, or as a job where its sender prefers not to wait."""
        came = time.time()
        with self.workers.take_place():
            pass  # whoever comes when it is full need not send an image first; who sends one slowly holds no place
        with self._jobs.room() as folder:
            job = Job(folder, self._asked(*await _take(request, folder)))
            if "respond-async" in request.headers.get("prefer", "").lower():
                return self._start(job, came, f"jobs/{job.id}")
            with self.workers.take_place():
                answer = await self._ask(job, came)
        return _respond(answer, answer.document)

    async def _again(self, request: Request) -> Response:
        """Search for an image again, with other hints, as another job."""
        came, old, hints = time.time(), self._find(request), read_query_string(_query_of(request))
        if not Path(old.request.path).is_file():
            raise HTTPException(404, "its image is not kept: send it again")
        with self._jobs.room() as folder:
            path = await asyncio.to_thread(_copy, old, folder, not hints.keys().isdisjoint(OF_ANSWERS))
            return self._start(Job(folder, self._asked(path, old.request.name, hints)), came, f"../{folder.name}")

    def _asked(self, path: Path, name: str, hints: dict[str, Any]) -> ImageRequest:
        """Return the task of a process for an image."""
        limit = min(hints.pop(LIMIT, self.options.time_limit_s), self.options.time_limit_s)
        return ImageRequest(str(path), hints, limit, self.options.max_pixels, name)

    async def _ask(self, job: Job, came: float, keeps: bool = False) -> Reply:
        """Have a process locate an image, and report its place to the listener."""
        loop, task = asyncio.get_running_loop(), replace(job.request, keeps=keeps)

        def say(text: str, share: float | None = None) -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(job.tell, text, share)

        answer = await loop.run_in_executor(self._threads, self.workers.ask, task, say, job.called_off)
        if answer.status == 200 and self._listener is not None:
            await loop.run_in_executor(self._threads, _report, self._listener, answer.document, came)
        return answer

    def _start(self, job: Job, came: float, location: str) -> Response:
        """Locate while nobody waits."""
        place = self.workers.take_place()
        self._jobs[job.id] = job
        task = asyncio.get_running_loop().create_task(self._work(job, place, came))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return JSONResponse(job.to_dict(), 201, {"Location": location, "Preference-Applied": "respond-async"})

    async def _work(self, job: Job, place: ExitStack, came: float) -> None:
        with place:
            try:
                answer = await self._ask(job, came, keeps=True)
            except Exception:
                _LOG.exception("a fault of the server at a job")
                answer = Reply(500, {"detail": "a fault of roadgeo: its log tells which"})
        if answer.lacks_view:
            self._jobs.make_room()
        job.end(answer)
        self._jobs.let_go()

    # --- jobs ---------------------------------------------------------------------------------------------------------

    def _find(self, request: Request) -> Job:
        return self._jobs[request.path_params["job"]]

    async def _job(self, request: Request) -> Response:
        return JSONResponse(self._find(request).to_dict())

    async def _dismiss(self, request: Request) -> Response:
        job = self._find(request)
        self._jobs.remove(job)
        return JSONResponse({**job.to_dict(), "status": "dismissed"})

    async def _results(self, request: Request) -> Response:
        job = self._find(request)
        if job.answer is None:
            raise HTTPException(404, f"the job is {job.status}: there is no result yet")
        return _respond(job.answer, {"location": job.answer.document})

    async def _events(self, request: Request) -> Response:
        """Send a job's state whenever it changes, as server-sent events."""
        events = (f"data: {json.dumps(state)}\n\n" async for state in self._find(request).watch())
        return StreamingResponse(events, headers={"Cache-Control": "no-store"}, media_type="text/event-stream")

    async def _shown(self, request: Request) -> Response:
        """Return the page's view of an answer."""
        job, name = self._find(request), request.path_params["name"]
        path = job.folder / OWN / name
        if name not in (PICTURE, WARPED, VIEW) or job.status != "successful" or not path.is_file():
            raise HTTPException(404, f"the job is {job.status}: there is nothing to show")
        return FileResponse(path, headers=_FOR_EVER)

    async def _files(self, request: Request) -> Response:
        """List the files that may be had of an answer; their addresses start at the page's."""
        job = self._find(request)
        document = job.answer.document if job.answer is not None and job.status == "successful" else {}
        on_map, camera = document.get("status") in ("located", "chosen"), document.get("camera") is not None
        offered = [
            {"name": output.name, "summary": output.summary, "href": f"jobs/{job.id}/files/{output.name}"}
            for output in OFFERED.values()
            if document and output.suits(on_map, camera)
        ]
        return JSONResponse({"files": offered})

    async def _file(self, request: Request) -> Response:
        """Return one of them, made when it is first asked for."""
        job, name = self._find(request), request.path_params["name"]
        if name not in OFFERED or job.status != "successful":
            raise HTTPException(404, f"there is no such file; {', '.join(OFFERED)} may be had of what was located")
        task = replace(job.request, time_limit_s=_WRITE_S, wanted=name)
        with self.workers.take_place():
            answer = await asyncio.get_running_loop().run_in_executor(self._threads, self.workers.ask, task)
        if answer.status >= 400:
            return _respond(answer, {})
        path = Path(answer.document["file"])
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    # --- the page -----------------------------------------------------------------------------------------------------

    async def _landing(self, _: Request) -> Response:
        return HTMLResponse(page_text("index.html"), headers={"Content-Security-Policy": self._policy, **_AS_IT_IS})

    async def _page(self, request: Request) -> Response:
        name = request.path_params["name"]
        path = page_file(name)
        if path is None:
            raise HTTPException(404, "there is nothing of that name; begin at /")
        kind = {".css": "text/css", ".html": "text/html"}.get(Path(name).suffix, "text/javascript")
        packed = {"Content-Encoding": "gzip"} if path.suffix == ".gz" else {}
        headers = {"Content-Security-Policy": self._policy, **_AS_IT_IS, **packed}
        return FileResponse(path, media_type=kind, headers=headers)

    async def _open_session(self, request: Request) -> Response:
        """Give a browser a pass for the token that its user typed, once."""
        given, token = (await request.body()).decode("utf-8", "replace").strip(), self.options.token
        if token and not is_same(given, token):
            raise HTTPException(401, "this is not the token")
        response = JSONResponse({"status": "ok"})
        if token:
            response.set_cookie(COOKIE, pass_of(token), httponly=True, samesite="strict")
        return response

    async def _references(self, _: Request) -> Response:
        references = await asyncio.get_running_loop().run_in_executor(self._drawing, self._tiles.describe)
        limits = {"max_bytes": self.options.max_bytes, "kept": self.options.kept_jobs, "max_zoom": MAX_ZOOM}
        basemap = {"basemap": self.options.basemap, "basemap_attribution": self.options.basemap_attribution}
        return JSONResponse({"references": references, **limits, **basemap})

    async def _tile(self, request: Request) -> Response:
        """Return the roads of a map as a vector tile."""
        try:
            where = [int(request.path_params[name]) for name in ("reference", "zoom", "column", "row")]
            tile = await asyncio.get_running_loop().run_in_executor(self._drawing, self._tiles.tile, *where)
        except (KeyError, ValueError) as error:  # no number, or one of thousands of digits
            raise HTTPException(404, "there is no such tile") from error
        headers = {"Cache-Control": "private, max-age=3600"}
        return Response(tile, media_type="application/vnd.mapbox-vector-tile", headers=headers)

    def close(self) -> None:
        """Wait for nobody any more."""
        for pool in (self._threads, self._drawing):
            pool.shutdown(wait=False, cancel_futures=True)


def _query_of(request: Request) -> str:
    query: bytes = request.scope["query_string"]  # `request.url` begins with the client's name of the host
    return query.decode("latin-1")


async def _take(request: Request, folder: Path) -> tuple[Path, str, dict[str, Any]]:
    """Take an image that is the body, or a file of a form; return its file, its name, and hints of the URL and form."""
    part, hints, name = folder / "part", read_query_string(_query_of(request)), ""
    if request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
        async with request.form(max_files=1, max_fields=20, max_part_size=4096) as form:
            image = form.get("image")
            if not isinstance(image, UploadFile):
                raise HTTPException(400, "expected a form with a file named image: curl -F image=@photo.jpg")
            given = read_hints([(key, value) for key, value in form.multi_items() if isinstance(value, str)])
            if hints.keys() & given.keys():
                raise HTTPException(400, "a hint stands in the URL and in the form: give it once")
            hints |= given
            name = (image.filename or "").replace("\\", "/")
            with part.open("wb") as file:
                await asyncio.to_thread(shutil.copyfileobj, image.file, file)
    else:
        with part.open("wb") as file:
            async for chunk in request.stream():
                file.write(chunk)
    with part.open("rb") as file:
        ending = ending_of(file.read(16))
    image_path = part.rename(folder / SENT / f"{safe_stem(name)}{ending}")
    return image_path, Path(name).name[:200], hints


def _copy(old: Job, folder: Path, takes: bool) -> Path:
    """Copy an image, with the roads seen in it, into another folder; its answer too, where a place of it is taken."""
    for name in (SEEN, *[KEPT] * takes):
        kept = old.folder / OWN / name
        if kept.is_file():
            (folder / OWN).mkdir(exist_ok=True)
            shutil.copyfile(kept, folder / OWN / name)
    image = Path(old.request.path)
    return Path(shutil.copyfile(image, folder / SENT / image.name))


def _report(listener: Listener, document: dict[str, Any], came: float) -> None:
    """Report a place to the listener, whose errors do not concern the client."""
    try:
        listener(document, came)
    except Exception:
        _LOG.exception("a place could not be reported")


def _respond(answer: Reply, document: dict[str, Any]) -> Response:
    return problem(answer.status, answer.document["detail"]) if answer.status >= 400 else JSONResponse(document)


async def _refuse(_: Request, error: Any) -> Response:
    return problem(error.status_code, error.detail, error.headers)


async def _hang_up(_: Request, __: Exception) -> Response:
    return Response(status_code=400)  # nobody is there to read it


async def _fail(_: Request, __: Exception) -> Response:
    return problem(500, "a fault of roadgeo: its log tells which")
