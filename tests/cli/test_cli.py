import os
import subprocess
import sys

import click
import pytest

from roadgeo.cli import COMMANDS, LazyGroup, cli, main
from roadgeo.cli.options import BOX, NEAR, RANGE, Read
from roadgeo.errors import RoadgeoError


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
    ("arguments", "message"),
    [
        (["nonesuch"], "Error: No such command 'nonesuch'. Try 'roadgeo --help'.\n"),
        (["reference", "info"], "Error: Missing argument 'REF'. Try 'roadgeo reference info --help'.\n"),
    ],
)
def test_usage_is_one_line_and_status_2(arguments: list[str], message: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert capfd.readouterr() == ("", message)


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
    ],
)
def test_numbers_are_read(kind: Read, text: str, numbers: tuple[float, ...]) -> None:
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


def run_on_a_terminal(arguments: list[str], environment: dict[str, str]) -> str:
    """Run the command line with a pseudo-terminal as standard output and error."""
    pty = pytest.importorskip("pty")
    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "roadgeo", *arguments]
    with subprocess.Popen(command, stdout=follower, stderr=follower, env={**os.environ, **environment}) as process:
        os.close(follower)
        text = b""
        try:
            while part := os.read(leader, 4096):
                text += part
        except OSError:  # the other end is closed
            pass
        process.wait()
    os.close(leader)
    return text.decode()


def test_colours_appear_on_terminals_that_want_them() -> None:
    assert "\x1b[31mError:" in run_on_a_terminal(["reference", "info", "nonesuch"], {"NO_COLOR": ""})
    plain = run_on_a_terminal(["reference", "info", "nonesuch"], {"NO_COLOR": "1"})
    assert plain.startswith("Error: no reference 'nonesuch'")
    assert "\x1b" not in plain


@pytest.mark.parametrize(("typed", "meant"), [("locat", "locate"), ("vectorise", "vectorize"), ("indx", "index")])
def test_a_mistyped_command_is_asked_about(typed: str, meant: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main([typed, "a.png"]) == 2
    assert capfd.readouterr().err == f"Error: No such command '{typed}'. Did you mean {meant}? Try 'roadgeo --help'.\n"


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
