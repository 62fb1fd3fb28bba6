import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from support.groups import is_gone

from roadgeo.running.pool import Asker, Lost
from roadgeo.running.processes import Processes, run


@dataclass(frozen=True)
class Shout:
    """A toy: upper case, slower for "a" and "late"; dies at "die"."""

    def prepare(self) -> Callable[[str], str]:
        return self.do

    def do(self, task: str) -> str:
        if task == "die":
            os._exit(1)
        time.sleep({"a": 0.05, "late": 60}.get(task, 0))
        return task.upper()

    def give_up(self, task: str, lost: Lost) -> str:
        return f"{task}: {lost.said}"


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_tasks(jobs: int) -> None:
    assert list(run(["a", "b", "c"], Shout(), jobs)) == ["A", "B", "C"]


def test_a_process_that_dies_costs_one_result() -> None:
    results = list(run(["a", "b", "die", "c", "d"], Shout(), 2))
    assert results == ["A", "B", "die: the process that worked on it died (out of memory?)", "C", "D"]


def test_who_stops_early_ends_the_workers_and_no_process_of_the_program() -> None:
    other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    other.start()
    try:
        results = run(["a", "b", "c"], Shout(), 2)
        assert next(results) == "A"
        results.close()
        assert multiprocessing.active_children() == [other]
    finally:
        other.kill()
        other.join()


def test_who_closes_waits_for_the_end_of_one_that_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    kill, killed = BaseProcess.kill, threading.Event()

    def kill_late(process: BaseProcess) -> None:
        killed.set()
        time.sleep(0.3)
        kill(process)

    monkeypatch.setattr(BaseProcess, "kill", kill_late)
    with contextlib.closing(Processes(Shout(), 1)) as processes:
        processes.wait_until_ready()
        processes.submit("late", Asker(patience_s=0.1))
        assert killed.wait(30)
    assert multiprocessing.active_children() == []


_SLOW = """
import sys, time
from dataclasses import dataclass
from roadgeo.running.processes import run
@dataclass(frozen=True)
class Slow:
    def prepare(self): return self.do
    def do(self, task):
        try:
            time.sleep(0 if task == 'a' else 60)
        finally:
            open(task, 'w').close()
    def give_up(self, task, lost): pass
if __name__ == '__main__':
    for _ in run(list('abcdef'), Slow(), 3): print('one', flush=True)
"""


def start_slow(folder: Path) -> subprocess.Popen[str]:
    """Start the program in a group of its own."""
    command, pipe = [sys.executable, "slow.py"], subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_an_interrupt_ends_the_workers(tmp_path: Path) -> None:
    """Ctrl-C goes to the whole group; nobody is left behind, and nobody prints a traceback."""
    (tmp_path / "slow.py").write_text(
        _SLOW.replace("Slow(), 3", "Slow(), 2").replace("\n    for _", "\n  try:\n    for _")
        + "  except KeyboardInterrupt:\n    sys.exit(130)\n"
    )
    process = start_slow(tmp_path)
    assert process.stdout.readline() == "one\n"
    time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=10)
    assert process.returncode == 130
    assert err == ""
    assert (tmp_path / "b").exists()  # the worker was told, and cleaned up
    assert not (tmp_path / "f").exists()  # and did not go on with what waited
    assert is_gone(process.pid)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_workers_do_not_outlive_whoever_started_them(how: signal.Signals, tmp_path: Path) -> None:
    """Those that work clean up first; those that wait for work end, too."""
    (tmp_path / "slow.py").write_text(_SLOW)
    with start_slow(tmp_path) as process:
        try:
            process.stdout.readline()
            time.sleep(0.3)
            os.kill(process.pid, how)
            process.wait(timeout=10)
            assert is_gone(process.pid)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert (tmp_path / "b").exists()
    assert not (tmp_path / "f").exists()


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("after_s", [0.05, 0.4, 1.0])
def test_an_interrupt_while_workers_start_is_no_traceback(after_s: float, tmp_path: Path) -> None:
    script = _SLOW.replace("    for _", "    print('starting', flush=True)\n    for _")
    (tmp_path / "slow.py").write_text(script.replace("list('abcdef')", "list('bcdef')"))
    with start_slow(tmp_path) as process:
        process.stdout.readline()
        time.sleep(after_s)
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=20)
        assert err.count("Traceback") == 1, err  # the script's own, which asks for none to be caught
        assert is_gone(process.pid)


@pytest.mark.parametrize(("guard", "status"), [("", 1), ("if __name__ == '__main__':", 0)])
def test_a_script_that_would_start_itself_again_is_told_so(guard: str, status: int, tmp_path: Path) -> None:
    """Its processes died, and masks failed for want of memory, it was said."""
    script = tmp_path / "script.py"
    begin = guard or "if True:"
    script.write_text(
        f"from running.test_processes import Shout\nfrom roadgeo.running.processes import run\n{begin}\n"
        "    print(list(run(list('abc'), Shout(), 2)))\n"
    )
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": f"{tests}{os.pathsep}{tests.parent}"}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == status, done.stderr
    assert "['A', 'B', 'C']" in done.stdout if guard else "put what it does under if __name__ ==" in done.stderr
