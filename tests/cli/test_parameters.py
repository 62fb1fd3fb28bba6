"""What is typed becomes what is meant, or one line says what was expected."""

import math

import click
import pytest
from click.shell_completion import ShellComplete
from hypothesis import given
from hypothesis import strategies as st

from roadgeo.cli import cli
from roadgeo.cli.parameters import ASPECT, BOX, CAMERA, NEAR, RANGE, Aspect, Focal, Numbers, Plugin


def offered(*typed: str, incomplete: str) -> list[str]:
    """What a shell offers in place of the last word."""
    shell = ShellComplete(cli, {}, "roadgeo", "_ROADGEO_COMPLETE")
    return [item.value for item in shell.get_completions(list(typed), incomplete)]


@pytest.mark.parametrize(("typed", "meant"), [("exif", "exif"), ("EXIF", "exif"), ("1200", 1200.0), (8.5, 8.5)])
def test_focal_lengths(typed: object, meant: object) -> None:
    assert Focal().convert(typed, None, None) == meant


@pytest.mark.parametrize(("typed", "meant"), [("unknown", "unknown"), ("0.25", 0.25), ("4", 4.0)])
def test_aspects(typed: str, meant: object) -> None:
    assert Aspect().convert(typed, None, None) == meant


@pytest.mark.parametrize("typed", ["0.2", "4.1", "nan", "wide", ""])
def test_what_is_no_aspect(typed: str) -> None:
    with pytest.raises(click.BadParameter, match=r"expected a number from 0\.25 to 4, or unknown"):
        Aspect().convert(typed, None, None)


def test_names_of_plugins_are_offered() -> None:
    plugin = Plugin("none", names=lambda: ["geojson", "geopose", "kmz"])
    assert [one.value for one in plugin.shell_complete(None, None, "geo")] == ["geojson", "geopose"]


def test_commands_are_offered() -> None:
    assert offered(incomplete="ver") == ["verify"]
    assert "vectorize" in offered(incomplete="ve")


TEXTS = st.text(max_size=40) | st.lists(st.floats().map(str) | st.integers().map(str), min_size=1, max_size=5).map(
    ",".join
)


@pytest.mark.parametrize("kind", [BOX, NEAR, RANGE], ids=lambda kind: kind.name)
@given(text=TEXTS)
def test_any_text_is_finite_numbers_or_refused(kind: Numbers, text: str) -> None:
    text = text.replace(",", kind.separator)
    try:
        found = kind.convert(text, None, None)
    except click.BadParameter:
        return
    assert len(found) == len(kind.names)
    assert all(map(math.isfinite, found))


@given(TEXTS)
def test_any_text_is_a_length_a_ratio_or_refused(text: str) -> None:
    for kind in (CAMERA, ASPECT):
        try:
            found = kind.convert(text, None, None)
        except click.BadParameter:
            continue
        assert found in ("exif", "unknown") or 0 < float(found) < math.inf
