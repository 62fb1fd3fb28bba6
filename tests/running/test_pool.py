"""The pool, on workers that are threads of the test, and on processes."""

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from roadgeo.errors import RoadgeoError
from roadgeo.running.pool import Asker, Lost, Pool
from roadgeo.running.processes import Processes, tell

GIVE_UP = SimpleNamespace(give_up=lambda task, lost: f"{task}: {lost.said}")


@dataclass
class Toys(Pool):
    """Workers that answer with the task; `deaths` says how often they die of which."""

    workers: int = 2
    deaths: dict[int, int] = field(default_factory=dict)
    slow: int = -1
    begun: list[int] = field(default_factory=list)
    beside: dict[int, int] = field(default_factory=dict)
    inside: int = 0
    goes_on: threading.Event = field(default_factory=threading.Event)

    work = GIVE_UP

    def __post_init__(self):
        self.threads = ThreadPoolExecutor(self.workers)

    def count(self) -> int:
        return self.workers

    def submit(self, task, *_):
        return self.threads.submit(self.ask, task)

    def result(self, future, *_):
        return future.result()

    def ask(self, task):
        self.begun.append(task)
        self.inside += 1
        self.beside[task] = self.inside
        try:
            if task == self.slow:
                self.goes_on.wait(10)
            time.sleep(0.002)
            if self.deaths.get(task, 0):
                self.deaths[task] -= 1
                return Lost("died", "they died")
            return task
        finally:
            self.inside -= 1


def test_a_task_whose_worker_died_is_done_again_alone_and_then_lost() -> None:
    toys = Toys(4, {3: 1, 7: 2})
    found = list(toys.run(range(20)))
    assert [result for k, result in enumerate(found) if k != 7] == [k for k in range(20) if k != 7]
    assert found[7] == "7: they died"
    assert (toys.begun.count(3), toys.begun.count(7)) == (2, 2)
    assert (toys.beside[3], toys.beside[7]) == (1, 1)
    assert max(toys.beside.values()) <= 4


def test_a_slow_task_stops_no_other_and_results_that_wait_are_bounded() -> None:
    toys = Toys(2, slow=0)
    results = toys.run(range(200))
    reader = threading.Timer(0.5, toys.goes_on.set)
    reader.start()
    assert next(results) == 0
    assert 20 < len(toys.begun) <= 33
    assert list(results) == list(range(1, 200))


def test_what_a_task_raises_is_raised_and_no_other_begins() -> None:
    toys = Toys()
    toys.ask = lambda task: toys.begun.append(task) or 1 / 0
    with pytest.raises(ZeroDivisionError):
        list(toys.run(range(200)))
    assert len(toys.begun) <= 32


@dataclass(frozen=True)
class Tasks:
    """Says its process, waits, tells how far it is, or fails, as it is told."""

    prepares: bool = True

    def prepare(self):
        if not self.prepares:
            raise RoadgeoError("no map")
        return self.do

    def do(self, task: str) -> object:
        if task == "wait":
            time.sleep(60)
        if task == "tell":
            tell("half", 0.5)
        if task == "fail":
            raise RoadgeoError("no road")
        if task == "odd":
            raise _OddError("one", two=2)
        return os.getpid()

    def give_up(self, task: str, lost: Lost) -> Lost:
        return lost


class _OddError(Exception):
    """Cannot be sent to another process."""

    def __init__(self, one: str, *, two: int) -> None:
        super().__init__(one, two)


@pytest.fixture(scope="module")
def pool():
    processes = Processes(Tasks(), 1)
    yield processes
    processes.close()


def done(pool: Pool, task: str, *how: object, **more: object) -> object:
    (result,) = pool.run([task], Asker(*how, **more))
    return result


def test_progress_is_passed_on_and_errors_are_raised(pool: Pool) -> None:
    messages: list[object] = []
    process = done(pool, "tell", say=lambda *said: messages.append(said))
    assert messages == [("half", 0.5)]
    with pytest.raises(RoadgeoError, match="no road"):
        done(pool, "fail")
    with pytest.raises(RuntimeError, match="_OddError"):
        done(pool, "odd")
    assert done(pool, "") == process


def test_what_takes_too_long_or_is_called_off_is_ended(pool: Pool) -> None:
    before = done(pool, "")
    assert done(pool, "wait", 0.2) == Lost("late", "longer than 0.2 s")
    assert done(pool, "") != before
    called_off = threading.Event()
    threading.Timer(0.3, called_off.set).start()
    assert done(pool, "wait", called_off=called_off).why == "called off"
    before = done(pool, "")
    assert done(pool, "wait", called_off=called_off).why == "called off"
    assert done(pool, "") == before  # nobody had begun


def test_who_is_called_off_does_not_wait_for_a_process(pool: Pool) -> None:
    assert done(pool, "")
    called_off, ends = threading.Event(), threading.Event()
    beside = threading.Thread(target=done, args=(pool, "wait"), kwargs={"called_off": ends})
    beside.start()
    while pool._idle:
        time.sleep(0.01)
    threading.Timer(0.1, called_off.set).start()
    assert done(pool, "", called_off=called_off).why == "called off"
    assert not pool._idle
    ends.set()
    beside.join()


def test_who_fails_to_hear_the_progress_leaves_no_answer_to_the_next(pool: Pool) -> None:
    with pytest.raises(ZeroDivisionError):
        done(pool, "tell", say=lambda *_: 1 / 0)
    with pytest.raises(RoadgeoError, match="no road"):
        done(pool, "fail")


class _Unreadable:
    """Cannot be read by another process."""

    def __reduce__(self) -> object:
        return int, ("none",)


def test_a_task_that_a_process_cannot_read_is_lost(pool: Pool) -> None:
    assert done(pool, _Unreadable()).why == "died"
    assert done(pool, "")


def test_no_thread_is_left_of_a_pool_that_is_closed() -> None:
    """An interrupt may come while one starts: the program would wait for it in the end."""
    processes = Processes(Tasks(), 1)
    assert done(processes, "")
    others = {thread for thread in threading.enumerate() if thread not in processes._threads._threads}
    processes.close()
    until = time.monotonic() + 10.0
    while set(threading.enumerate()) - others:
        assert time.monotonic() < until
        time.sleep(0.01)


def test_processes_that_cannot_prepare_say_why() -> None:
    processes = Processes(Tasks(prepares=False), 1)
    for _ in range(2):
        with pytest.raises(RoadgeoError, match="no map"):
            done(processes, "")
    processes.close()
    assert done(processes, "").why == "no worker"
