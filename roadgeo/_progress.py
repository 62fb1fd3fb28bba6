"""Progress call-backs of long steps, shown by the command line and QGIS."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, TypeAlias

__all__ = ["Counting", "Say", "count_nothing", "say_nothing"]


class Say(Protocol):
    """Progress call-back: name of the current step and, if known, the fraction completed (0 to 1).

    The same name with another fraction means the same step.
    """

    def __call__(self, text: str, share: float | None = None) -> None:
        """Report progress."""


def say_nothing(text: str, share: float | None = None) -> None:
    """Ignore progress reports."""


#: Called with the number of items, shows how many are done; yields a function that counts one more ("located").
Counting: TypeAlias = Callable[[int], AbstractContextManager[Callable[[str], None]]]


def count_nothing(total: int) -> AbstractContextManager[Callable[[str], None]]:  # noqa: ARG001 (the shape of `Counting`)
    """Ignore counts."""
    return nullcontext(lambda _: None)
