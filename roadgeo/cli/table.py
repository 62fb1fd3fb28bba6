"""The options of commands as plain data: QGIS makes its parameters of them, and its Python cannot import roadgeo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from roadgeo.cli import cli

if TYPE_CHECKING:
    from roadgeo.matching.hints import Hint

__all__ = ["describe_options"]


def describe_options(commands: Sequence[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the options of each command, by its name and theirs.

    Returns
    -------
    dict
        For each option: `help`; `schema`, the JSON Schema of a value; `default`, "" without one; whether it
        `is_hint` on the image, and then its `label`.
    """
    context = click.Context(cli)
    commands_by_name = {name: cli.get_command(context, name) for name in commands}
    return {
        name: {_name(param): _describe(param) for param in command.params if isinstance(param, click.Option)}
        for name, command in commands_by_name.items()
        if command is not None
    }


def _name(option: click.Option) -> str:
    return next(name for name in option.opts if name.startswith("--"))


def _describe(option: click.Option) -> dict[str, Any]:
    hint: Hint | None = getattr(option, "hint", None)
    if hint is not None:
        described = {"label": hint.label, "schema": dict(hint.schema), "default": hint.default}
    else:
        default = option.default if isinstance(option.default, str | int | float) and not option.is_flag else ""
        described = {"label": "", "schema": _schema(option), "default": default}
    return {**described, "help": option.help or "", "is_hint": hint is not None}


def _schema(option: click.Option) -> dict[str, Any]:
    """Return the JSON Schema of a value."""
    kind = option.type
    if option.is_flag:
        return {"type": "boolean"}
    if isinstance(kind, click.Choice):
        return {"enum": [*kind.choices]}
    if isinstance(kind, click.types.IntParamType | click.types.FloatParamType):
        name = "integer" if isinstance(kind, click.types.IntParamType) else "number"
        limits = {"minimum": getattr(kind, "min", None), "maximum": getattr(kind, "max", None)}
        return {"type": name, **{key: limit for key, limit in limits.items() if limit is not None}}
    return {"type": "string"}
