"""A progress bar on standard error."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["show_progress"]


@contextmanager
def show_progress(total: int, summarize: Callable[[Counter[Any]], str]) -> Iterator[Callable[[Counter[Any]], None]]:
    """Show a bar of `total` steps; yield what moves it on, given the counts so far, which stand beside it.

    Lines printed to a terminal meanwhile appear above it; standard output that goes elsewhere is left alone.
    """
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        task = progress.add_task("", total=total)

        def advance(counts: Counter[Any]) -> None:
            progress.update(task, advance=1, description=summarize(counts))

        yield advance
