"""Progress on standard error: a bar for people, JSON lines for programs."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import click

from roadgeo._progress import Say, say_nothing

__all__ = ["print_progress", "print_steps", "show_progress", "show_steps"]


@contextmanager
def show_steps(quiet: bool) -> Iterator[Say]:
    """Show on standard error what is being done: yield what is told the steps and how much of each is done.

    On a terminal each step has a bar, with the time it has left where its share is known; elsewhere see `print_steps`.
    """
    as_json = os.environ.get("ROADGEO_PROGRESS") == "json"
    if not quiet and not as_json and sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        with _show_bars() as say:
            yield say
    else:
        yield print_steps(quiet)


def print_steps(quiet: bool) -> Say:
    """Return what prints each step once, as a line on standard error.

    Programs that set ROADGEO_PROGRESS=json get lines such as {"progress": {"done": 30, "total": 100, "text": "..."}}
    besides, where a share is known.
    """
    if quiet:
        return say_nothing
    as_json = os.environ.get("ROADGEO_PROGRESS") == "json"
    last = "", -1

    def say(text: str, share: float | None = None) -> None:
        nonlocal last
        if text != last[0]:
            click.echo(f"{text} ...", err=True)
            last = text, -1
        if as_json and share is not None and int(100 * share) != last[1]:
            last = text, int(100 * share)
            click.echo(json.dumps({"progress": {"done": last[1], "total": 100, "text": text}}), err=True)

    return say


@contextmanager
def _show_bars() -> Iterator[Say]:
    """Yield what keeps a bar for every step; all are gone at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:

        def say(text: str, share: float | None = None) -> None:
            current = progress.tasks[-1] if progress.tasks else None
            if current is None or current.description != text:
                if current is not None:
                    progress.update(current.id, total=1.0, completed=1.0)
                progress.add_task(text, total=None)
            if share is not None:
                progress.update(progress.tasks[-1].id, total=1.0, completed=share)

        yield say


@contextmanager
def show_progress(total: int, summarize: Callable[[Counter[Any]], str]) -> Iterator[Callable[[Counter[Any]], None]]:
    """Show a bar of `total` steps; yield what moves it on, given the counts so far, which stand beside it.

    Lines printed to a terminal meanwhile appear above it; standard output that goes elsewhere is left alone.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        task = progress.add_task("", total=total)

        def advance(counts: Counter[Any]) -> None:
            progress.update(task, advance=1, description=summarize(counts))

        yield advance


@contextmanager
def print_progress(total: int, summarize: Callable[[Counter[Any]], str]) -> Iterator[Callable[[Counter[Any]], None]]:
    """Do as `show_progress`, in lines such as {"progress": {"done": 3, "total": 10, "text": "2 located, 1 failed"}}."""

    def advance(counts: Counter[Any]) -> None:
        progress = {"done": counts.total(), "total": total, "text": summarize(counts)}
        click.echo(json.dumps({"progress": progress}), err=True)

    yield advance
