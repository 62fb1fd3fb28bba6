"""Names of files and of references, and what files say, are shown on a terminal, not obeyed by it."""

import json
import logging
import os
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
from worlds.fenway import write_streets

from roadgeo._text import visible
from roadgeo.cli import main
from roadgeo.cli.locate import locate_command
from roadgeo.cli.printing import echo, paint, plain
from roadgeo.errors import MaskError
from roadgeo.running.tasks import name_tasks
from roadgeo.sources.streams import tell_source

ESCAPES = "a\x1b]0;owned\x07\x1b[2J\x9b31m\u202eb"
FORBIDDEN = ("\x1b", "\x07", "\x9b", "\u202e")


def test_what_a_terminal_obeys_is_shown_instead() -> None:
    assert visible(ESCAPES) == "a\\x1b]0;owned\\x07\\x1b[2J\\x9b31m\\u202eb"
    assert visible("two\nlines\r\n and\ttabs") == "two lines  and tabs"
    assert visible("Zürich 東京 नगर 👩‍🚀") == "Zürich 東京 नगर 👩‍🚀"
    assert visible(os.fsdecode(b"caf\xe9")) == "caf\\udce9"
    assert str(MaskError(f"{ESCAPES}\n: no such file")) == f"{visible(ESCAPES)} : no such file"


def test_our_own_colours_and_lines_stay_and_no_others(capsys: pytest.CaptureFixture[str]) -> None:
    """Colours in names were obeyed."""
    text = f"{paint('Error:', 'red')} one\n  \x1b[31mtwo \x1b[8m hidden"
    echo(text, color=True)
    assert capsys.readouterr().out == "\x1b[31mError:\x1b[0m one\n  \\x1b[31mtwo \\x1b[8m hidden\n"
    assert plain(text) == "Error: one\n  \x1b[31mtwo \x1b[8m hidden"


@pytest.mark.parametrize(
    ("others", "status"), [(["-q"], 0), (["-v"], 0), (["-q", "--no-such"], 2), (["-q", "--memory", "x"], 2)]
)
def test_the_log_is_as_quiet_after_a_command_as_before(others: list[str], status: int, tmp_path: Path) -> None:
    """A program that ran a command with -q had no warnings any more."""
    log = logging.getLogger("roadgeo")
    before = log.level
    assert main(["index", "--roads", str(write_streets(tmp_path / "streets.gpkg")), *others]) == status
    assert log.level == before


def test_a_command_that_is_only_parsed_leaves_the_log_alone() -> None:
    """Whoever read the options of a command had fewer messages from then on."""
    log = logging.getLogger("roadgeo")
    before = log.level
    locate_command.make_context("locate", ["image.tif"])
    assert log.level == before


@pytest.mark.parametrize("name", [f"[bold]{ESCAPES}.png", os.fsdecode(b"caf\xe9\n.png")])
def test_names_of_masks_do_not_speak_to_the_terminal(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    mask = np.zeros((64, 64), np.uint8)
    mask[30:34] = 255
    (tmp_path / name).write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    write_streets(tmp_path / "roads.gpkg")
    assert main(["index", "--roads", str(tmp_path / "roads.gpkg"), "--out", str(tmp_path / "r.gpkg"), "-q"]) == 0
    (tmp_path / f"not_{name}").write_bytes(b"no image")
    masks = [str(tmp_path / name), str(tmp_path / f"not_{name}")]
    assert main(["locate", *masks, "-r", str(tmp_path / "r.gpkg"), "-o", str(tmp_path), "--verbose"]) == 1
    assert main(["vectorize", *masks, "-o", str(tmp_path)]) == 1
    said = "".join(capfd.readouterr())
    assert not [item for item in FORBIDDEN if item in said]
    assert "intersections are seen" in said or "its name is not valid text" in said
    assert "fault of roadgeo" not in said


def test_names_of_references_do_not_speak_to_the_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path))
    write_streets(tmp_path / "roads.geojson")
    index = ["index", "--roads", str(tmp_path / "roads.geojson"), "--out"]
    assert main([*index, str(tmp_path / f"{ESCAPES}.gpkg")]) == 0
    with sqlite3.connect(tmp_path / f"{ESCAPES}.gpkg") as database:
        reported = (json.dumps(f"{ESCAPES}\nOpenStreetMap"), "attribution")
        database.execute("UPDATE roadgeo_meta SET value = ? WHERE key = ?", reported)
    assert main(["reference", "list"]) == 0
    assert main(["reference", "info", str(tmp_path / f"{ESCAPES}.gpkg")]) == 0
    main(["reference", "check", str(tmp_path / f"{ESCAPES}.gpkg")])
    assert main(["locate", "missing.png", "-r", f"no{ESCAPES}"]) == 1
    said = "".join(capfd.readouterr())
    assert not [item for item in FORBIDDEN if item in said]
    assert "\\x1b]0;owned" in said


def test_lines_of_the_log_show_what_names_hold(caplog: pytest.LogCaptureFixture) -> None:
    tell_source(f"{ESCAPES}.gpkg", {"part": f"layer {ESCAPES} of 2", "kinds_known": True})
    assert not [item for item in FORBIDDEN if item in caplog.text]
    assert caplog.text.count("\\x1b]0;owned") == 2


@pytest.mark.parametrize("letter", ["a", "ü", "東"])
def test_long_names_leave_room_for_what_is_put_behind_them(letter: str, tmp_path: Path) -> None:
    """Names of 236 bytes and more left none, and what was found could not be written."""
    longest = letter * (250 // len(letter.encode()))
    first, second = name_tasks([f"{tmp_path}/{longest}.png", f"{tmp_path}/{longest[:-1]}x.png"])
    assert first.stem != second.stem
    assert first.stem[:50] == longest[:50]
    assert max(len(os.fsencode(item.stem)) for item in (first, second)) <= 180
    assert name_tasks([f"{tmp_path}/{letter * 60}.png"])[0].stem == letter * 60
