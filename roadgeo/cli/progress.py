"""Progress on standard error: a bar for people, JSON lines for programs."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from roadgeo._progress import Say, say_nothing
from roadgeo.cli.printing import echo, is_set

__all__ = ["count_up", "name_counts", "print_steps", "show_steps"]


@contextmanager
def show_steps() -> Iterator[Say]:
    """Show the steps on standard error: yield a function that receives each step and the share of it that is done.

    On a terminal each step has a bar, with the time it has left where its share is known; elsewhere see `print_steps`.
    """
    as_json = os.environ.get("ROADGEO_PROGRESS") == "json"
    if not is_set("quiet") and not as_json and sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        with _show_bars() as say:
            yield say
    else:
        yield print_steps()


def print_steps() -> Say:
    """Return a function that prints each step once, as a line on standard error.

    Programs that set ROADGEO_PROGRESS=json get lines such as {"progress": {"done": 30, "total": 100, "text": "..."}}
    besides, where a share is known.
    """
    if is_set("quiet"):
        return say_nothing
    as_json = os.environ.get("ROADGEO_PROGRESS") == "json"
    shown: dict[str, int] = {}  # per cent of each step

    def say(text: str, share: float | None = None) -> None:
        if text not in shown:
            echo(f"{text} ...", err=True)
        percent = -1 if share is None else int(100 * share)
        if as_json and percent not in (-1, shown.get(text)):
            _print_json(percent, 100, text)
        shown[text] = percent

    return say


@contextmanager
def _show_bars() -> Iterator[Say]:
    """Yield a function that keeps a bar for every step; all are gone at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
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


def name_counts(counts: Counter[str]) -> str:
    """Count the items of each sort, in order of appearance."""
    return ", ".join(f"{n} {sort}" for sort, n in counts.items())


@contextmanager
def count_up(total: int, summarize: Callable[[Counter[str]], str] = name_counts) -> Iterator[Callable[[str], None]]:
    """Show on standard error how many of `total` are done; yield a function that counts one more of a sort.

    People get a bar on a terminal, unless the JSON of --json fills that too, or there is but one to do. Programs
    that set ROADGEO_PROGRESS=json get lines like {"progress": {"done": 3, "total": 10, "text": "2 located, 1 failed"}}.
    """
    counts: Counter[str] = Counter()
    if os.environ.get("ROADGEO_PROGRESS") == "json":
        show: AbstractContextManager[Callable[[str], None]] = nullcontext(
            lambda text: _print_json(counts.total(), total, text)
        )
    elif is_set("quiet") or total < 2 or not sys.stderr.isatty() or (is_set("as_json") and sys.stdout.isatty()):
        show = nullcontext(lambda _: None)
    else:
        show = _show_bar(total)
    with show as tell:

        def count(sort: str) -> None:
            counts[sort] += 1
            tell(summarize(counts))

        yield count


def _print_json(done: int, total: int, text: str) -> None:
    echo(json.dumps({"progress": {"done": done, "total": total, "text": text}}), err=True)


@contextmanager
def _show_bar(total: int) -> Iterator[Callable[[str], None]]:
    """Show a bar of `total` steps; yield a function that moves it on, with a text beside it.

    Lines printed to a terminal meanwhile appear above it; standard output that goes elsewhere is left alone.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        task = progress.add_task("", total=total)
        yield lambda text: progress.update(task, advance=1, description=text)
