"""What is typed becomes what is meant, or one line says what was expected."""

import inspect
import math
import re
from dataclasses import replace
from pathlib import Path

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.documents import commands

import roadgeo
from roadgeo.cli import COMMANDS, cli, main
from roadgeo.cli.options import Read
from roadgeo.matching.hints import HINTS, apply_hints, read_box, read_gsd, read_place, read_range
from roadgeo.matching.options import LocateOptions
from roadgeo.serving.requests import read_query_string

FOCAL, GSD = Read("focal", HINTS["focal"].read), Read("gsd", read_gsd)
BOX, NEAR, RANGE = Read("box", read_box), Read("near", read_place), Read("range", read_range)


TEXTS = st.text(max_size=40) | st.lists(st.floats().map(str) | st.integers().map(str), min_size=1, max_size=5).map(
    ",".join
)


@pytest.mark.parametrize(
    ("kind", "count"),
    [(BOX, 4), (NEAR, 3), (RANGE, 2), (GSD, 2), (FOCAL, 1)],
    ids=["box", "near", "range", "gsd", "focal"],
)
@given(text=TEXTS)
def test_any_text_is_finite_numbers_a_word_or_refused(kind: Read, count: int, text: str) -> None:
    try:
        found = kind.convert(text, None, None)
    except click.BadParameter:
        return
    if found != "exif":
        numbers = found if count > 1 else (found,)
        assert len(numbers) == count
        assert all(map(math.isfinite, numbers))
        assert count > 1 or found > 0


@pytest.mark.parametrize(
    ("kind", "text", "read"),
    [
        (RANGE, "0.5:2", (0.5, 2.0)),
        (RANGE, "2:2", (2.0, 2.0)),
        (RANGE, "2", (2.0, 2.0)),
        (NEAR, "-71.1,42.3,5000", (-71.1, 42.3, 5000.0)),
        (BOX, "179,-19,-179,-16", (179.0, -19.0, -179.0, -16.0)),
        (FOCAL, "EXIF", "exif"),
        (FOCAL, "1200", 1200.0),
        *((RANGE, text, "expected") for text in ("2:1", "0:1", "a:b", "1:nan")),
        *((NEAR, text, "expected") for text in ("42.3,-171.1,10", "1,1,0", "1,1")),
        *((BOX, text, "expected") for text in ("1,2,3,2", "1,2,1,4", "1,2,190,4")),
        (NEAR, "42.36,-171.06,5000", "longitude comes first: did you mean -171.06,42.36,5000"),
        (BOX, "42.23,-171.19,42.44,-170.95", "longitude comes first: did you mean -171.19,42.23,-170.95,42.44"),
    ],
)
def test_numbers_are_read_or_what_was_expected_is_said(kind: Read, text: str, read: object) -> None:
    if isinstance(read, str) and read != "exif":
        with pytest.raises(click.BadParameter, match=read):
            kind.convert(text, None, None)
    else:
        assert kind.convert(text, None, None) == read
        assert kind.convert(read, None, None) == read


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


def test_other_keywords_are_refused_as_python_does() -> None:
    for call, other in ((roadgeo.locate, "wide"), (roadgeo.track, "heading")):
        with pytest.raises(TypeError, match=f"unexpected keyword argument '{other}'"):
            call("photo.png", **{other: 1.0})


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


def test_the_help_of_an_option_is_written_once() -> None:
    """In the field that it is; other commands, QGIS, HTTP and Python take it from there."""
    files = Path(roadgeo.__file__).parent.rglob("*.py")
    text = "".join(re.sub(r'"\s+"', "", file.read_text("utf-8")) for file in files)
    said = {param.opts[0]: str(param.help) for param in command("locate").params if isinstance(param, click.Option)}
    counts = {name: text.count(re.split(r"(?<=[^.]\.) ", help_)[0]) for name, help_ in said.items()}
    assert {name: count for name, count in counts.items() if count != 1} == {}


def test_options_of_plugins_dialogs_exist_on_the_command_line() -> None:
    """QGIS says what was set by options: each has to exist, with the words among which one chooses."""
    plugin = Path(roadgeo.__file__).parent / "qgis" / "plugin"
    known = {name for item in COMMANDS for parameter in command(item).params for name in parameter.opts}
    said = {flag for file in plugin.glob("*.py") for flag in re.findall(r'"f?(--[a-z-]+)', file.read_text("utf-8"))}
    assert said
    assert said <= known | {"--help", "--version"} | {"--progress-bar", "--disable-pip-version-check"}  # of pip


@pytest.mark.parametrize("name", [name for name, _ in commands() if name])
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


@pytest.mark.parametrize(
    ("typed", "refused"),
    [
        ("locate a.png --gsd 0.3 --gsd 0.5", "--gsd is given 2 times: give it once."),
        ("locate a.png -j 2 --jobs 2", "--jobs is given 2 times: give it once."),
        ("locate a.png --mirror --no-mirror", "--mirror is given 2 times: give it once."),
        ("demo -o a --out-dir b", "--out-dir is given 2 times: give it once."),
        ("simulate porto -o a -o b", "--out-dir is given 2 times: give it once."),
    ],
)
def test_an_option_that_counts_once_is_given_once(typed: str, refused: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(typed.split()) == 2
    assert refused in capsys.readouterr().err


def test_what_may_be_given_more_often_may() -> None:
    typed = [
        "a.png",
        "b.png",
        "-r",
        "x",
        "-r",
        "y",
        "--also",
        "kmz",
        "--also",
        "gcps",
        "-v",
        "-v",
        "--report",
        "--report",
    ]
    given = command("locate").make_context("locate", typed).params
    assert (given["references"], given["products"]) == (("x", "y"), ("kmz", "gcps"))


@pytest.mark.parametrize(("name", "option"), [("overlay", "--plot"), ("report", "--report")])
def test_outputs_that_have_an_option_name_it(capsys: pytest.CaptureFixture[str], name: str, option: str) -> None:
    assert main(["locate", "a.png", "--also", name]) == 2
    assert f"it has an option of its own: {option}" in capsys.readouterr().err
