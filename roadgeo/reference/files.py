"""A reference on disk: `REF.gpkg` for people and `REF.index` for the search, which are kept together."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import IndexFormatError, OutputError
from roadgeo.geometry.frame import polygon_area
from roadgeo.reference.index_file import (
    FORMAT_VERSION,
    read_format_version,
    read_index,
    read_manifest,
    remedy,
    write_index,
)
from roadgeo.reference.network_file import (
    network_digest,
    read_meta,
    read_network,
    stored_digest,
    write_network,
)
from roadgeo.roads.network import RoadNetwork
from roadgeo.storage.files import remove_leftovers, replacing

__all__ = [
    "Freshness",
    "IndexParts",
    "ReferencePaths",
    "identities",
    "open_reference",
    "rebuild_index",
    "reference_digest",
    "reference_freshness",
    "reference_paths",
    "write_reference",
]

#: Content of an index file: plain values, and arrays by name.
IndexParts: TypeAlias = tuple[Mapping[str, Any], Mapping[str, AnyArray]]

#: Numbers that distinguish each file of a reference from one that takes its place; None for a missing file.
Identities: TypeAlias = list[tuple[int, int] | None]

#: "no GeoPackage": an index alone, which serves as well. "old format": an index of an earlier roadgeo, and a GeoPackage
#: from which to build it again.
Freshness: TypeAlias = Literal["fresh", "stale", "no index", "old format", "no GeoPackage"]

#: Seconds after which a stale index is one: until then a writer may be about to replace it.
_PATIENCE_S = 0.5


class _StaleError(IndexFormatError):
    """The index was built from other intersections than the GeoPackage beside it has."""


@dataclass(frozen=True)
class ReferencePaths:
    """The two files of a reference."""

    geopackage: Path
    index: Path


def reference_paths(path: str | os.PathLike[str]) -> ReferencePaths:
    """Name the two files of a reference, given either of them or what they have in common."""
    given = Path(path)
    stem = given.with_suffix("") if given.suffix.lower() in {".gpkg", ".index"} else given
    return ReferencePaths(stem.with_name(f"{stem.name}.gpkg"), stem.with_name(f"{stem.name}.index"))


def write_reference(
    path: str | os.PathLike[str], network: RoadNetwork, parts: IndexParts, say: Say = say_nothing
) -> ReferencePaths:
    """Write both files of a reference; a previous one stays usable at every moment.

    Parameters
    ----------
    path : path
        Either file, or what they have in common.
    network : RoadNetwork
        As `roads.network.as_stored` gives it, so that the index is the one that the GeoPackage would give.
    parts : (meta, arrays)
        The index of that network.
    say : Say
        Called with the share of the GeoPackage that is written.

    Raises
    ------
    OutputError
        When the disk is full, the folder is missing or not writable.
    CrsError
        When the plane's CRS is unknown.
    """
    paths = reference_paths(path)
    meta, arrays = parts
    remove_leftovers(paths.index.parent)  # large ones: each time
    with replacing(paths.index) as index, replacing(paths.geopackage) as geopackage:  # left last first
        write_network(geopackage, network, say)
        write_index(index, meta, arrays, _about(network, meta))
        # Without its index a GeoPackage is still a whole reference, with the index of another one it is not.
        paths.index.unlink(missing_ok=True)
    return paths


def open_reference(
    path: str | os.PathLike[str], rebuild: Callable[[RoadNetwork], IndexParts] | None = None
) -> IndexParts:
    """Open a reference's index.

    Parameters
    ----------
    path : path
        Either file, or what they have in common.
    rebuild : callable, optional
        Builds the index of a network, where the file is missing or of an earlier format; the result is stored when the
        folder allows it.

    Returns
    -------
    meta, arrays
        Plain values, and read-only views of the memory-mapped file.

    Raises
    ------
    IndexFormatError
        When there is no such reference, or its index is missing (without `rebuild`), damaged, hostile or stale.
    """
    paths = reference_paths(path)
    failed, patience = None, time.monotonic() + _PATIENCE_S
    while True:
        before = identities(paths.geopackage)
        try:
            return _open(paths, rebuild)
        except IndexFormatError as error:
            # Another process may have replaced the reference meanwhile: half the old one was read, half the new.
            # Equal files before and after are no proof, for an index may have come and gone between; twice is.
            if identities(paths.geopackage) == before == failed:
                # But a third may have built the old index beside the new GeoPackage, which a busy writer will replace.
                if not isinstance(error, _StaleError) or time.monotonic() > patience:
                    raise
                time.sleep(0.02)
            failed = before


def _open(paths: ReferencePaths, rebuild: Callable[[RoadNetwork], IndexParts] | None) -> IndexParts:
    freshness = reference_freshness(paths.geopackage)
    if freshness == "stale":
        raise _StaleError(
            f"{paths.index} is stale: the intersections of {paths.geopackage.name} were changed after it was built; "
            + remedy(paths.index)
        )
    if freshness in {"no index", "old format"} and rebuild is not None:
        return _rebuild(paths, rebuild)
    return read_index(paths.index)


def rebuild_index(path: str | os.PathLike[str], build: Callable[[RoadNetwork], IndexParts]) -> None:
    """Build a reference's index again from its GeoPackage alone, whatever index there is.

    Raises
    ------
    IndexFormatError
        There is no such GeoPackage, it is damaged, or it is replaced meanwhile.
    OutputError
        The index cannot be written.
    """
    paths = reference_paths(path)
    network, before = _read(paths)
    _keep(paths, network, build(network), before)


def reference_freshness(path: str | os.PathLike[str]) -> Freshness:
    """Return whether the index belongs to the GeoPackage beside it.

    Raises
    ------
    IndexFormatError
        When neither file is there, or either is damaged.
    """
    paths = reference_paths(path)
    if not paths.index.is_file():
        if not paths.geopackage.is_file():
            raise IndexFormatError(f"no reference {path}: expected {paths.geopackage}; make it with `roadgeo index`")
        read_meta(paths.geopackage)
        return "no index"
    if paths.geopackage.is_file() and read_format_version(paths.index) < FORMAT_VERSION:
        return "old format"
    digest = read_manifest(paths.index)["about"].get("network")
    if not paths.geopackage.is_file():
        return "no GeoPackage"
    return "fresh" if digest == stored_digest(paths.geopackage) else "stale"


def reference_digest(path: str | os.PathLike[str]) -> str:
    """Return the digest of the intersections that an index was built from; "" where none of this format is there.

    Raises
    ------
    IndexFormatError
        The index is damaged.
    """
    index = reference_paths(path).index
    is_read = index.is_file() and read_format_version(index) == FORMAT_VERSION
    return str(read_manifest(index)["about"].get("network", "")) if is_read else ""


# --- building ---------------------------------------------------------------------------------------------------------


def _rebuild(paths: ReferencePaths, rebuild: Callable[[RoadNetwork], IndexParts]) -> IndexParts:
    """Build a missing index, and keep it where that is possible and nobody has written another meanwhile."""
    network, before = _read(paths)
    parts = rebuild(network)
    # A reference in a read-only folder serves as well; it only costs this time at every opening.
    with contextlib.suppress(OutputError, IndexFormatError):
        _keep(paths, network, parts, before, may_exist=False)
    return parts


def _read(paths: ReferencePaths) -> tuple[RoadNetwork, Identities]:
    """Return the network of a reference, and the identities of the files by which it is known."""
    before = identities(paths.geopackage)
    network = read_network(paths.geopackage)
    if identities(paths.geopackage) != before:
        raise IndexFormatError(f"{paths.geopackage} was replaced while it was read; try again")
    return network, before


def _keep(
    paths: ReferencePaths, network: RoadNetwork, parts: IndexParts, before: Identities, may_exist: bool = True
) -> None:
    """Write the index of a network, unless the reference is another by now."""
    meta, arrays = parts
    with replacing(paths.index, may_exist=may_exist) as staged:
        write_index(staged, meta, arrays, _about(network, meta))
        if identities(paths.geopackage) != before:
            raise IndexFormatError(f"{paths.geopackage} or its index was replaced meanwhile; try again")
        if not may_exist:
            paths.index.unlink(missing_ok=True)


def identities(path: str | os.PathLike[str]) -> Identities:
    """Return an identity of each file of a reference, which changes when it is replaced; None for a missing file."""
    paths = reference_paths(path)
    listed: Identities = []
    for path in (paths.geopackage, paths.index):
        try:
            status = path.stat()
            listed.append((status.st_ino, status.st_mtime_ns))
        except FileNotFoundError:
            listed.append(None)
    return listed


def _about(network: RoadNetwork, meta: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a network and its index for people, in plain values."""
    detected, graph = network.intersections, network.graph
    area_km2 = sum(map(polygon_area, network.coverage)) / 1e6
    low, high = (graph.coords.min(axis=0), graph.coords.max(axis=0)) if graph.n_edges else (np.zeros(2), np.zeros(2))
    return {
        "name": str(network.meta.get("name", "")),
        "network": network_digest(network),
        "crs": network.plane.crs,
        "extent": network.plane.to_crs(np.concatenate([[low], [high]])).ravel().tolist(),
        "counts": {"intersections": len(detected), "roads": graph.n_edges, "nodes": graph.n_nodes},
        "road_km": float(graph.edge_lengths().sum()) / 1e3,
        "area_km2": area_km2,
        "intersections_per_km2": len(detected) / area_km2 if area_km2 else None,
        "index": {key: value for key, value in meta.items() if key not in network.meta},
        "meta": network.meta,
    }
