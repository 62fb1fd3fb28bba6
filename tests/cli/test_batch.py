import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from roadgeo.cli.batch import Task, find_masks, name_tasks, run


@dataclass(frozen=True)
class Shout:
    """A toy: upper case, slower for earlier tasks; dies at "die"."""

    def prepare(self) -> Callable[[Task], str]:
        return self.do

    def do(self, task: Task) -> str:
        if task.mask == "die":
            os._exit(1)
        time.sleep(0.05 if task.mask == "a" else 0)
        return task.mask.upper()

    def give_up(self, task: Task, reason: str) -> str:
        return f"{task.mask}: {reason}"


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_tasks(jobs: int) -> None:
    assert list(run(name_tasks(["a", "b", "c"]), Shout(), jobs)) == ["A", "B", "C"]


def test_a_process_that_dies_costs_one_result() -> None:
    results = list(run(name_tasks(["a", "b", "die", "c", "d"]), Shout(), 2))
    assert results == ["A", "B", "die: the process that worked on it died (out of memory?)", "C", "D"]


def test_folders_and_patterns_are_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "masks"
    folder.mkdir()
    for name in ("b.png", "a.tif", "a_footprint.tif", "b_overlay.png", ".c.png", "notes.txt", "odd[1].png"):
        (folder / name).touch()
    assert find_masks(["masks"]) == [str(Path("masks", name)) for name in ("a.tif", "b.png", "odd[1].png")]
    assert find_masks([str(Path("masks", "?.png")), "missing.png"]) == [str(Path("masks", "b.png")), "missing.png"]
    assert find_masks([str(Path("masks", "odd[1].png"))]) == [str(Path("masks", "odd[1].png"))]
    assert find_masks(["none*.png"]) == ["none*.png"]


def test_results_never_share_a_name() -> None:
    tasks = name_tasks(["x/q.png", "y/q.png", "y/q.tif", "y/r.png"])
    assert [task.stem for task in tasks] == ["x_q", "y_q_png", "y_q_tif", "r"]


@pytest.mark.parametrize(
    "masks",
    [
        ["p/x.png", "p/x.tif", "q/p_x_2.png"],
        ["p/x.png", "p/x.tif", "q/p_x_tif.png"],
        ["a/q.png", "a/Q.png", "b/Q.PNG"],
        ["q.png", "q.png", "./q.png", "a/../q.png"],
        ["1/a/x.png", "2/a/x.png"],
    ],
)
def test_no_two_results_have_one_name(masks: list[str]) -> None:
    for order in (masks, masks[::-1]):
        stems = [task.stem.casefold() for task in name_tasks(order)]
        assert len(set(stems)) == len(masks)


def test_a_name_does_not_depend_on_the_order() -> None:
    masks = ["p/x.png", "p/x.tif", "q/x.png", "r/x.png"]
    names = {task.mask: task.stem for task in name_tasks(masks)}
    assert {task.mask: task.stem for task in name_tasks(masks[::-1])} == names


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_an_interrupt_ends_the_workers(tmp_path: Path) -> None:
    """Ctrl-C goes to the whole group; nobody is left behind, and nobody prints a traceback."""
    script = tmp_path / "interrupted.py"
    script.write_text(
        "import sys, time\n"
        "from dataclasses import dataclass\n"
        "from roadgeo.cli.batch import name_tasks, run\n"
        "@dataclass(frozen=True)\n"
        "class Slow:\n"
        "    def prepare(self): return self.do\n"
        "    def do(self, task):\n"
        "        try:\n"
        "            time.sleep(0 if task.mask == 'a' else 60)\n"
        "        finally:\n"
        "            open(task.mask, 'w').close()\n"
        "    def give_up(self, task, reason): pass\n"
        "if __name__ == '__main__':\n"
        "    try:\n"
        "        for _ in run(name_tasks('abcdef'), Slow(), 2): print('one', flush=True)\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(130)\n"
    )
    process = subprocess.Popen(
        [sys.executable, str(script)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout.readline() == "one\n"
    time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=10)
    assert process.returncode == 130
    assert err == ""
    assert (tmp_path / "b").exists()  # the worker was told, and cleaned up
    assert not (tmp_path / "f").exists()  # and did not go on with what waited
    assert is_gone(process.pid)


def is_gone(group: int) -> bool:
    for _ in range(50):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False
