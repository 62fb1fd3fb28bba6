"""`roadgeo index --shards`: a map of any size, piece by piece."""

from __future__ import annotations

import re
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click

from roadgeo.cli.options import make_cluster
from roadgeo.cli.printing import tell

if TYPE_CHECKING:
    from roadgeo.cli.index import Index

__all__ = ["build_in_shards", "read_shards", "tell_built"]


def read_shards(text: str) -> dict[str, Any]:
    """Read how a map is cut, as options of the build: "auto", about how many shards, or the side of square ones."""
    if text == "auto":
        return {}
    if text.isdecimal() and int(text) > 0:
        return {"count": int(text)}
    size = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?km", text)
    if size and 1 <= float(size[1]) <= 1000:
        return {"size_m": 1000.0 * float(size[1])}
    raise ValueError(f"got {text!r}, expected auto, a number, or a side such as 25km (1 to 1000)")


def build_in_shards(asked: Index, name: str) -> None:
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

    out = asked.out
    if not asked.roads:
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
    which = (asked.layer, asked.crs, asked.kinds, asked.tunnels, asked.bbox, asked.attribution)
    files = RoadFiles(tuple(map(Path, asked.roads)), *which)
    compile_once(map_only=True)
    with show_steps() as say:
        options = ShardOptions(**asked.shards or {}, margin_m=asked.margin)
        cluster = make_cluster(asked.engine, asked.scheduler, asked.jobs)
        reference = build_shards(files, path, make_slug(name), options, jobs=asked.jobs, cluster=cluster, say=say)
    entries = reference.manifest.filled
    n = sum(entry.own_intersections for entry in entries)
    tell_built(f"{path}: {n:,} intersections in {len(entries)} shards", started, out or path.stem)


def tell_built(built: str, started: float, reference: str) -> None:
    """Print what was built, since a moment of `perf_counter`, and how it is searched."""
    seconds = perf_counter() - started
    tell(f"{built} in {seconds:.1f} s; search it with `roadgeo locate photo.jpg -r {reference}`")
