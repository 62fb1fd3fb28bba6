"""Work done ahead of its use: the next few of many independent pieces, in threads, while one is used.

The search for one intersection of the query does not depend on the results of another. Kernels let other threads
run, so as many intersections are searched at a time as there are processors, and their results are used in
order: an answer does not depend on the number of threads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

__all__ = ["ALONE", "Ahead"]

Item = TypeVar("Item")
Result = TypeVar("Result")


class Ahead:
    """Does independent pieces of work ahead of their use in a number of threads; in one, each when it is used.

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
            for one in begun:
                one.cancel()

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
