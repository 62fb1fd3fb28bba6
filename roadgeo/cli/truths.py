"""`--truth` of `roadgeo locate --explain`: where masks really lie, for one or from a table."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import click

__all__ = ["read_truths"]


def read_truths(given: str | None, *, explain: bool) -> tuple[tuple[str, float, float], ...]:
    """Return name, longitude and latitude of every mask whose place was given; the name "" stands for any.

    Parameters
    ----------
    given : str or None
        LON,LAT, or a table as `roadgeo simulate` writes it.

    Raises
    ------
    click.UsageError
        It is neither, or nothing is to be explained.
    MaskError, RoadSourceError
        The table cannot be read.
    """
    if given is None:
        return ()
    if not explain:
        raise click.UsageError("--truth needs --explain: add it.")
    if _is_file(given):
        return _from_table(Path(given))
    try:
        lon, lat = (float(value) for value in given.split(","))
    except ValueError:
        lon = lat = float("nan")
    if not (abs(lon) <= 180.0 and abs(lat) <= 90.0):
        raise click.UsageError(f"--truth {given!r}: expected LON,LAT in degrees, or a table such as truth.csv.")
    return (("", lon, lat),)


def _is_file(given: str) -> bool:
    with suppress(OSError, ValueError):  # too long for a name, or none
        return Path(given).is_file()
    return False


def _from_table(path: Path) -> tuple[tuple[str, float, float], ...]:
    from roadgeo.evaluation.truth import read_truth
    from roadgeo.geometry.projection import to_lonlat

    truths = []
    for truth in read_truth(path):
        if truth.crs is None:
            raise click.UsageError(f"{path} has no CRS: add a column crs.")
        truths.append((truth.file, *to_lonlat(truth.crs, truth.center).tolist()))
    return tuple(truths)
