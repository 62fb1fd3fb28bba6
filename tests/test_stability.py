"""What earlier versions promised is still there (see `support.public`)."""

import json

import pytest
from support.public import PROMISED, offered

KEPT = json.loads(PROMISED.read_text(encoding="utf-8"))
NOW = offered()


@pytest.mark.parametrize(("part", "name"), [(part, name) for part, names in KEPT.items() for name in names])
def test_what_was_promised_is_there(part: str, name: str) -> None:
    """A parameter or a key may be added; one that is meant to go is first deprecated, and goes with a major version."""
    assert not set(KEPT[part][name]) - set(NOW[part][name])


def test_no_parameter_is_asked_for_that_was_not() -> None:
    for name, kept in KEPT["roadgeo"].items():
        asked = [item for item in NOW["roadgeo"][name] if item.endswith("!")]
        assert set(asked) <= set(kept)


def test_parameters_stay_in_order() -> None:
    for name in ("build_reference", "locate", "explain", "open_reference", "read_schema"):
        kept, now = KEPT["roadgeo"][name], NOW["roadgeo"][name]
        assert [item for item in now if item in kept] == kept
