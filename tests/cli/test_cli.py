import subprocess
import sys

import click
import pytest
from cli.test_progress import Terminal

from roadgeo.cli import COMMANDS, LazyGroup, cli, main
from roadgeo.cli.options import ASPECT, BOX, NEAR, RANGE, Read
from roadgeo.errors import RoadgeoError
from roadgeo.matching.hints import HINTS

FOCAL = Read("focal", HINTS["focal"].read)


def test_help_imports_click_and_nothing_heavy() -> None:
    program = "import sys; from roadgeo.cli import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "locate" in done.stdout
    heavy = {"numpy", "cv2", "numba", "rasterio", "pyproj", "rich", "scipy", "pandas", "geopandas", "osmnx"}
    assert not heavy & set(done.stderr.split())


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_the_name_of_the_table_and_examples(name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert command.name == name
    assert f"roadgeo {name}" in (command.help or "")


@pytest.mark.parametrize("group", [(), ("reference",), ("qgis",)])
def test_no_command_shows_help(group: tuple[str, ...], capfd: pytest.CaptureFixture[str]) -> None:
    assert main(group) == 2
    out, err = capfd.readouterr()
    assert out.startswith(" ".join(("Usage: roadgeo", *group)))
    assert "\nCommands:\n" in out
    assert err == ""


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (RoadgeoError("no such\nthing"), 1, "Error: no such thing\n"),
        (KeyboardInterrupt(), 130, "Interrupted.\n"),
        (ZeroDivisionError("x"), 1, "Error: ZeroDivisionError: x. This is a fault of roadgeo; "),
    ],
)
def test_errors_are_one_line(
    error: BaseException, status: int, message: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(LazyGroup, "get_command", lambda *_: click.Command("x", callback=fail))
    assert main(["x"]) == status
    out, err = capfd.readouterr()
    assert out == ""
    assert err.lstrip("\n").startswith(message)  # click ends the line that shows ^C
    assert err.strip().count("\n") == 0


def test_a_traceback_is_there_for_those_who_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    monkeypatch.setenv("ROADGEO_TRACEBACK", "1")
    monkeypatch.setattr(LazyGroup, "get_command", lambda *_: click.Command("x", callback=fail))
    with pytest.raises(ZeroDivisionError):
        main(["x"])


def test_a_reader_that_leaves_is_no_error_with_traceback() -> None:
    program = "import sys; from roadgeo.cli import main; sys.exit(main(['--help']))"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


@pytest.mark.parametrize(
    ("kind", "text", "numbers"),
    [
        (RANGE, "0.5:2", (0.5, 2.0)),
        (RANGE, "2:2", (2.0, 2.0)),
        (RANGE, "2", (2.0, 2.0)),
        (NEAR, "-71.1,42.3,5000", (-71.1, 42.3, 5000.0)),
        (BOX, "179,-19,-179,-16", (179.0, -19.0, -179.0, -16.0)),
        (FOCAL, "EXIF", "exif"),
        (FOCAL, "1200", 1200.0),
        (ASPECT, "unknown", "unknown"),
        (ASPECT, "0.25", 0.25),
        (ASPECT, "4", 4.0),
    ],
)
def test_numbers_are_read(kind: Read, text: str, numbers: object) -> None:
    assert kind.convert(text, None, None) == numbers
    assert kind.convert(numbers, None, None) == numbers


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (RANGE, "2:1"),
        (RANGE, "0:1"),
        (RANGE, "a:b"),
        (RANGE, "1:nan"),
        (NEAR, "42.3,-171.1,10"),
        (NEAR, "1,1,0"),
        (NEAR, "1,1"),
        (BOX, "1,2,3,2"),
        (BOX, "1,2,1,4"),
        (BOX, "1,2,190,4"),
        *((ASPECT, text) for text in ("0.2", "4.1", "nan", "wide", "")),
    ],
)
def test_numbers_that_make_no_sense_are_refused(kind: Read, text: str) -> None:
    with pytest.raises(click.BadParameter, match="expected"):
        kind.convert(text, None, None)


def test_the_shell_completes_commands(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    assert "_ROADGEO_COMPLETE=bash_complete" in capfd.readouterr().out
    environment = {"_ROADGEO_COMPLETE": "bash_complete", "COMP_WORDS": "roadgeo locate --gc", "COMP_CWORD": "2"}
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main([])
    assert capfd.readouterr().out == "plain,--gcps\n"


@pytest.mark.parametrize("no_color", ["", "1"])
def test_colours_appear_on_terminals_that_want_them(no_color: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", no_color)
    terminal = Terminal(sys.executable, "-m", "roadgeo", "reference", "info", "nonesuch")
    assert terminal.end() == 1
    error = "Error:" if no_color else "\x1b[31mError:\x1b[0m"
    assert terminal.text.startswith(f"{error} no reference 'nonesuch'")
    assert not no_color or "\x1b" not in terminal.text


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("locat a.png", "No such command 'locat'. Did you mean locate? Try 'roadgeo --help'.\n"),
        ("vectorise a.png", "No such command 'vectorise'. Did you mean vectorize? Try 'roadgeo --help'.\n"),
        ("nonesuch", "No such command 'nonesuch'. Try 'roadgeo --help'.\n"),
        ("reference info", "Missing argument 'REF'. Try 'roadgeo reference info --help'.\n"),
    ],
)
def test_a_mistyped_command_is_asked_about(typed: str, message: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(typed.split()) == 2
    assert capfd.readouterr() == ("", f"Error: {message}")


@pytest.mark.parametrize(
    ("kind", "text", "meant"),
    [
        (NEAR, "42.36,-171.06,5000", "-171.06,42.36,5000"),
        (BOX, "42.23,-171.19,42.44,-170.95", "-171.19,42.23,-170.95,42.44"),
    ],
)
def test_exchanged_degrees_are_asked_about(kind: Read, text: str, meant: str) -> None:
    with pytest.raises(click.BadParameter, match=f"longitude comes first: did you mean {meant}"):
        kind.convert(text, None, None)
