"""`roadgeo serve`: options, one call."""

from __future__ import annotations

import logging
import os
import select
import signal
import sys
import threading
import webbrowser
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from roadgeo._options import OTHERS, option, part, take
from roadgeo.cli import TERMINATED
from roadgeo.cli.fencing import fence_of
from roadgeo.cli.options import Known, Shared, Verbosity, command, n_threads, open_maps
from roadgeo.cli.printing import echo, is_set
from roadgeo.matching.hints import HINTS
from roadgeo.serving.options import LOOPBACK, ServeOptions

if TYPE_CHECKING:
    from roadgeo.flights.mavlink import MavlinkSender

__all__ = ["serve_command"]

_HELP = """Keep references open: a page to drop photographs and masks on, and answers over HTTP.

The page shows each on the map. Where one is refused it takes what you know (here, so large, these crossings), and
searches again. It opens in your browser; nothing leaves this machine.

\b
  POST /locate                           an image as the body -> the answer, JSON as of locate --json
                                         a form too: curl -F image=@photo.jpg
  GET  /jobs/ID  /jobs/ID/results        with the header Prefer: respond-async; progress: /jobs/ID/events
  GET  /  /health                        the page; whether it answers

It listens on this machine only. With --host others may ask, and then all must show a token:
`Authorization: Bearer TOKEN`, which the environment variable ROADGEO_TOKEN or --token-file gives. There is no
encryption, and slow clients are waited for: put a proxy before it where the network is not your own.

\b
Examples:
  roadgeo serve --reference boston-ma
  curl --data-binary @photo_mask.png http://127.0.0.1:8017/locate
  curl --data-binary @photo_mask.png "http://127.0.0.1:8017/locate?near=-71.06,42.36,5000"
  ROADGEO_TOKEN=secret roadgeo serve --host 0.0.0.0 --jobs 4
  roadgeo serve --mavlink udpout:127.0.0.1:14550

Exit status: 0 ended, 1 error, 2 usage, 143 ended by SIGTERM.
\f

\b
What is known goes into the URL or the form, in the words of `roadgeo locate`:
{hints}

Requests wait for a free process, so many as --waiting says; whoever comes then hears 503 and when to come again. The
size of images, the time to send and to search are bounded too. Ctrl-C ends it.

With --mavlink each place that is found goes to an autopilot, too: the camera's where the request gives its focal
length, otherwise the frame's middle (it needs pymavlink).
"""


def _help() -> str:
    """List the hints."""
    hints = [f"{hint.parameter}={hint.form or 'true'}" for hint in HINTS.values()]
    lines = (hints[:3], hints[3:6], hints[6:])
    return _HELP.format(hints="\n".join("  " + "  ".join(line) for line in lines))


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Serve:
    """The parameters of `roadgeo serve`."""

    references: tuple[str, ...] = take(Shared, "references")
    limits: ServeOptions = part(ServeOptions)
    token_file: str | None = option("--token-file", "FILE", OTHERS, "The token is the first line of this file.",
        type=click.Path())
    jobs: int = take(Shared, "jobs", help="Processes that locate. Default: 1.")
    time_limit_s: float = take(Known, "time_limit_s", default=10.0,
        help="Stop each search then. Default: 10; requests may ask for less.")
    mavlink: str | None = take(Shared, "mavlink")
    no_browser: bool = option("--no-browser", "", OTHERS, "Do not open the page in a browser.")
    verbosity: Verbosity = part(Verbosity, "quiet")
# fmt: on


@command("serve", Serve, is_fenced=False, help=_help())
def serve_command(asked: Serve) -> int:
    """Keep references open, and answer; for the help see above."""
    from roadgeo.errors import OutputError, RoadgeoError
    from roadgeo.flights.mavlink import MavlinkSender
    from roadgeo.serving.app import Service
    from roadgeo.serving.server import Server
    from roadgeo.serving.workers import ImageWorkers

    # Compiled and opened here first: errors in the references are printed before anything listens.
    options = _options(asked)
    maps = open_maps(asked.references)
    # The images of strangers are opened by processes inside a fence; this one may show the page in a browser.
    fence = fence_of("serve", {"references": asked.references}, ())
    workers = ImageWorkers(asked.references, options.workers, options.waiting, n_threads(options.workers), fence)
    try:
        sender = None if asked.mavlink is None else MavlinkSender(asked.mavlink)
        server = Server(Service(workers, maps, options, None if sender is None else partial(_tell, sender)))
    except RoadgeoError:
        workers.close()
        raise
    except OSError as error:
        workers.close()
        where = f"{options.host} port {options.port}"
        raise OutputError(f"cannot listen on {where}: {error.strerror or error}; choose another --port") from error
    # Listen until Ctrl-C, or until a supervisor ends it.
    host = f"[{options.host}]" if ":" in options.host else options.host
    address = f"http://{host}:{server.server_port}/"
    names = ", ".join(item.name for item in maps)
    ended_by: list[int] = []

    def end(number: int, _: FrameType | None) -> None:
        ended_by.append(number)
        raise KeyboardInterrupt

    try:
        signal.signal(signal.SIGTERM, end)
        _log()
        echo(f"Listening on {address} for photographs and masks of {names}; Ctrl-C ends it.", err=True)
        if not asked.no_browser and _has_screen():
            threading.Timer(0.5, webbrowser.open, [address]).start()
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.close()
        if sender is not None:
            sender.close()
    return TERMINATED if ended_by else 0


def _has_screen() -> bool:
    """Whether somebody sits before this, who can be shown a page."""
    has_display = sys.platform in ("darwin", "win32") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    return sys.stderr.isatty() and has_display


class _Log(logging.Handler):
    """Writes lines to stderr as far as somebody takes them: who leaves a pipe unread does not stop the server."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, or leave it out."""
        text = f"{self.format(record)}\n".encode(errors="backslashreplace")
        try:
            where, most = sys.stderr.fileno(), getattr(select, "PIPE_BUF", len(text))
            while text and (sys.platform == "win32" or select.select([], [where], [], 0)[1]):
                text = text[os.write(where, text[:most]) :]
        except (OSError, ValueError):  # stderr is closed
            return


def _log() -> None:
    """Have faults written to stderr, and unless --quiet a line for each request: client, request, status."""
    log = _Log()
    log.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    logging.getLogger().addHandler(log)
    if not is_set("quiet"):
        logging.getLogger("uvicorn.access").setLevel(logging.INFO)


def _tell(sender: MavlinkSender, document: dict[str, Any], came_s: float) -> None:
    """Send the place of a mask that was located; it was taken when its request came."""
    from roadgeo.flights.mavlink import fix_of

    fix = fix_of(document, came_s)
    if fix is not None:
        sender.send(fix)


def _options(asked: Serve) -> ServeOptions:
    """Put together what the server allows.

    Raises
    ------
    click.UsageError
        Others may ask, and there is no token.
    """
    token = os.environ.get("ROADGEO_TOKEN", "").strip()
    if asked.token_file is not None:
        try:
            token = Path(asked.token_file).read_text(encoding="utf-8").split("\n", 1)[0].strip()
        except (OSError, UnicodeDecodeError) as error:
            raise click.UsageError(f"Cannot read the token: {error}.") from error
        if not token:
            raise click.UsageError(f"{asked.token_file} is empty, expected a token in its first line.")
    limits, n = asked.limits, asked.jobs
    if limits.host not in LOOPBACK and not token:
        raise click.UsageError("--host needs a token: set ROADGEO_TOKEN, or give --token-file FILE.")
    connections = n + limits.waiting + 64
    return replace(limits, token=token, workers=n, time_limit_s=asked.time_limit_s, connections=connections)
