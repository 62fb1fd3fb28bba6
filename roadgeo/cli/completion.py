"""`roadgeo completion`: the shell completes commands and options."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from roadgeo.cli.options import Once
from roadgeo.cli.printing import echo

__all__ = ["completion_command"]


@click.command("completion", cls=Once, short_help="Complete commands and options in your shell.")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion_command(shell: str) -> None:
    """Print what makes a SHELL complete roadgeo's commands and options.

    \b
    Examples:
      roadgeo completion bash >> ~/.bashrc
      roadgeo completion zsh >> ~/.zshrc
      roadgeo completion fish > ~/.config/fish/completions/roadgeo.fish
    """
    from roadgeo.cli import cli

    kind = get_completion_class(shell)
    assert kind is not None  # noqa: S101 (the choices above are those that click knows)
    echo(kind(cli, {}, "roadgeo", "_ROADGEO_COMPLETE").source())
