"""`roadgeo completion`: the shell completes commands and options."""

from __future__ import annotations

from dataclasses import dataclass

import click
from click.shell_completion import get_completion_class

from roadgeo.cli.options import Once, argument, command
from roadgeo.cli.printing import echo

__all__ = ["completion_command"]


@dataclass(frozen=True, kw_only=True)
class Completion:
    """The parameters of `roadgeo completion`."""

    shell: str = argument("SHELL", type=click.Choice(["bash", "zsh", "fish"]), metavar=None)


@command("completion", Completion, Once)
def completion_command(asked: Completion) -> None:
    """Print what makes a SHELL complete roadgeo's commands and options.

    \b
    Examples:
      roadgeo completion bash >> ~/.bashrc
      roadgeo completion zsh >> ~/.zshrc
      roadgeo completion fish > ~/.config/fish/completions/roadgeo.fish
    """
    from roadgeo.cli import cli

    kind = get_completion_class(asked.shell)
    assert kind is not None  # noqa: S101 (the choices above are those that click knows)
    echo(kind(cli, {}, "roadgeo", "_ROADGEO_COMPLETE").source())
