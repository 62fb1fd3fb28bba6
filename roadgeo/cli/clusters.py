"""`--engine` and `--scheduler`: tasks in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from roadgeo.running.cluster import Cluster

__all__ = ["cluster_options", "make_cluster"]

Command = TypeVar("Command", bound=Callable[..., Any])

_OPTIONS = [
    click.option(
        "--engine",
        type=click.Choice(["local", "dask"]),
        help="Where it is done: in --jobs processes here, the default, or on a Dask cluster of as many workers, which"
        " survives their death. Needs pip install 'roadgeo[dask]'.",
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Use the Dask cluster at this address, such as tcp://10.0.0.1:8786; its workers see the same files.",
    ),
]


def cluster_options(command: Command) -> Command:
    """Add the options that name a cluster."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def make_cluster(engine: str | None, scheduler: str | None, jobs: int) -> Cluster | None:
    """Return the cluster that was asked for, None for processes of this machine.

    Raises
    ------
    click.UsageError
        A scheduler and another engine.
    """
    if scheduler is None and engine != "dask":
        return None
    if engine == "local":
        raise click.UsageError("--scheduler goes with --engine dask.")
    from roadgeo.running.cluster import Cluster

    return Cluster(scheduler, jobs)
