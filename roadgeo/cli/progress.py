"""Progress on standard error: a bar for people, JSON lines for programs."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import click

__all__ = ["print_progress", "show_progress"]


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
