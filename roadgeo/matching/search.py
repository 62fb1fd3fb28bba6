"""The hypothesise-and-test loop. It knows no roads and no geometry: a toy model over integers tests it."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

__all__ = ["Estimator", "SearchOptions", "SearchResult", "search"]

Model = TypeVar("Model")


class Estimator(Protocol[Model]):
    """What the loop asks of a problem."""

    def rounds(self) -> Iterator[Iterable[Model]]:
        """Yield hypotheses, a round at a time, the most promising rounds first.

        All hypotheses that one sample of the query admits belong to one round, so that twins of a place are met
        together.
        """

    def score(self, model: Model) -> float:
        """Return the log10 odds of a model against chance."""

    def settled(self, model: Model) -> bool:
        """Whether a model is complete, so that no better version of the same answer is to be expected."""

    def same(self, a: Model, b: Model) -> bool:
        """Whether two models mean the same answer."""


@dataclass(frozen=True)
class SearchOptions:
    """When to stop.

    Attributes
    ----------
    accept : float
        A round ends the search when its best model is settled, reaches this score ...
    margin : float
        ... and leads the best different model by as much.
    more_rounds : int
        A model that reaches both but is not settled is kept for so many more rounds, in case a better version comes.
    time_limit_s : float
        No further round is begun, and no further model scored, after this time.
    """

    accept: float = 8.0
    margin: float = 4.0
    more_rounds: int = 25
    time_limit_s: float = 10.0


@dataclass(frozen=True)
class SearchResult(Generic[Model]):
    """Best model, the best that means something else, their scores (-inf where there is none), and what ended it."""

    best: Model | None
    score: float
    runner_up: Model | None
    runner_up_score: float
    n_rounds: int
    n_scored: int
    stopped: str  # "accepted", "exhausted" or "time"


def search(estimator: Estimator[Model], options: SearchOptions | None = None) -> SearchResult[Model]:
    """Score hypotheses round by round until one stands out, they are exhausted, or time is up."""
    options = options or SearchOptions()
    deadline = time.perf_counter() + options.time_limit_s
    leaders: list[tuple[float, Model]] = []  # the best model of each of the two best answers, best first
    n_rounds = n_scored = 0
    first_accepted: int | None = None
    stopped = "exhausted"
    for models in estimator.rounds():
        n_rounds += 1
        for model in models:
            leaders = _enter(leaders, (estimator.score(model), model), estimator)
            n_scored += 1
            if time.perf_counter() > deadline:
                break
        lead = leaders[0][0] if leaders else float("-inf")
        second = leaders[1][0] if len(leaders) > 1 else float("-inf")
        if lead >= options.accept and lead - second >= options.margin:
            if first_accepted is None:
                first_accepted = n_rounds
            if estimator.settled(leaders[0][1]) or n_rounds - first_accepted >= options.more_rounds:
                stopped = "accepted"
                break
        if time.perf_counter() > deadline:
            stopped = "time"
            break
    best = leaders[0] if leaders else (float("-inf"), None)
    runner_up = leaders[1] if len(leaders) > 1 else (float("-inf"), None)
    return SearchResult(best[1], best[0], runner_up[1], runner_up[0], n_rounds, n_scored, stopped)


def _enter(
    leaders: Sequence[tuple[float, Model]], entry: tuple[float, Model], estimator: Estimator[Model]
) -> list[tuple[float, Model]]:
    """Return the two best different answers after a new one came in."""
    ranked = sorted([*leaders, entry], key=lambda item: -item[0])
    kept = ranked[:1]
    for candidate in ranked[1:]:
        if not estimator.same(candidate[1], kept[0][1]):
            kept.append(candidate)
            break
    return kept
