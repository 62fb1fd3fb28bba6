"""What the command line shows while it works, on terminals and elsewhere."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import click
import pytest
from worlds.fenway import write_streets

from roadgeo.cli.progress import print_steps, show_steps


def walk(say):
    """Take three steps, of which one has a share."""
    say("reading")
    for k in range(200):
        say("drawing", k / 200)
    say("writing")
    say("reading")  # another pass


@pytest.mark.parametrize(("quiet", "said"), [(False, "reading ...\ndrawing ...\nwriting ...\n"), (True, "")])
def test_elsewhere_each_step_is_one_line_and_quiet_is_quiet(quiet, said, capsys, monkeypatch):
    monkeypatch.delenv("ROADGEO_PROGRESS", raising=False)
    with click.Context(click.Command("index")) as context:
        context.meta["roadgeo.quiet"] = quiet
        with show_steps() as say:
            walk(say)
    assert capsys.readouterr() == ("", said)


def test_programs_get_lines_of_json_each_per_cent_once(capsys, monkeypatch):
    monkeypatch.setenv("ROADGEO_PROGRESS", "json")
    walk(print_steps())
    output = capsys.readouterr().err.splitlines()
    shares = [json.loads(line)["progress"] for line in output if line.startswith("{")]
    assert shares == [{"done": k, "total": 100, "text": "drawing"} for k in range(100)]
    assert [line for line in output if not line.startswith("{")] == ["reading ...", "drawing ...", "writing ..."]


class Terminal:
    """A command whose standard error is a pseudo-terminal."""

    def __init__(self, *command):
        pty = pytest.importorskip("pty")
        self.leader, follower = pty.openpty()
        environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
        environment.pop("ROADGEO_PROGRESS", None)
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=follower, env=environment)
        os.close(follower)
        self.text = ""

    def read_until(self, pattern):
        while not re.search(pattern, self.text):
            try:
                part = os.read(self.leader, 65536)
            except OSError:
                part = b""
            assert part, f"{pattern!r} was not shown: {self.text!r}"
            self.text += part.decode()

    def end(self):
        try:
            while part := os.read(self.leader, 65536):
                self.text += part.decode()
        except OSError:  # the other end is closed
            pass
        os.close(self.leader)
        return self.process.wait()


def test_on_a_terminal_each_step_has_a_bar_and_nothing_of_it_stays():
    steps = """
import time
from roadgeo.cli.progress import show_steps
with show_steps() as say:
    say("asking")
    for k in range(10):
        say("reading roads.osm.pbf", k / 10)
        time.sleep(0.06)
"""
    terminal = Terminal(sys.executable, "-c", steps)
    assert terminal.end() == 0
    assert re.search(r"reading roads\.osm\.pbf.* [3-9]0%", terminal.text)
    assert "\x1b[?25h" in terminal.text  # the cursor is back
    assert re.search(r"\x1b\[1A\x1b\[2K\s*$", terminal.text)  # and the last lines are gone


def test_on_a_terminal_many_masks_are_counted_beside_a_bar():
    """Nothing of the bar stays; lines that are printed meanwhile do."""
    code = """
import time
from roadgeo.cli.printing import echo
from roadgeo.cli.progress import count_up
with count_up(3) as count:
    for sort in ("located", "located", "not located"):
        time.sleep(0.2)
        echo(f"one more {sort}", err=True)
        count(sort)
    time.sleep(0.2)
"""
    terminal = Terminal(sys.executable, "-c", code)
    assert terminal.end() == 0
    assert re.search(r"2/3.* 2 located", terminal.text)
    assert re.search(r"3/3.* 2 located, 1 not located", terminal.text)
    assert terminal.text.count("one more") == 3
    assert "\x1b[?25h" in terminal.text
    assert re.search(r"\x1b\[2K\s*$", terminal.text)


@pytest.mark.parametrize(("total", "quiet"), [(3, True), (1, False)])
def test_a_single_mask_and_a_quiet_run_have_no_bar(total, quiet):
    code = f"""
import click
from roadgeo.cli.progress import count_up
with click.Context(click.Command("locate")) as context:
    context.meta["roadgeo.quiet"] = {quiet}
    with count_up({total}) as count:
        count("located")
"""
    terminal = Terminal(sys.executable, "-c", code)
    assert terminal.end() == 0
    assert terminal.text == ""


@pytest.mark.parametrize("step", ["reading", "writing"])
def test_ctrl_c_during_any_step_leaves_nothing_behind(tmp_path, step):
    """The command waits in that step, as it would with a large map."""
    out = tmp_path / "out"
    streets = write_streets(tmp_path / "a.geojson")
    code = """
import sys, time
from contextlib import contextmanager
from roadgeo.cli import main, progress
shown = progress.show_steps
@contextmanager
def slow_steps():
    with shown() as say:
        def wait(text, share=None):
            say(text, share)
            if text.startswith(sys.argv[1]):
                time.sleep(60)
        yield wait
progress.show_steps = slow_steps
sys.exit(main(sys.argv[2:]))
"""
    terminal = Terminal(sys.executable, "-c", code, step, "index", "--roads", str(streets), "-o", str(out / "a.gpkg"))
    terminal.read_until(step)
    time.sleep(0.1)
    terminal.process.send_signal(signal.SIGINT)
    assert terminal.end() == 130
    assert terminal.text.rstrip().endswith("Interrupted.")
    assert "\x1b[?25h" in terminal.text
    assert not list(out.iterdir())
