"""The command as typed: results name it, so that they can be made again."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Sequence
from typing import Any

import click

from roadgeo._version import __version__

__all__ = ["KEY", "made_by", "said_options"]

#: Under which the arguments are kept among what click's contexts share.
KEY = "roadgeo.arguments"


def made_by() -> dict[str, Any]:
    """Return the origin that every JSON names: the version, and the command that runs now.

    That is only the program's name where another program calls it.
    """
    context = click.get_current_context(silent=True)
    typed = [] if context is None else context.meta.get(KEY, [])
    return {"version": __version__, "command": shlex.join(["roadgeo", *typed])}


def said_options(left_out: Collection[str] = ()) -> list[str]:
    """Return the options of the command that runs now as they were typed, under their long names; no arguments.

    Parameters
    ----------
    left_out : collection of str
        Names of parameters that are of no account.
    """
    context = click.get_current_context(silent=True)
    if context is None:
        return []
    parser = context.command.make_parser(context)
    typed, _, _ = parser.parse_args(list(context.meta.get(KEY, [])[1:]))
    said = []
    for parameter in context.command.params:
        if isinstance(parameter, click.Option) and parameter.name in typed and parameter.name not in left_out:
            said += _say(parameter, typed[parameter.name])
    return said


def _say(option: click.Option, value: Any) -> list[str]:
    """Write one option with its value, or one for each of its values."""
    if option.is_flag:
        return [option.opts[-1] if value else option.secondary_opts[-1]]
    values: Sequence[str] = value if option.multiple else [value]
    return [f"{option.opts[-1]}={each}" for each in values]
