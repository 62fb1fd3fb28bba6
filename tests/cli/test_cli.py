import subprocess
import sys

import click
import pytest
from cli.test_progress import Terminal

from roadgeo.cli import COMMANDS, LazyGroup, cli, main
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
    ("error", "status", "message"),
    [
        (RoadgeoError("no such\nthing"), 1, "Error: no such thing\n"),
        (KeyboardInterrupt(), 130, "Interrupted.\n"),
        (MemoryError(), 1, "Error: more memory is needed than there is"),
        (RuntimeError("std::bad_alloc"), 1, "Error: more memory is needed than there is"),
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
    if "fault of roadgeo" in message:
        monkeypatch.setenv("ROADGEO_TRACEBACK", "1")
        with pytest.raises(type(error)):
            main(["x"])


def test_a_reader_that_leaves_is_no_error_with_traceback() -> None:
    program = "import sys; from roadgeo.cli import main; sys.exit(main(['--help']))"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("ver", "verify"),
        ("locate --rep", "--report"),
        ("locate --also geoj", "geojson"),
        ("index --kinds dr", "drivable"),
    ],
)
def test_the_shell_completes_commands_options_and_their_values(
    typed: str, offered: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", "bash"]) == 0
    assert "_ROADGEO_COMPLETE=bash_complete" in capfd.readouterr().out
    monkeypatch.setenv("_ROADGEO_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", f"roadgeo {typed}")
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split())))
    with pytest.raises(SystemExit):
        main([])
    assert capfd.readouterr().out == f"plain,{offered}\n"


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
