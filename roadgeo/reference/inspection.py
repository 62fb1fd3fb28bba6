"""A reference's contents, and whether it is sound: in one piece or in shards."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._version import __version__
from roadgeo.errors import CrsError, IndexFormatError, RoadSourceError
from roadgeo.matching.index import ReferenceIndex, build_index, check_table
from roadgeo.reference import files
from roadgeo.reference.files import reference_freshness, reference_paths
from roadgeo.reference.index_file import check_index, read_index, read_manifest, remedy
from roadgeo.reference.network_file import computed_digest, network_digest, read_meta, read_network, stored_digest
from roadgeo.reference.reference import stored_options
from roadgeo.reference.shards import ShardEntry, manifest_path, shard_path
from roadgeo.reference.shards import read_manifest as read_shards
from roadgeo.roads.network import RoadNetwork
from roadgeo.storage.crs import name_crs
from roadgeo.storage.geopackage import open_read_only, require_tables

__all__ = ["check_reference", "describe_reference"]


def describe_reference(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Describe a reference in plain values; nothing is unpickled, and no shard is opened.

    Returns
    -------
    dict
        `name`, `freshness`, `files` (sizes in bytes by path), `crs`, `counts`, `meta` (the network's own); with an
        index also its `format`, `roadgeo` (the version that built it), `memory_bytes` (of the mapped arrays), `extent`
        (min easting, min northing, max easting, max northing), `road_km`, `area_km2`, `intersections_per_km2`
        and `index` (its options and grid); with shards `extent_lonlat` and `shards`.

    Raises
    ------
    IndexFormatError
        There is no such reference, or its description is damaged.
    """
    shards = _shards(path)
    return _describe_whole(path) if shards is None else _describe_shards(shards)


def check_reference(path: str | os.PathLike[str]) -> list[str]:
    """Verify a reference thoroughly: that it can be searched, all digests, all ranges, and that its files agree.

    Returns
    -------
    list of str
        Problems, one sentence each; empty when the reference is sound.
    """
    try:
        shards = _shards(path)
        if shards is None:
            return list(_check_whole(path))
        return [problem for entry in read_shards(shards).files for problem in _check_shard(shards, entry)]
    except IndexFormatError as error:
        return [str(error)]


def _shards(path: str | os.PathLike[str]) -> Path | None:
    """Return the manifest of a reference in shards, None for a reference of one piece."""
    paths = reference_paths(path)
    return None if paths.geopackage.is_file() or paths.index.is_file() else manifest_path(path)


# --- describing -------------------------------------------------------------------------------------------------------


def _describe_whole(path: str | os.PathLike[str]) -> dict[str, Any]:
    paths, freshness = reference_paths(path), reference_freshness(path)
    description: dict[str, Any] = {
        "name": paths.geopackage.stem,
        "freshness": freshness,
        "files": {str(file): file.stat().st_size for file in (paths.geopackage, paths.index) if file.is_file()},
    }
    if freshness in {"no index", "old format"}:
        stored = read_meta(paths.geopackage)
        own = {key: value for key, value in stored.items() if not key.startswith("roadgeo.")}
        return description | {"crs": stored.get("roadgeo.crs"), "counts": _row_counts(paths.geopackage), "meta": own}
    manifest = read_manifest(paths.index)
    memory = sum(math.prod(entry["shape"]) * np.dtype(entry["dtype"]).itemsize for entry in manifest["arrays"])
    written = {"format": manifest["format"], "roadgeo": manifest["roadgeo"], "memory_bytes": memory}
    about = {key: value for key, value in manifest["about"].items() if key not in {"name", "network"}}
    return description | {"name": manifest["about"].get("name") or description["name"]} | written | about


def _row_counts(path: Path) -> dict[str, int]:
    layers = ("intersections", "roads")
    with open_read_only(path) as database:
        require_tables(database, path, *layers)
        # A sum goes through the rows, within the work that is allowed; count(*) follows a forged tree without end.
        sums = {layer: database.execute(f"SELECT sum(1) FROM {layer}").fetchone() for layer in layers}  # noqa: S608
    return {layer: int(n or 0) for layer, (n,) in sums.items()}


def _describe_shards(path: Path) -> dict[str, Any]:
    """Describe shards by their manifest."""
    manifest = read_shards(path)
    shards, filled = manifest.shards, manifest.filled
    are_there = all(reference_paths(shard_path(path, manifest, entry)).index.is_file() for entry in manifest.files)
    west, south, east, north = zip(*(entry.reach for entry in filled), strict=True)
    if any(entry.reach[0] > entry.reach[2] for entry in filled):  # astride 180 degrees
        west, east = (-180.0,), (180.0,)
    return {
        "name": manifest.name,
        "freshness": "fresh" if are_there else "shards missing",
        "files": {str(path.parent): path.stat().st_size + sum(entry.bytes for entry in manifest.files)},
        "crs": ", ".join(dict.fromkeys(entry.crs for entry in filled)),
        "counts": {"intersections": sum(entry.own_intersections for entry in filled)},
        "meta": manifest.meta,
        "roadgeo": manifest.roadgeo,
        "extent_lonlat": [min(west), min(south), max(east), max(north)],
        "shards": {
            "count": len(filled),
            "without_roads": len(shards) - len(filled),
            "margin_m": manifest.margin_m,
            "largest": max(entry.intersections for entry in filled),
            "with_margins": sum(entry.intersections for entry in filled),
            "coarse": 0 if manifest.coarse is None else manifest.coarse.intersections,
        },
    }


# --- checking ---------------------------------------------------------------------------------------------------------


def _check_shard(path: Path, entry: ShardEntry) -> Iterator[str]:
    """Check a shard, and that it is the one that its manifest names."""
    shard = shard_path(path, read_shards(path), entry)
    problems = list(_check_whole(shard))
    yield from problems
    if not problems and files.reference_digest(shard) != entry.digest:
        yield f"{shard}: is not the shard that the manifest names; build the reference again"


def _check_whole(path: str | os.PathLike[str]) -> Iterator[str]:
    """Check both files, and build the index that the GeoPackage gives, as `locate` would."""
    paths, has_index = reference_paths(path), reference_freshness(path) not in {"no index", "old format"}
    network = expected = None
    if paths.geopackage.is_file():
        try:
            yield from _check_geopackage(paths.geopackage)
            network = read_network(paths.geopackage)
            name_crs(network.plane.crs)
            expected = build_index(network, stored_options(network).index)
        except (IndexFormatError, RoadSourceError, CrsError) as error:
            yield _named(error, paths.geopackage)
    if has_index:
        problems = check_index(paths.index)
        yield from problems or _check_content(paths.index, network, expected)


def _check_geopackage(path: Path) -> Iterator[str]:
    with open_read_only(path) as database:
        notes = [note for (note,) in database.execute("PRAGMA integrity_check")]
        orphans = database.execute("PRAGMA foreign_key_check").fetchall()
    yield from (f"{path}: SQLite finds: {note}" for note in notes if note != "ok")
    if orphans:
        yield f"{path}: {len(orphans)} rows refer to tables or metadata that do not exist"
    if stored_digest(path) != computed_digest(path):
        yield f"{path}: its intersections differ from their stored digest"


def _check_content(path: Path, network: RoadNetwork | None, expected: ReferenceIndex | None) -> Iterator[str]:
    """Check that the search can use an undamaged index, and compare it with the one that its GeoPackage gives."""
    manifest = read_manifest(path)
    try:
        index = ReferenceIndex.from_parts(*read_index(path), path=str(path))
        check_table(index)
        name_crs(index.meta["crs"])
    except (IndexFormatError, CrsError) as error:
        yield _named(error, path)
        return
    if network is not None and manifest["about"].get("network") != network_digest(network):
        yield f"{path} is stale: it was built from other intersections; {remedy(path)}"
    elif expected is not None and manifest["roadgeo"] == __version__:  # another may well have built another index
        if index.meta.get("index_options") != expected.meta["index_options"]:
            yield f"{path}: its options differ from its GeoPackage's; {remedy(path)}"
            return
        arrays = expected.arrays()
        for name, array in index.arrays().items():
            if not np.array_equal(array, arrays[name], equal_nan=array.dtype.kind == "f"):
                yield f"{path}: its array {name!r} is not what the GeoPackage gives; {remedy(path)}"


def _named(error: Exception, path: Path) -> str:
    """Return an error that names its file."""
    return str(error) if str(path) in str(error) else f"{path}: {error}"
