"""Telling what is being done, and how much of it: what long steps call and faces show."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, TypeAlias

__all__ = ["Counting", "Say", "count_nothing", "say_nothing"]


class Say(Protocol):
    """Told what is being done and, where that is known, which share of it is done already, 0 to 1.

    The same text again, with another share, means the same step.
    """

    def __call__(self, text: str, share: float | None = None) -> None:
        """Tell it."""


def say_nothing(text: str, share: float | None = None) -> None:
    """Be the `Say` of callers that do not care."""


#: Given how many there are to do, shows how many are done; what it yields counts one more of a sort ("located").
Counting: TypeAlias = Callable[[int], AbstractContextManager[Callable[[str], None]]]


def count_nothing(total: int) -> AbstractContextManager[Callable[[str], None]]:  # noqa: ARG001 (the shape of `Counting`)
    """Show nothing: for callers that do not ask."""
    return nullcontext(lambda _: None)
