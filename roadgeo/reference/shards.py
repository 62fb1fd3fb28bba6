"""A reference in shards: a folder with a manifest and, for each piece of the ground, an ordinary reference.

Layout of `NAME.shards`::

    manifest.json      what there is (schema "roadgeo.shards/1"); written last, so a folder with one is whole
    BUILD/SHARD.gpkg   and SHARD.index: an ordinary reference each, never changed once it is there
    BUILD/coarse.gpkg  and coarse.index: the main roads of all the ground in one piece, drawn as large pixels show them

Each shard has ground of its own and, around it, a margin that its neighbours have, too: a frame whose middle lies on
its own ground lies on it wholly, as long as half of the frame's diagonal is no longer than the margin. The
manifest describes a shard well enough to decide whether it must be opened.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._version import __version__
from roadgeo.errors import IndexFormatError
from roadgeo.geometry.areas import Box, overlap
from roadgeo.location import Location
from roadgeo.matching.index import COARSENESS, ReferenceIndex
from roadgeo.matching.parts import Near, touches
from roadgeo.reference.files import identities, reference_paths
from roadgeo.reference.network_file import stored_digest
from roadgeo.reference.remote import fetch_shard
from roadgeo.reference.spool import Bounds
from roadgeo.storage.files import write_text
from roadgeo.storage.memory import bounded

__all__ = [
    "ENDING",
    "Manifest",
    "Shard",
    "ShardEntry",
    "ShardedReference",
    "manifest_path",
    "open_shards",
    "read_manifest",
    "shard_path",
    "write_manifest",
]

SCHEMA = "roadgeo.shards/1"
ENDING = ".shards"

_MANIFEST = "manifest.json"

#: Names that a folder or a shard may have: none leads elsewhere.
_NAME = re.compile(r"[\w-]{1,80}")


@dataclass(frozen=True)
class ShardEntry:
    """A shard as its manifest describes it.

    Attributes
    ----------
    name : str
        Name of its files.
    ground, reach : (west, south, east, north)
        Degrees: the ground that is its own, and that with its margin.
    crs : str
        CRS of its plane; "" where it has too few intersections to be searched, and no files.
    intersections, own_intersections : int
        In all, and on its own ground.
    road_km : float
    bytes : int
        Bytes of both files.
    digest : str
        Digest of its intersections (see `network_file.network_digest`).
    """

    name: str
    ground: Bounds
    reach: Bounds
    crs: str = ""
    intersections: int = 0
    own_intersections: int = 0
    road_km: float = 0.0
    bytes: int = 0
    digest: str = ""

    @classmethod
    def from_dict(cls, values: Any) -> ShardEntry:
        """Read one out of JSON values, which may hold anything.

        Raises
        ------
        ValueError
            They are no entry.
        """
        if type(values) is not dict or values.keys() != cls.__dataclass_fields__.keys():
            raise ValueError("a shard lacks an entry")
        for bounds in (values["ground"], values["reach"]):
            if type(bounds) is not list or len(bounds) != 4 or not all(_is_number(side) for side in bounds):
                raise ValueError("a shard has no bounds")
        texts, numbers = ("name", "crs", "digest"), ("intersections", "own_intersections", "road_km", "bytes")
        if any(type(values[key]) is not str for key in texts) or not all(_is_number(values[key]) for key in numbers):
            raise ValueError("a shard's entry has the wrong type")
        if not _NAME.fullmatch(values["name"]):
            raise ValueError(f"{values['name']!r} is no name of a shard")
        return cls(**{**values, "ground": tuple(values["ground"]), "reach": tuple(values["reach"])})


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and -1e15 < value < 1e15  # type: ignore[operator]


@dataclass(frozen=True)
class Manifest:
    """The manifest of a sharded reference.

    Attributes
    ----------
    build : str
        Name of the folder of its shards: a digest of their sources and options.
    crs : str
        That the roads came in.
    margin_m : float
    meta : dict
        As in the shards: sources, attribution, kinds of roads, options.
    coarse : ShardEntry or None
        The main roads of all the ground, for images that show no others. None: it was built before there were such.
    """

    name: str
    build: str
    crs: str
    margin_m: float
    meta: dict[str, Any] = field(repr=False)
    shards: tuple[ShardEntry, ...] = field(repr=False)
    roadgeo: str = __version__
    coarse: ShardEntry | None = None

    @property
    def filled(self) -> tuple[ShardEntry, ...]:
        """The shards that can be searched."""
        return tuple(entry for entry in self.shards if entry.crs)

    @property
    def files(self) -> tuple[ShardEntry, ...]:
        """All that has files: the shards, and the coarse map."""
        return (*self.filled, *([self.coarse] if self.coarse is not None and self.coarse.crs else []))

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {"schema": SCHEMA, **asdict(self)}


def manifest_path(path: str | os.PathLike[str]) -> Path | None:
    """Return the manifest of a sharded reference, given its path, its folder or their name, or None."""
    given = Path(path)
    if given.name == _MANIFEST:
        given = given.parent
    for folder in (given, given.with_name(f"{given.name}{ENDING}")):
        if (folder / _MANIFEST).is_file():
            return folder / _MANIFEST
    return None


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises
    ------
    IndexFormatError
        It is missing, damaged, or of another version.
    """
    again = "build it again with `roadgeo index --shards`"
    try:
        with bounded(path, IndexFormatError):
            return _parse_manifest(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise IndexFormatError(f"{path}: {(error.strerror or str(error)).lower()}; {again}") from error
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise IndexFormatError(f"{path}: is damaged, or of another version: {error}; {again}") from error


def _parse_manifest(document: Any) -> Manifest:
    """Make a manifest of JSON values, which may hold anything."""
    if type(document) is not dict or document.pop("schema", None) != SCHEMA:
        raise ValueError(f"expected an object of schema {SCHEMA}")
    shards = tuple(ShardEntry.from_dict(values) for values in document.pop("shards"))
    coarse = document.pop("coarse", None)
    manifest = Manifest(**document, shards=shards, coarse=None if coarse is None else ShardEntry.from_dict(coarse))
    texts = (manifest.name, manifest.build, manifest.crs, manifest.roadgeo)
    if any(type(text) is not str for text in texts) or not _NAME.fullmatch(manifest.build):
        raise ValueError("a name is wrong")
    if type(manifest.meta) is not dict or not _is_number(manifest.margin_m) or not manifest.filled:
        raise ValueError("it has no shards")
    return manifest


def write_manifest(folder: Path, manifest: Manifest) -> Path:
    """Write the manifest of a folder, whole or not at all.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    path = folder / _MANIFEST
    write_text(path, json.dumps(manifest.to_dict(), indent=1, allow_nan=False))
    return path


# --- searching --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shard:
    """A shard that is opened when it is needed, and then stays open: its arrays are memory-mapped."""

    entry: ShardEntry
    path: Path
    coarseness: float = 1.0

    def may_hold(self, near: Near, frame_m: float = 0.0) -> bool:  # noqa: ARG002 (its margin holds the frame)
        """Whether the middle of a frame may lie on its own ground and within a circle."""
        return touches(self.entry.ground, near)

    def touches(self, box: Box) -> bool:
        """Whether its own ground and a box share some."""
        return overlap(box, self.entry.ground)

    def open(self) -> ReferenceIndex:
        """Return its index.

        Raises
        ------
        IndexFormatError
            It is missing, damaged, or not the one that the manifest names.
        """
        return self._index

    @cached_property
    def _index(self) -> ReferenceIndex:
        paths = reference_paths(self.path)
        if not paths.index.is_file() and not paths.geopackage.is_file():
            self._fetch()
        try:
            return self._opened()
        except IndexFormatError:  # a fetched file may have been damaged since
            if not self._fetch():
                raise
        return self._opened()

    def _fetch(self) -> bool:
        """Fetch it, if it lies elsewhere; return whether it does."""
        return fetch_shard(self.path.parent.parent, self.path.parent.name, self.entry.name, self.entry.bytes)

    def _opened(self) -> ReferenceIndex:
        """Open it, if it is the one that the manifest names, and was that all the while."""
        from roadgeo.reference.reference import open_whole

        for _ in range(2):  # an index that is missing is built by opening it
            before = identities(self.path)
            opened = open_whole(self.path)
            if (opened.digest or stored_digest(reference_paths(self.path).geopackage)) != self.entry.digest:
                raise IndexFormatError(
                    f"{self.path}: is not the shard that the manifest names; build the reference again"
                )
            if identities(self.path) == before:
                return opened.index
        raise IndexFormatError(f"{self.path}: is replaced again and again; try when that is done")


@dataclass(frozen=True)
class ShardedReference:
    """A map in shards; it is searched as one (see `reference.Reference`)."""

    path: Path
    manifest: Manifest
    shards: tuple[Shard, ...] = field(repr=False)
    coarse: Shard | None = field(repr=False, default=None)

    @property
    def parts(self) -> tuple[Shard, ...]:
        """The references to search: the coarse map, if there is one, and the shards."""
        return self.shards if self.coarse is None else (self.coarse, *self.shards)

    @property
    def name(self) -> str:
        """Its name for the user."""
        return self.manifest.name

    @property
    def digest(self) -> str:
        """Digest of the intersections of all its shards."""
        digests = "".join(entry.digest for entry in self.manifest.files)
        return blake2b(digests.encode(), digest_size=16).hexdigest()

    def only(self, names: Collection[str]) -> ShardedReference:
        """Return the same map, of which only parts of these names are searched."""
        kept = tuple(shard for shard in self.shards if shard.entry.name in names)
        coarse = self.coarse if self.coarse is not None and self.coarse.entry.name in names else None
        return replace(self, shards=kept, coarse=coarse)

    def index_of(self, location: Location) -> ReferenceIndex:
        """Return the index of the shard that a location lies on; of the last where there is no place.

        For a frame that a shard may not show wholly it comes from the coarse map.
        """
        center = location.center
        if center is None or location.footprint is None:
            return self.parts[-1].open()
        near = (center.lon, center.lat, 0.0)
        here = [part for part in self.parts if part.entry.crs == location.crs and touches(part.entry.reach, near)]
        wide = np.ptp(location.footprint, axis=0).max() > 2.0 * self.manifest.margin_m
        return min(
            here or self.parts,
            key=lambda part: ((part is self.coarse) != wide, not touches(part.entry.ground, near)),
        ).open()

    def indexes_at(self, places: Sequence[tuple[float, float]]) -> list[ReferenceIndex]:
        """Return the indexes of the shards on whose ground places (longitude, latitude) lie, at least one."""
        held = [shard for shard in self.shards if any(touches(shard.entry.ground, (*place, 0.0)) for place in places)]
        return [shard.open() for shard in (held or self.shards[:1])[:_MOST_DRAWN]]


#: A page of an overview draws no more shards than this.
_MOST_DRAWN = 9


def open_shards(path: Path) -> ShardedReference:
    """Open a sharded reference by its manifest; none of its shards yet.

    Raises
    ------
    IndexFormatError
        The manifest is damaged.
    """
    manifest = read_manifest(path)
    shards = tuple(Shard(entry, shard_path(path, manifest, entry)) for entry in manifest.filled)
    coarse = None
    if manifest.coarse is not None and manifest.coarse.crs:
        coarse = Shard(manifest.coarse, shard_path(path, manifest, manifest.coarse), COARSENESS)
    _allow_open_files(2 * len(shards))
    return ShardedReference(path.parent, manifest, shards, coarse)


def shard_path(path: Path, manifest: Manifest, entry: ShardEntry) -> Path:
    """Return the GeoPackage of a shard beside the manifest at `path`."""
    return path.parent / manifest.build / f"{entry.name}.gpkg"


def _allow_open_files(more: int) -> None:
    """Ask the system for as many open files as there are shards: each that is mapped counts as one."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = min(more + 1024, hard) if hard != resource.RLIM_INFINITY else more + 1024
        if wanted > soft != resource.RLIM_INFINITY:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
