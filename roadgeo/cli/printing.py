"""The one place where commands print."""

from __future__ import annotations

import os
import re

import click

from roadgeo._text import visible

__all__ = ["echo", "paint", "plain"]

#: Stands for the escape character in what `paint` returns: no name of a file can hold it.
_MARK = f"\ufdd0{os.urandom(8).hex()}"


def echo(text: str, *, err: bool = False, color: bool | None = None) -> None:
    """Print lines; control characters in names are shown, not obeyed by the terminal."""
    click.echo(visible(text, lines=True).replace(_MARK, "\x1b"), err=err, color=color)


def paint(text: str, color: str | None) -> str:
    """Return text that `echo` prints in a colour."""
    return click.style(text, fg=color).replace("\x1b", _MARK)


def plain(text: str) -> str:
    """Return painted text without its colours."""
    return re.sub(rf"{_MARK}\[\d+m", "", text)
