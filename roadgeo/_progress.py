"""Telling what is being done, and how much of it: what long steps call and faces show."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Say", "say_nothing"]


class Say(Protocol):
    """Told what is being done and, where that is known, which share of it is done already, 0 to 1.

    The same text again, with another share, means the same step.
    """

    def __call__(self, text: str, share: float | None = None) -> None:
        """Tell it."""


def say_nothing(text: str, share: float | None = None) -> None:
    """Be the `Say` of callers that do not care."""
