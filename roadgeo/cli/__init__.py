"""The command line: options, one call, printing. Each command is a module, imported only when it is used.

Exit status: 0 all well (and every mask located), 3 at least one mask not located, 1 error, 2 usage, 130 interrupted,
143 ended by SIGTERM.
"""

from __future__ import annotations

import difflib
import gc
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Any

import click

from roadgeo._version import __version__
from roadgeo.cli.fencing import OWN_PROCESS
from roadgeo.cli.printing import complain, echo, own_log
from roadgeo.errors import RoadgeoError, is_of_memory, name_package
from roadgeo.storage.fence import remedy
from roadgeo.storage.gdal import forget_missing_proj_data

__all__ = ["COMMANDS", "ERROR", "INTERRUPTED", "NOT_LOCATED", "Group", "cli", "main"]

ERROR, USAGE, NOT_LOCATED, INTERRUPTED, TERMINATED = 1, 2, 3, 130, 128 + signal.SIGTERM

#: Objects after which Python looks for cycles that nobody holds. A command makes few; to look for them after every 700
#: objects, as is usual, takes some per cent of the time of a short one.
_COLLECT_AFTER = 200_000

#: Name of each command: the module whose `command` it is, and its summary, which stands here so that `--help` need not
#: import the module.
COMMANDS = {
    "index": ("roadgeo.cli.index", "Build a reference: the searchable roads of a place."),
    "locate": ("roadgeo.cli.locate", "Find where images lie on a map, and draw them there."),
    "serve": ("roadgeo.cli.serve", "A page to drop photographs on; answers over HTTP."),
    "qgis": ("roadgeo.cli.qgis", "Install the QGIS plugin."),
    "demo": ("roadgeo.cli.demo", "Locate a photograph and five masks: needs no network and no data."),
    "reference": ("roadgeo.cli.references", "List, describe, test and remove references."),
    "track": ("roadgeo.cli.track", "Follow a flight over the map, frame by frame."),
    "verify": ("roadgeo.cli.verify", "Say whether georeferenced images are where they claim to be."),
    "apply": ("roadgeo.cli.apply", "Put another picture of a located frame on the map."),
    "vectorize": ("roadgeo.cli.vectorize", "Show what roads are seen in an image."),
    "evaluate": ("roadgeo.cli.evaluate", "Measure how well masks are located, and where they would be."),
    "simulate": ("roadgeo.cli.simulate", "Draw road masks whose place is known."),
}

#: Commands that are not listed: those that are called once.
_UNLISTED = {"completion": "roadgeo.cli.completion"}


class Group(click.Group):
    """A group that prints its help where no command is given."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read its own options."""
        if not args and not ctx.resilient_parsing:
            echo(ctx.get_help())
            ctx.exit(USAGE)
        return super().parse_args(ctx, args)


class LazyGroup(Group):
    """A group that imports a command's module when the command runs or its own help is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 (click's signature)
        """Name all commands in the order of their use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import one command."""
        home = COMMANDS[cmd_name][0] if cmd_name in COMMANDS else _UNLISTED.get(cmd_name)
        if home is None:
            return None
        module = importlib.import_module(home)
        return getattr(module, f"{cmd_name}_command")  # type: ignore[no-any-return]

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that is meant; for a mistyped name suggest one.

        Raises
        ------
        click.UsageError
            There is no such command.
        """
        if args and not args[0].startswith("-") and self.get_command(ctx, args[0]) is None:
            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f"Did you mean {near[0]}?" if near else ""
            raise click.UsageError(f"No such command {args[0]!r}. {hint}".strip(), ctx)
        ctx.meta["roadgeo.arguments"] = list(args)  # see `cli.command_line`
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """List the summaries without importing anything."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])


def _list_plugins(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        from roadgeo.cli.references import list_plugins

        list_plugins()
        ctx.exit()


@click.group(
    cls=LazyGroup,
    # A command that has more to show than its help has an option --help-all of its own.
    context_settings={"help_option_names": ["-h", "--help", "--help-all"], "max_content_width": 100},
    epilog="Exit status: 0 every image located, 3 at least one not located, 1 error, 2 usage.",
)
@click.version_option(__version__, prog_name="roadgeo")
@click.option(
    "--plugins",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_plugins,
    help="List the road sources, segmenters and outputs that are installed.",
)
def cli() -> None:
    """Locate aerial images from their roads alone.

    \b
      roadgeo index --osm "Boston, MA"      once: fetch and index the roads of a place
      roadgeo locate photo.jpg --report     find a photograph, or a mask of roads, there
      roadgeo demo                          see it work, offline, in a minute

    `roadgeo COMMAND --help` explains each command, with examples; `roadgeo completion --help` how your shell completes
    them.
    """


#: Signals of a supervisor, of which the process is about to end.
_signals: list[int] = []


def _terminate(number: int, frame: FrameType | None) -> Any:
    """Clean up as at Ctrl-C."""
    _signals.append(number)
    signal.default_int_handler(number, frame)


@own_log()
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status; every error is one line on standard error."""
    if arguments is None:  # the process is ours
        gc.set_threshold(_COLLECT_AFTER)
        os.environ["PYTHONSAFEPATH"] = "1"  # no process of ours imports what lies in the current folder
        if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
            signal.signal(signal.SIGTERM, _terminate)
    forget_missing_proj_data()
    try:
        status = cli.main(
            args=None if arguments is None else list(arguments),
            prog_name="roadgeo",
            standalone_mode=False,
            obj=OWN_PROCESS if arguments is None else None,
        )
    except click.UsageError as error:
        asked = error.ctx.command_path if error.ctx else "roadgeo"
        said = error.format_message().rstrip(".")
        return _fail(f"{said}{'' if said.endswith('?') else '.'} Try '{asked} --help'.", error.exit_code)
    except click.ClickException as error:
        return _fail(error.format_message(), error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        echo("Interrupted.", err=True)
        return TERMINATED if _signals else INTERRUPTED
    except RoadgeoError as error:
        return _fail(str(error), ERROR)
    except ModuleNotFoundError as error:
        missing = name_package(error)
        if missing is None:
            raise
        return _fail(str(missing), ERROR)
    except BrokenPipeError:
        # The reader of our output has gone; text that Python still holds for it must not raise at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ERROR
    except Exception as error:
        if os.environ.get("ROADGEO_TRACEBACK"):
            raise
        if is_of_memory(error):
            return _fail("more memory is needed than there is; take a smaller area or picture, or fewer --jobs", ERROR)
        what = f"{type(error).__name__}: {error}{remedy(str(error))}"
        return _fail(f"{what}. This is a fault of roadgeo; ROADGEO_TRACEBACK=1 shows where, please report it", ERROR)
    return status if isinstance(status, int) else 0


def _fail(message: str, status: int) -> int:
    complain(message)
    return status
