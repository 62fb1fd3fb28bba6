"""`roadgeo index --shards`: a map of any size, piece by piece."""

from __future__ import annotations

import re
from pathlib import Path
from time import perf_counter
from typing import Any

import click

from roadgeo.cli.options import each, make_cluster, row
from roadgeo.cli.printing import echo

__all__ = ["build_in_shards", "shard_options"]


class _Shards(click.ParamType):  # type: ignore[type-arg]  # generic only in late versions of click
    """How a map is cut: "auto", about how many shards, or the side of square ones: "25km"."""

    name = "shards"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> dict[str, Any]:
        """Return the options of the build, by their names.

        Raises
        ------
        click.BadParameter
            It is something else.
        """
        if isinstance(value, dict):
            return value
        size = re.fullmatch(r"([0-9.]+) ?km", value)
        if value == "auto":
            return {}
        if value.isdecimal() and int(value) > 0:
            return {"count": int(value)}
        if size and size[1].count(".") < 2 and size[1] != "." and 1 <= float(size[1]) <= 1000:
            return {"size_m": 1000.0 * float(size[1])}
        return self.fail(f"got {value!r}, expected auto, a number, or a side such as 25km (1 to 1000)", param, ctx)


#: Adds the options that control how a map is cut.
shard_options = each((
    row("--shards", "auto|N|SIZEkm", "In pieces",
        "Build REF.shards, in pieces. As many as is good, about N, or squares of a side: for maps of any size.",
        type=_Shards()),
    row("--margin", "METRES", "In pieces",
        "Ground that neighbours share. Half the diagonal of the largest frame to locate.",
        type=click.FloatRange(0, 100_000), default=3000.0, show_default=True, rare=True),
    row("-j --jobs", "N", "In pieces",
        "Processes, each of which builds a piece at a time.", type=click.IntRange(1), default=1, show_default=True),
))  # fmt: skip


def build_in_shards(source: dict[str, Any], name: str, out: str | None, shards: dict[str, Any], quiet: bool) -> None:
    """Build a reference in shards from road files, and describe the result.

    Raises
    ------
    click.UsageError
        The roads do not come from files, or `--out` names something else.
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.cli.progress import show_steps
    from roadgeo.reference.library import make_slug, new_reference
    from roadgeo.reference.shards import ENDING
    from roadgeo.running.sharding import RoadFiles, ShardOptions, build_shards
    from roadgeo.storage.files import make_folder

    if not source["roads"]:
        raise click.UsageError("--shards goes with --roads: what is fetched from OpenStreetMap fits in one piece.")
    # Target: a folder, in the library unless `--out` names another.
    started = perf_counter()
    path = Path(out) if out else new_reference(name).with_suffix(ENDING)
    if path.suffix != ENDING:
        if path.suffix in {".gpkg", ".index"}:
            raise click.UsageError(f"--out {out}: with --shards that is a folder; did you mean {path.stem}{ENDING}?")
        path = path.with_name(f"{path.name}{ENDING}")
    make_folder(path)
    # Sources and options.
    which = (source[name] for name in ("layer", "crs", "kinds", "tunnels", "bbox", "attribution"))
    files = RoadFiles(tuple(map(Path, source["roads"])), *which)
    compile_once(quiet, map_only=True)
    with show_steps(quiet) as say:
        options, jobs = ShardOptions(**shards, margin_m=source["margin"]), source["jobs"]
        cluster = make_cluster(source, jobs)
        reference = build_shards(files, path, make_slug(name), options, jobs=jobs, cluster=cluster, say=say)
    if not quiet:
        entries = reference.manifest.filled
        n = sum(entry.own_intersections for entry in entries)
        found = f"{path}: {n:,} intersections in {len(entries)} shards in {perf_counter() - started:.1f} s"
        echo(f"{found}; search it with `roadgeo locate photo.jpg -r {out or path.stem}`")
