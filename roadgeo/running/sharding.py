"""Building a reference in shards: roads are streamed once onto disk, and each shard is built from the roads near it.

Memory is bounded by the need of one shard: about 12 kB for each of its intersections, margins included. A build that is
killed goes on where it stopped, and one that is done is not done again, as long as its sources and options are the
same.
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._progress import Say, say_nothing
from roadgeo.errors import RoadgeoError, RoadSourceError
from roadgeo.geometry.projection import transform
from roadgeo.matching.index import build_index
from roadgeo.reference.index_file import FORMAT_VERSION
from roadgeo.reference.reference import COARSE, BuildOptions, Reference
from roadgeo.reference.shard_plan import ShardBox, bounds_in_degrees, plan_shards, widen
from roadgeo.reference.shards import (
    Manifest,
    ShardedReference,
    ShardEntry,
    manifest_path,
    open_shards,
    write_manifest,
)
from roadgeo.reference.spool import Bounds, Spool
from roadgeo.roads.kinds import MAIN_CLASSES, RoadKind, main_ranks
from roadgeo.roads.network import build_network
from roadgeo.running.pool import Lost
from roadgeo.running.processes import run
from roadgeo.sources.lines import RoadLines, add_counts
from roadgeo.sources.overpass import box_area
from roadgeo.sources.roads import Box, choose_lines, join_roads, with_crs
from roadgeo.sources.streams import list_sources, stream_lines, tell_source
from roadgeo.storage.crs import known_crs
from roadgeo.storage.files import write_bytes, writing

if TYPE_CHECKING:
    from roadgeo.running.cluster import Cluster

__all__ = ["RoadFiles", "ShardOptions", "build_shards"]

#: A shard of this many straight pieces of road has 30,000 to 80,000 intersections, and takes 0.4 to 1 GB to build.
_SEGMENTS = 200_000

#: Vertices of main roads that are drawn in one piece, as the coarse map, in up to 3 GB. Beyond them only the greater
#: kinds are drawn.
_MOST_MAIN = 3_000_000
_COARSE = "coarse"

#: A plane around the middle of ground so wide is too large by 7 % at its rim.
_WIDEST_DEG = 60.0

#: Lines are put on disk by cells of this size.
_CELL_M = 5000.0
_DEGREE_M = 111_320.0


@dataclass(frozen=True)
class RoadFiles:
    """Road files, and which of their roads are taken (see `sources.roads.read_roads`)."""

    paths: tuple[Path, ...]
    layer: str | Sequence[str] | None = None
    crs: str | None = None
    which: RoadKind = "drivable"
    tunnels: bool = False
    bbox: Box | None = None
    attribution: str | None = None

    @cached_property
    def files(self) -> list[Path]:
        """The files; a folder stands for those in it."""
        return [file for path in self.paths for file in list_sources(path)]


@dataclass(frozen=True)
class ShardOptions:
    """How a map is cut.

    Attributes
    ----------
    count : int or None
        Approximate number of shards; None: as many as keep each at a size that is quick to build.
    size_m : float or None
        Side of square shards instead.
    margin_m : float
        Ground around each shard that its neighbours have, too: half the diagonal of the largest frame that is to be
        located as well as on one piece.
    """

    count: int | None = None
    size_m: float | None = None
    margin_m: float = 3000.0
    build: BuildOptions = field(default_factory=BuildOptions)


def build_shards(
    roads: RoadFiles,
    folder: Path,
    name: str,
    options: ShardOptions | None = None,
    *,
    jobs: int = 1,
    cluster: Cluster | None = None,
    say: Say = say_nothing,
) -> ShardedReference:
    """Build a reference in shards, or go on with a build that was cut short.

    Parameters
    ----------
    folder : Path
        Where its manifest goes; made if it is missing. A reference that is there is replaced in the end.
    jobs : int
        Processes; each builds a shard at a time.
    cluster : Cluster, optional
        Builds them instead, one at a time on each of its workers, which see the same files.

    Raises
    ------
    RoadSourceError, CrsError
        A source is missing, unreadable or without CRS; there are no roads; a shard could not be built.
    OutputError
        A file cannot be written.
    """
    options = options or ShardOptions()
    build = _fingerprint(roads, name, options)
    done = manifest_path(folder)
    if done is not None:
        with contextlib.suppress(RoadgeoError):
            there = open_shards(done)
            if there.manifest.build == build and there.manifest.coarse is not None:
                return there
    work = folder / f".{build}"
    with writing(work):
        work.mkdir(parents=True, exist_ok=True)
        (folder / build).mkdir(exist_ok=True)
    spooled = _spool(roads, work, options, say)
    boxes = _plan(spooled, options)
    shards = ShardWork(str(work), str(folder / build), {**spooled.meta, "name": name, "shard_of": build}, options)
    tasks = [_coarse_box(boxes), *boxes]  # it takes longest
    entries = []
    for n, entry in enumerate(run(tasks, shards, jobs) if cluster is None else cluster.run(tasks, shards), 1):
        if isinstance(entry, str):
            raise RoadSourceError(f"{folder}: {entry}; the same command goes on with what is missing")
        entries.append(entry)
        say(f"building {len(boxes)} shards", n / len(tasks))
    coarse, *entries = entries
    if not any(entry.crs for entry in entries):
        raise RoadSourceError(f"{folder}: no shard has three intersections; take a larger area or other --kinds")
    manifest = Manifest(name, build, spooled.crs, options.margin_m, shards.meta, tuple(entries), coarse=coarse)
    path = write_manifest(folder, manifest)
    _tidy(folder, build)
    return open_shards(path)


def _fingerprint(roads: RoadFiles, name: str, options: ShardOptions) -> str:
    """Return a digest of sources and options: equal for the same question."""
    files = [(str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns) for file in roads.files]
    asked = [files, asdict(replace(roads, paths=())), asdict(options), name, FORMAT_VERSION]
    return blake2b(json.dumps(asked).encode(), digest_size=8).hexdigest()


def _tidy(folder: Path, build: str) -> None:
    """Remove what is no longer needed: lines on disk, and the shards of earlier builds."""
    for other in folder.iterdir():
        if other.is_dir() and other.name != build:
            shutil.rmtree(other, ignore_errors=True)


# --- lines onto disk --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Spooled:
    """Lines on disk: their CRS, the size of the cells, the straight pieces in each, and where they came from."""

    crs: str
    size: float
    n_segments: dict[tuple[int, int], int]
    meta: dict[str, Any]


def _spool(roads: RoadFiles, work: Path, options: ShardOptions, say: Say) -> _Spooled:
    """Stream the lines of all sources onto disk, unless that is done already."""
    path = work / "lines.json"
    if path.is_file():
        stored = json.loads(path.read_text(encoding="utf-8"))
        counts = {(x, y): n for x, y, n in stored.pop("n_segments")}
        return _Spooled(**stored, n_segments=counts)
    spooled = _stream(roads, work / "lines", options, None, say)
    if spooled is None:  # sources of different CRS
        spooled = _stream(roads, work / "lines", options, "EPSG:4326", say)
    if spooled is None or not spooled.n_segments:
        raise RoadSourceError(f"{', '.join(map(str, roads.paths))}: no roads of the kind asked for; try other --kinds")
    rows = [[x, y, n] for (x, y), n in spooled.n_segments.items()]
    write_bytes(path, json.dumps({**spooled.__dict__, "n_segments": rows}).encode())
    return spooled


def _stream(roads: RoadFiles, folder: Path, options: ShardOptions, crs: str | None, say: Say) -> _Spooled | None:
    """Put the lines on disk in a CRS, or in that which all sources have; None if they have different ones."""
    with writing(folder):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    spool, sources = None, []
    area = None if roads.bbox is None else box_area(roads.bbox)
    for file in roads.files:
        counts: dict[str, Any] = {}
        what = f"reading {file.name}"
        say(what)
        for part in stream_lines(file, roads.layer, advance=partial(say, what), whole=roads.which == "all"):
            chosen = choose_lines(with_crs(part, roads.crs, file), file.name, roads.which, roads.tunnels, area)
            add_counts(counts, chosen.meta)
            crs = crs or chosen.crs
            if spool is None:
                spool = Spool(folder, (options.size_m or _CELL_M) / (_metres(str(crs)) or _DEGREE_M))
            if chosen.crs != crs and crs != "EPSG:4326":
                return None
            with writing(folder):
                spool.add(_to(chosen, str(crs)), np.stack([chosen.name, chosen.highway], axis=1))
        tell_source(file.name, counts)
        sources.append(counts)
    calls = dict.fromkeys(source["attribution"] for source in sources if source.get("attribution"))
    meta = {
        "roads": roads.which,
        "tunnels": roads.tunnels,
        "bbox": None if roads.bbox is None else list(roads.bbox),
        "sources": sources,
        "attribution": "; ".join(calls) if roads.attribution is None else roads.attribution,
    }
    return None if spool is None else _Spooled(str(crs), spool.size, dict(spool.n_segments), meta)


def _to(lines: RoadLines, crs: str) -> Any:
    """Return lines in another CRS."""
    import shapely

    if lines.crs == crs:
        return lines.lines
    return shapely.transform(lines.lines, lambda xy: transform(str(lines.crs), crs, xy))


def _metres(crs: str) -> float | None:
    """Return the metres of a unit of a CRS; None for degrees."""
    resolved = known_crs(crs)
    return float(resolved.axis_info[0].unit_conversion_factor) if resolved.is_projected else None


def _coarse_box(boxes: Sequence[ShardBox]) -> ShardBox:
    """Return the box of the coarse map: all the ground."""
    low, high = (np.array([box.core[k : k + 2] for box in boxes]) for k in (0, 2))
    west, south, east, north = (float(side) for side in (*low.min(axis=0), *high.max(axis=0)))
    return ShardBox(_COARSE, (west, south, east, north))


def _main_roads(spool: Spool, ground: Bounds) -> tuple[Any, Any]:
    """Return main roads and their labels: the greatest kinds that are few enough to be drawn in one piece.

    No road is chosen where the ground (west, south, east, north, degrees) is so wide that no plane is true to scale.
    """
    import shapely

    west, south, east, north = ground
    nearest_equator = 0.0 if south * north < 0.0 else min(abs(south), abs(north))
    if max((east - west) * math.cos(math.radians(nearest_equator)), north - south) > _WIDEST_DEG:
        return spool.choose(lambda labels: np.zeros(len(labels), bool))
    lines, labels = spool.choose(lambda labels: main_ranks(labels[:, 1]) >= 0)
    ranks = main_ranks(labels[:, 1])
    sizes = np.bincount(ranks, shapely.get_num_coordinates(lines), len(MAIN_CLASSES))
    chosen = ranks < max(1, int((np.cumsum(sizes) <= _MOST_MAIN).sum()))
    return lines[chosen], labels[chosen]


def _plan(spooled: _Spooled, options: ShardOptions) -> list[ShardBox]:
    """Cut the ground into shards."""
    total = sum(spooled.n_segments.values())
    if options.size_m is not None:
        most = 0.0
    elif options.count is not None:
        most = math.ceil(total / options.count) * 1.2  # halves of halves are not quite even
    else:
        most = _SEGMENTS
    return plan_shards(spooled.n_segments, spooled.size, most)


# --- shards -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ShardWork:
    """Builds shards; travels to other processes (see `_processes.Work`)."""

    work: str
    folder: str
    meta: dict[str, Any]
    options: ShardOptions

    def prepare(self) -> Callable[[ShardBox], ShardEntry | str]:
        """Return the builder of one shard, unless the shard exists."""
        stored = json.loads((Path(self.work) / "lines.json").read_text(encoding="utf-8"))
        spool, crs = Spool(Path(self.work) / "lines", stored["size"]), str(stored["crs"])
        return lambda box: self._build(box, spool, crs)

    def give_up(self, task: ShardBox, lost: Lost) -> str:
        """Report that a shard could not be built."""
        return f"shard {task.name}: {lost.said}"

    def _build(self, box: ShardBox, spool: Spool, crs: str) -> ShardEntry:
        done = Path(self.folder) / f"{box.name}.json"
        if done.is_file():
            return ShardEntry.from_dict(json.loads(done.read_text(encoding="utf-8")))
        reach = widen(box.core, self.options.margin_m, _metres(crs))
        entry = ShardEntry(box.name, bounds_in_degrees(box.core, crs), bounds_in_degrees(reach, crs))
        lines, labels = spool.read(reach) if box.name != _COARSE else _main_roads(spool, entry.ground)
        if len(lines):
            names, kinds = labels.T
            held = RoadLines(lines, crs, kinds, names, np.zeros(len(lines), bool), True, {"name": box.name})
            entry = self._build_reference(entry, held, box)
        write_bytes(done, json.dumps(asdict(entry)).encode())  # last: the files that it lists exist
        return entry

    def _build_reference(self, entry: ShardEntry, lines: RoadLines, box: ShardBox) -> ShardEntry:
        """Build and write the reference of a shard; three intersections are needed."""
        from roadgeo.reference.files import reference_digest, reference_paths

        joined = join_roads([lines], {}, None)
        meta, options = {**self.meta, "plane": joined.meta["plane"], "shard": box.name}, self.options.build
        if box.name == _COARSE:
            del meta["shard_of"]  # a place on it lies not quite where it lies on a shard
            options = replace(options, simplify=COARSE.simplify)
        network = build_network(joined.lines, joined.plane, meta, options, names=joined.names, kinds=joined.kinds)
        if len(network.intersections) < 3:
            return entry
        index = build_index(network, self.options.build.index)
        path = Path(self.folder) / f"{box.name}.gpkg"
        Reference(index, network).save(path)
        there = transform(joined.plane.crs, str(lines.crs), joined.plane.to_crs(index.xy))
        x0, y0, x1, y1 = box.core
        own = ((there >= (x0, y0)) & (there < (x1, y1))).all(axis=1)
        files = reference_paths(path)
        return replace(
            entry,
            crs=joined.plane.crs,
            intersections=len(index),
            own_intersections=int(own.sum()),
            road_km=round(float(network.graph.edge_lengths().sum()) / 1e3, 3),
            bytes=files.geopackage.stat().st_size + files.index.stat().st_size,
            digest=reference_digest(path),
        )
