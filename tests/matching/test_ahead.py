"""Work ahead of its use: in order, no further ahead than there are threads, dropped where it is not used."""

import os
import threading
import time
from itertools import count, islice

import numpy as np
import pytest

from roadgeo.kernels.roads import bin_segments
from roadgeo.matching.search import ALONE, Ahead


@pytest.fixture(params=[1, 2, 5])
def ahead(request):
    made = Ahead(request.param)
    yield made
    made.close()


def test_what_comes_of_items_keeps_their_order(ahead):
    def work(n):
        time.sleep(0.01 * (n % 3))
        return n * n

    assert list(ahead.map(work, range(12))) == [n * n for n in range(12)]


def test_it_is_begun_for_so_many_items_and_no_more(ahead):
    begun = []
    results = ahead.map(lambda n: begun.append(n) or n, count())
    assert list(islice(results, 4)) == [0, 1, 2, 3]
    results.close()
    assert len(begun) <= 4 + (0 if ahead.threads == 1 else ahead.threads)


def test_alone_each_is_done_when_it_is_used():
    begun = []
    results = ALONE.map(lambda n: begun.append(n) or n, range(3))
    assert not begun
    assert next(results) == 0
    assert begun == [0]


def test_items_are_worked_on_at_the_same_time():
    both = threading.Barrier(2, timeout=30)
    with Ahead(2) as ahead:
        assert len(list(ahead.map(lambda _: both.wait(), range(4)))) == 4


def test_what_goes_wrong_is_told_where_it_is_used(ahead):
    results = ahead.map(lambda n: 1 // (2 - n), range(5))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}, reason="kernels are plain Python")
def test_kernels_let_other_threads_run():
    """A kernel that takes long does not keep another thread from counting."""
    segments = np.random.default_rng(1).uniform(0, 1000, (50_000, 4)).astype(np.float32)
    many = np.concatenate([segments] * 4)

    def run(given):
        bin_segments(given, (0.0, 0.0, 10.0), (100, 100), np.zeros(10_001, np.int64), np.empty(0, np.int32))

    run(segments[:10])
    done, ticks = threading.Event(), []

    def tick():
        while not done.wait(0.001):
            ticks.append(time.perf_counter())

    other = threading.Thread(target=tick)
    other.start()
    started = time.perf_counter()
    run(many)
    ended = time.perf_counter()
    done.set()
    other.join()
    assert sum(started < item < ended for item in ticks) >= 3
