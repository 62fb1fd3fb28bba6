"""The one place where commands print, as --json, --quiet and --verbose of the one that runs have it."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

import click

from roadgeo._text import visible

__all__ = ["complain", "echo", "is_set", "keep_switch", "own_log", "paint", "plain", "tell"]

_LOG = logging.getLogger("roadgeo")
#: Stands for the escape character in what `paint` returns: no name of a file can hold it.
_MARK = f"\ufdd0{os.urandom(8).hex()}"


def echo(text: str, *, err: bool = False, color: bool | None = None) -> None:
    """Print lines; control characters in names are shown, not obeyed by the terminal, and NO_COLOR is."""
    color = False if os.environ.get("NO_COLOR") else color
    click.echo(visible(text, lines=True).replace(_MARK, "\x1b"), err=err, color=color)


def keep_switch(context: click.Context, parameter: click.Parameter, given: bool) -> bool:
    """Keep a switch of the command that runs for all that prints, as click calls back; --quiet for the log, too."""
    context.meta[f"roadgeo.{parameter.name}"] = given
    if given and parameter.name == "quiet":
        _LOG.setLevel(logging.ERROR)
    return given


@contextmanager
def own_log() -> Iterator[None]:
    """End what a command sets of the log with it: a program may run commands, and go on."""
    before = _LOG.level
    try:
        yield
    finally:
        _LOG.setLevel(before)


def is_set(switch: str) -> bool:
    """Whether the command that runs was given a switch: "as_json", "quiet" or "verbose"."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(f"roadgeo.{switch}"))


def tell(text: str, *, err: bool = False) -> None:
    """Print lines, but none with --quiet; on standard error where --json takes standard output."""
    if not is_set("quiet"):
        echo(text, err=err or is_set("as_json"))


def complain(text: str) -> None:
    """Print an error as one line on standard error."""
    echo(f"{paint('Error:', 'red')} {' '.join(visible(text).split())}", err=True)


def paint(text: str, color: str | None) -> str:
    """Return text that `echo` prints in a colour."""
    return click.style(text, fg=color).replace("\x1b", _MARK)


def plain(text: str) -> str:
    """Return painted text without its colours."""
    return re.sub(rf"{_MARK}\[\d+m", "", text)
