"""The hypothesise-and-test loop. It knows no roads and no geometry: a toy model over integers tests it.

The loop drives a problem, or many parts of a problem. Together: breadth first, a little of every part at each stage,
until an answer stands out from all others, whichever parts they come from. Each alone: the most promising part first,
until an answer stands out on its own part. Without such an answer it ends after a limit of work, which is counted, so
that a busy machine finds the same as an idle machine; the clock is the last resort.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

__all__ = ["ALONE", "Ahead", "Estimator", "Search", "SearchOptions", "search_each", "search_together"]


Model = TypeVar("Model")


class Estimator(Protocol[Model]):
    """The interface of a problem, or of a part of it, to the loop."""

    def stages(self) -> Iterator[Iterator[Iterable[Model]]]:
        """Yield the stages, the cheapest first; each yields hypotheses a round at a time, the most promising first.

        All hypotheses that a sample of the query admits belong to the same round, so that twins of a place are met
        together.
        """

    @property
    def work(self) -> float:
        """The work done until now, in seconds of a usual machine; by counts, not by a clock."""

    def settle(self, model: Model) -> tuple[Model, float]:
        """Return a model refined, and its score (log10); -inf for one that is impossible."""


@dataclass(frozen=True)
class SearchOptions:
    """When to stop.

    Attributes
    ----------
    accept : float
        A model that reaches it may end the search.
    work_limit_s : float
        No further round begins, and no further model is settled, after this work: seconds of a usual machine, counted,
        not measured, so that answers do not depend on the load. The limit holds for a map of 15,000 intersections; on a
        larger map it grows by the root of the ratio.
    time_limit_s : float
        The same limit by the clock: the last resort.
    """

    accept: float = 8.0
    work_limit_s: float = 10.0
    time_limit_s: float = 60.0


class _Budget:
    """The work and time of a search, and their limits."""

    def __init__(self, options: SearchOptions) -> None:
        self.work_s, self.limit_s = 0.0, options.work_limit_s
        self.deadline = time.perf_counter() + options.time_limit_s

    @property
    def spent(self) -> str:
        """Return which limit is reached: "work", "time", or "" for neither."""
        if self.work_s >= self.limit_s:
            return "work"
        return "time" if time.perf_counter() > self.deadline else ""


class Search(Generic[Model]):
    """The search of a part, which proceeds a round at a time.

    Attributes
    ----------
    score, best : float, Model or None
        The best model and its score; -inf and None without a model.
    stage : int
        Number of the stage that comes next.
    ended : bool
        Whether all stages are done.
    stopped : str
        Why it ended: "accepted"; "exhausted"; "work" or "time", the limits; or "elsewhere", where another part's answer
        ended the search.
    seconds : float
        Time spent on this part, in searches before this one, too.
    """

    def __init__(self, estimator: Estimator[Model], seconds: float = 0.0) -> None:
        """Begin, without doing anything yet."""
        self.estimator = estimator
        self.score, self.best = float("-inf"), None  # type: float, Model | None
        self.stage = 0
        self.ended = False
        self.stopped = ""
        self.seconds = seconds
        self._charged_s = estimator.work
        self._stages = estimator.stages()
        self._rounds: Iterator[Iterable[Model]] | None = next(self._stages, None)

    def advance(self, budget: _Budget) -> None:
        """Do a round, or pass to the next stage after the last round."""
        started = time.perf_counter()
        models = None if self._rounds is None else next(self._rounds, None)
        if models is None:
            self._rounds = next(self._stages, None)
            self.ended = self._rounds is None
            self.stage += 1
        else:
            self._take(models, budget)
        self._charge(budget)
        self.seconds += time.perf_counter() - started

    def _take(self, models: Iterable[Model], budget: _Budget) -> None:
        """Score the models of a round."""
        for model in models:
            settled, score = self.estimator.settle(model)
            if self.best is None or score > self.score:
                self.score, self.best = score, settled
            self._charge(budget)
            if budget.spent:
                break

    def _charge(self, budget: _Budget) -> None:
        """Charge a budget for the work done since the last call."""
        work = self.estimator.work
        budget.work_s += work - self._charged_s
        self._charged_s = work


def search_together(
    parts: Sequence[Search[Model]],
    options: SearchOptions | None = None,
    proves: Callable[[Sequence[Search[Model]]], Search[Model] | None] | None = None,
) -> None:
    """Search many parts until an answer stands out on all parts, they are exhausted, or a limit is reached.

    Each part does a round in turn, stage after stage: the hypotheses of a sample of the query are met on all parts
    before an answer is accepted. `proves` returns the part whose answer stands out from all others, or None. It is
    called when an answer reaches `SearchOptions.accept`, which is enough without it, and at the end of each stage.
    """
    ended_by = _search_together(parts, options or SearchOptions(), proves)
    for part in parts:
        if ended_by in ("work", "time") and not part.ended:
            part.stopped = ended_by
        else:
            part.stopped = part.stopped or ("exhausted" if part.ended else "elsewhere")


def _search_together(
    parts: Sequence[Search[Model]],
    options: SearchOptions,
    proves: Callable[[Sequence[Search[Model]]], Search[Model] | None] | None,
) -> str:
    """Search until an answer is accepted; return why the search ended."""
    budget, stage = _Budget(options), 0

    def accepts(best: Search[Model] | None) -> bool:
        proved = best if proves is None else proves(parts)
        if proved is not None:
            proved.stopped = "accepted"
        return proved is not None

    while not all(part.ended for part in parts):
        while here := [part for part in parts if part.stage == stage and not part.ended]:
            for part in here:
                part.advance(budget)
                if spent := budget.spent:
                    return spent
            best = max(here, key=lambda part: part.score)
            if best.score >= options.accept and accepts(best):
                return "accepted"
        if accepts(None):
            return "accepted"
        stage += 1
    return "exhausted"


def search_each(
    parts: Mapping[Search[Model], SearchOptions],
    proves: Callable[[Search[Model]], bool],
    promise: Callable[[Search[Model]], float],
    may_go_on: Callable[[Search[Model]], bool] = lambda _: True,
    heard: Callable[[Search[Model]], None] = lambda _: None,
) -> None:
    """Search each part as if it were alone, within its own limits, until the answer of one stands out.

    Parts share the work, searches before it included, as 10 to the power of their `promise`, a log10: a small map does
    not wait for large ones, and where an answer shows, its map is searched first. `proves` returns whether a part has
    the answer. It is called when the best model reaches `SearchOptions.accept`, and at the end of each stage. A later
    stage gets a tenth of the work, and ends unless its part `may_go_on`. `heard` is called with each part before its
    round.
    """
    budgets = {part: _Budget(options) for part, options in parts.items()}

    def done(part: Search[Model]) -> float:
        """Return the log10 of all work done on a part, less its promise, which each stage lowers."""
        work_s = part.estimator.work
        return (math.log10(work_s) if work_s else -math.inf) - promise(part) + part.stage

    turns = {part: done(part) for part in parts}
    while left := [part for part in parts if not part.stopped]:
        part = min(left, key=turns.__getitem__)
        stage = part.stage
        heard(part)
        part.advance(budgets[part])
        ended = part.ended or (part.stage > 0 and not may_go_on(part))
        part.stopped = budgets[part].spent or ("exhausted" if ended else "")
        if (part.score >= parts[part].accept or part.stage > stage or part.stopped) and proves(part):
            part.stopped = "accepted"
        if part.stopped in ("accepted", "time"):
            break
        turns[part] = done(part)
    for part in left:
        part.stopped = part.stopped or ("time" if budgets[part].spent == "time" else "elsewhere")


Item = TypeVar("Item")
Result = TypeVar("Result")


class Ahead:
    """Does independent pieces of work in threads, ahead of their use; with a single thread, each when it is used.

    Attributes
    ----------
    threads : int
    """

    def __init__(self, threads: int = 1) -> None:
        """Begin without threads: they start with the first piece of work."""
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, "roadgeo-search") if threads > 1 else None

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Yield the result of each item, in order; begun for no more than `threads` items beyond those that were used.

        Unused results are dropped.
        """
        if self._pool is None:
            yield from map(work, items)
            return
        begun: deque[Future[Result]] = deque()
        try:
            for item in items:
                begun.append(self._pool.submit(work, item))
                if len(begun) > self.threads:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for future in begun:
                future.cancel()

    def close(self) -> None:
        """End the threads; unfinished results are dropped."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> Ahead:
        """Use it, and close it in the end."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()


#: Each piece of work is done when it is used.
ALONE = Ahead()
