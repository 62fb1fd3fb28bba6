"""The one place where commands print."""

from __future__ import annotations

import click

from roadgeo._text import visible

__all__ = ["echo"]


def echo(text: str, *, err: bool = False, color: bool | None = None) -> None:
    """Print lines; control characters in names are shown, not obeyed by the terminal."""
    click.echo(visible(text, ours=True), err=err, color=color)
