"""What is typed becomes what is meant, or one line says what was expected."""

import inspect
import math
import re
from dataclasses import replace
from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete
from hypothesis import given
from hypothesis import strategies as st

import roadgeo
from roadgeo.cli import COMMANDS, cli, main
from roadgeo.cli.options import ASPECT, BOX, GSD, NEAR, RANGE, Plugin, Read
from roadgeo.matching.hints import HINTS, apply_hints
from roadgeo.matching.options import LocateOptions
from roadgeo.serving.requests import read_query_string


def offered(*typed: str, incomplete: str) -> list[str]:
    """What a shell offers in place of the last word."""
    shell = ShellComplete(cli, {}, "roadgeo", "_ROADGEO_COMPLETE")
    return [item.value for item in shell.get_completions(list(typed), incomplete)]


FOCAL = Read("focal", HINTS["focal"].read)


def test_names_of_plugins_are_offered() -> None:
    plugin = Plugin(lambda: ["geojson", "geometry", "kmz"])
    assert [item.value for item in plugin.shell_complete(None, None, "geo")] == ["geojson", "geometry"]


def test_commands_are_offered() -> None:
    assert offered(incomplete="ver") == ["verify"]
    assert "vectorize" in offered(incomplete="ve")


TEXTS = st.text(max_size=40) | st.lists(st.floats().map(str) | st.integers().map(str), min_size=1, max_size=5).map(
    ",".join
)


@pytest.mark.parametrize(
    ("kind", "count"), [(BOX, 4), (NEAR, 3), (RANGE, 2), (GSD, 2)], ids=["box", "near", "range", "gsd"]
)
@given(text=TEXTS)
def test_any_text_is_finite_numbers_or_refused(kind: Read, count: int, text: str) -> None:
    try:
        found = kind.convert(text, None, None)
    except click.BadParameter:
        return
    assert len(found) == count
    assert all(map(math.isfinite, found))


@given(TEXTS)
def test_any_text_is_a_length_a_ratio_or_refused(text: str) -> None:
    for kind in (FOCAL, ASPECT):
        try:
            found = kind.convert(text, None, None)
        except click.BadParameter:
            continue
        assert found in ("exif", "unknown") or 0 < float(found) < math.inf


# --- one table --------------------------------------------------------------------------------------------------------


def command(name: str) -> click.Command:
    found = cli.get_command(click.Context(cli), name)
    assert found is not None
    return found


def shown(name: str, option: str = "--help") -> str:
    with click.Context(command(name), info_name=f"roadgeo {name}", terminal_width=80) as context:
        context.meta["roadgeo.help-all"] = option == "--help-all"
        return command(name).get_help(context)


def test_every_hint_is_an_option_of_locate_a_parameter_over_http_and_a_keyword_of_python() -> None:
    options = {name for param in command("locate").params for name in param.opts}
    assert {hint.option for hint in HINTS.values()} <= options
    keywords = inspect.signature(roadgeo.locate).parameters
    assert {name for name, keyword in keywords.items() if keyword.kind is keyword.KEYWORD_ONLY} - {"take"} == set(HINTS)
    assert all(f"  {hint.parameter}=" in shown("serve", "--help-all") for hint in HINTS.values())


def test_the_defaults_of_the_table_are_those_of_the_search() -> None:
    output = {hint.goes_to: hint.read(hint.default) for hint in HINTS.values() if hint.default != ""}
    usual = LocateOptions()
    assert set(output) == {"gsd_m", "max_tilt_deg", "effort", "time_limit_s"}
    known = apply_hints(usual, output)
    assert replace(known, pair=usual.pair) == usual


def test_one_pixel_size_is_one_fact_in_every_spelling() -> None:
    for item in ("0.3", 0.3):
        assert HINTS["gsd"].read(item) == pytest.approx((0.24, 0.375))
    assert GSD.convert("0.3+-10%", None, None) == pytest.approx((0.27, 0.33))
    assert read_query_string("gsd=0.3") == {"gsd_m": pytest.approx((0.24, 0.375))}
    for text in ("0.3:0.6", "0.3,0.6"):
        assert read_query_string(f"gsd={text}") == {"gsd_m": (0.3, 0.6)} == {"gsd_m": GSD.convert(text, None, None)}


def test_options_of_plugins_dialogs_exist_on_the_command_line() -> None:
    """QGIS says what was set by options: each has to exist, with the words among which one chooses."""
    plugin = Path(roadgeo.__file__).parent / "qgis" / "plugin"
    known = {name for item in COMMANDS for parameter in command(item).params for name in parameter.opts}
    said = {flag for file in plugin.glob("*.py") for flag in re.findall(r'"f?(--[a-z-]+)', file.read_text("utf-8"))}
    assert said
    assert said <= known | {"--help", "--version"} | {"--progress-bar", "--disable-pip-version-check"}  # of pip


EVERY = [*COMMANDS, *(f"{group} {name}" for group in ("reference", "qgis") for name in command(group).commands)]


@pytest.mark.parametrize("name", EVERY)
def test_help_fits_on_a_page_and_every_command_shows_all_of_it(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    lines = {}
    for option in ("--help", "--help-all"):
        assert main([*name.split(), option]) == 0
        lines[option] = capfd.readouterr().out.splitlines()
    assert len(lines["--help"]) <= 60
    assert len(lines["--help-all"]) >= len(lines["--help"])


def test_what_is_rarely_wanted_is_explained_by_all_of_the_help() -> None:
    assert "--divide-map" in shown("locate")  # its name
    assert "share of the map's shards" not in " ".join(shown("locate").split())
    whole = " ".join(shown("locate", "--help-all").split())
    assert "share of the map's shards" in whole
    assert "worldfile" in whole


@pytest.mark.parametrize("name", ["info", "check", "list", "remove"])
def test_earlier_names_are_the_same_commands(name: str) -> None:
    assert name not in COMMANDS
    assert command(name) is command("reference").commands[name]
