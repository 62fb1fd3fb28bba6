"""The program roadgeo as a child of QGIS: where it is looked for, what it inherits, how it is heard and stopped."""

import sys
import time
from pathlib import Path

import pytest
from support.real_qgis import is_running, make_program

from roadgeo.qgis.plugin import runner

# --- finding programs -------------------------------------------------------------------------------------------------


def test_the_executable_is_what_the_user_chose(tmp_path: Path) -> None:
    beside = tmp_path / "plugin"
    beside.mkdir()
    places = [
        tmp_path / "path" / "roadgeo",
        tmp_path / "remembered" / "roadgeo",
        tmp_path / "named" / "roadgeo",
    ]
    environ = {"PATH": str(places[0].parent), "ROADGEO_EXECUTABLE": str(places[2])}
    (beside / runner.REMEMBERED).write_text(f"{places[1]}\n", "utf-8")
    assert runner.find_executable("", environ, beside) is None
    for place in places:  # each takes precedence over those before it
        make_program(place, "")
        assert runner.find_executable("", environ, beside) == str(place)
    assert runner.find_executable(str(places[0]), environ, beside) == str(places[0])
    assert runner.find_executable(str(tmp_path / "none"), environ, beside) is None


@pytest.mark.parametrize("folder", ["miniforge3/envs/maps", ".local", ".venv", "pipx/venvs/roadgeo"])
def test_what_lies_in_the_home_folder_is_proposed_and_not_started(folder: str, tmp_path: Path) -> None:
    assert not runner.find_below(tmp_path)
    program = make_program(tmp_path / folder / "bin" / "roadgeo", "")
    assert runner.find_below(tmp_path) == str(program)
    assert runner.find_executable("", {"PATH": "", "HOME": str(tmp_path)}, tmp_path) is None


@pytest.mark.parametrize("folder", ["archive/.venv", "evil-conda/envs/a", "my-forge/envs/a", "Downloads/a/.venv"])
def test_what_was_unpacked_in_the_home_folder_is_not_proposed(folder: str, tmp_path: Path) -> None:
    make_program(tmp_path / folder / "bin" / "roadgeo", "")
    assert not runner.find_below(tmp_path)


@pytest.mark.parametrize("path", ["", ".", "bin:", "{here}", "{here}/../{name}"])
def test_programs_of_the_current_folder_are_never_started(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody may have unpacked them there; Windows looks there first, and so does a PATH with an empty entry."""
    names = ("roadgeo", "python3", "python", "roadgeo.exe", "python.exe", "bin/roadgeo", "bin/python3")
    for name in names:
        make_program(tmp_path / name, "")
    monkeypatch.chdir(tmp_path)
    environ = {"PATH": path.format(here=tmp_path, name=tmp_path.name)}
    assert runner.find_executable("", environ, tmp_path / "plugin") is None
    assert runner.find_executable("roadgeo", environ, tmp_path / "plugin") is None
    assert not [found for found in runner.find_pythons(environ, tmp_path / "home") if str(tmp_path) in found]


def test_a_python_that_has_roadgeo_may_stand_for_its_program(tmp_path: Path) -> None:
    assert runner.as_command("/opt/bin/roadgeo") == ["/opt/bin/roadgeo"]
    for name in ("python", "python3", "python3.13", "Python.exe"):
        assert runner.as_command(f"/opt/{name}")[-2:] == ["-m", "roadgeo"]
    new, old = (make_program(tmp_path / name, "") for name in ("python3.12", "python3"))
    found = runner.find_pythons({"PATH": str(tmp_path)}, tmp_path)
    assert found[:2] == [str(new), str(old)]  # then the Python of QGIS


def test_messages_of_the_program_name_what_qgis_has() -> None:
    labels = {"--gsd": "Pixel size", "--osm": "Place"}
    text = "Give one source: --osm PLACE, or `roadgeo index --bbox`; `roadgeo simulate` and --gsd-like stay"
    shown = runner.in_words_of_qgis(text, labels)
    assert shown == "Give one source: “Place” PLACE, or “Build road reference”; `roadgeo simulate` and --gsd-like stay"
    advice = runner.in_words_of_qgis("5 % (--gsd SIZE+-5%), 200 m (--near LON,LAT,200)", {**labels, "--near": "Near"})
    assert advice == "5 % (“Pixel size” SIZE+-5%), 200 m (“Near”)"
    text = "this needs pymavlink, which is not installed: pip install 'roadgeo[mavlink]'"
    assert runner.in_words_of_qgis(text, {}).endswith("“Set up roadgeo” installs roadgeo[mavlink]")


# --- running it -------------------------------------------------------------------------------------------------------


def never() -> bool:
    return False


def test_the_child_inherits_nothing_of_the_libraries_of_qgis() -> None:
    environ = {"PYTHONHOME": "a", "PYTHONPATH": "b", "PROJ_LIB": "c", "PROJ_DATA": "d", "GDAL_DATA": "e", "PATH": "f"}
    assert set(runner.child_environment(environ)) & set(environ) == {"PATH"}


def test_the_child_runs_nothing_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither it nor the processes that it starts, which import what lies in their current folder first."""
    (tmp_path / "multiprocessing.py").write_text("print('stolen')", "utf-8")
    monkeypatch.chdir(tmp_path)
    worker = "import os, subprocess, sys; sys.exit(subprocess.call([sys.executable, '-c', 'import multiprocessing']))"
    heard: list[str] = []
    assert runner.run([sys.executable, "-c", worker], lambda _, line: heard.append(line), never) == 0
    assert heard == []


def test_lines_of_both_streams_arrive_and_the_status(tmp_path: Path) -> None:
    program = make_program(
        tmp_path / "roadgeo",
        "import sys\nprint('São João')\nprint('oops', file=sys.stderr)\nprint('x' * 300000)\nsys.exit(3)",
    )
    heard: list[tuple[str, str]] = []
    assert runner.run([str(program)], lambda *line: heard.append(line), never) == 3
    assert [line for stream, line in heard if stream == "stdout"] == ["São João", "x" * 300000]
    assert [line for stream, line in heard if stream == "stderr"] == ["oops"]


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    ("heeding", "status", "last"),
    [
        ("worker.kill(); worker.wait(); print('clean', flush=True); sys.exit(130)", 130, ["clean"]),
        ("sys.exit(130)", 130, []),  # in a hurry: what it started is left, with the pipes open
        ("time.sleep(600)", -9, []),
    ],
    ids=["cleans up", "leaves its worker behind", "stubborn"],
)
def test_cancelling_stops_the_child_and_its_own_children(
    heeding: str, status: int, last: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that heeds the interrupt may clean up; whatever it started and left, or all if it does not, is killed."""
    monkeypatch.setattr(runner, "_GRACE_S", 0.5)
    body = f"""
import subprocess, sys, time
worker = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
try:
    print(worker.pid, flush=True)
    time.sleep(600)
except KeyboardInterrupt:
    {heeding}
"""
    heard: list[str] = []
    started = time.monotonic()
    program = make_program(tmp_path / "roadgeo", body)
    ended = runner.run([str(program)], lambda _, line: heard.append(line), lambda: bool(heard))
    assert time.monotonic() - started < 10
    assert (ended, heard[1:]) == (status, last)
    assert not is_running(int(heard[0]))
