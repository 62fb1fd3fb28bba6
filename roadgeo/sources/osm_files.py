"""OpenStreetMap's own files, whatever their order, the sign of their ids and their number of versions.

osmium reads them. A PBF file is cut between its blobs, to check them before, and to know how much of it is read.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray, IntArray
from roadgeo.errors import RoadSourceError
from roadgeo.sources.lines import OSM_ATTRIBUTION, RoadTable, line_through
from roadgeo.storage.pbf import read_parts
from roadgeo.storage.unpacking import read_chunks

__all__ = ["ASK_LESS", "GAVE_UP", "OSM_ENDINGS", "stream_ways"]

OSM_ENDINGS = (*(".osm.pbf", ".pbf", ".osm", ".osm.gz", ".osm.bz2", ".osm.xml", ".osh", ".osh.gz", ".osh.bz2", ".o5m"),)

#: Places of nodes are kept in memory up to this size of a PBF file (8 times its size), else on disk.
_NODES_IN_MEMORY = 100_000_000
#: An object that JOSM's user has deleted stays in its file.
#: Each pattern here gives up at the next tag: an element without an end is looked at once, not once for each beginning.
_WAY = re.compile(rb"<way\b([^<>]*+)")
_IS_DELETED, _ID = re.compile(rb"\baction=[\"']delete"), re.compile(rb"\bid=[\"'](-?\d{1,18})[\"']")
#: Overpass ends an answer so that it could not complete.
_REMARK = re.compile(rb"<remark>\s*+([^<]++)</remark>")
GAVE_UP, ASK_LESS = "says that it is not whole", "ask for a smaller area, or again"
_MOST_TAG = 4096

_Way = tuple[Any, str, str | None, str | None]  # line, highway, tunnel, name


def stream_ways(path: Path, most: int, advance: Callable[[float], None], folder: Path) -> Iterator[RoadTable]:
    """Yield the ways with a `highway` tag that exist, in their newest versions, in parts of bounded size.

    Nodes may stand behind ways or be left out where ways bring their places along. A way cut off by an extract is
    the parts whose nodes are there; ways without any are counted.

    Parameters
    ----------
    advance : callable
        Called with the share of the file that is read.
    folder : Path
        Where the places of the nodes of a large file may be kept.

    Raises
    ------
    RoadSourceError
        It is no OpenStreetMap data, is damaged, or unpacks to far more than any map.
    """
    import osmium

    deleted = set() if _is_pbf(path) else _deleted_ways(path)
    first, _ = next(_parts(path))  # not the path: osmium forgets to close a damaged PBF file on disk
    with osmium.io.Reader(first, osmium.osm.NOTHING) as reader:
        header = reader.header()
    stamp = header.get("osmosis_replication_timestamp") or header.get("timestamp")
    meta = {"format": "OpenStreetMap", "attribution": OSM_ATTRIBUTION} | ({"osm_timestamp": stamp} if stamp else {})
    ways: list[_Way] = []
    n_read = n_lost = 0
    for way, line in _highways(path, header, advance, folder):
        if way.tags.get("area") == "yes" or not way.visible or way.id in deleted:
            continue
        n_read += 1
        if line is None:
            n_lost += 1
            continue
        tags = way.tags
        ways.append((line, tags["highway"], tags.get("tunnel"), tags.get("name") or tags.get("ref")))
        if len(ways) == most:
            yield _table(ways, n_read, n_lost, meta)
            ways, n_read, n_lost = [], 0, 0
    yield _table(ways, n_read, n_lost, meta)


def _table(ways: Sequence[_Way], n_read: int, n_lost: int, meta: dict[str, Any]) -> RoadTable:
    """Make a table of ways, of which some more were read, and some lost for want of places."""
    import shapely

    shapes, *columns = np.array([*ways, (None,) * 4], object)[:-1].T
    named = dict(zip(("highway", "tunnel", "name"), columns, strict=True))
    counts = {"features": n_read} | ({"without_places": n_lost} if n_lost else {})
    return RoadTable(np.asarray(shapely.from_wkb(shapes)), "EPSG:4326", named, meta | counts)


def _highways(path: Path, header: Any, advance: Callable[[float], None], folder: Path) -> Iterator[tuple[Any, Any]]:
    """Yield each way with a `highway` tag in its newest version, and its line as WKB, or None.

    osmium knows places of nodes by ids above zero, and of any version. Where that will not do there is a census.
    """
    import osmium

    kept = "flex_mem" if path.stat().st_size <= _NODES_IN_MEMORY else f"sparse_file_array,{folder}/nodes"
    places = osmium.NodeLocationsForWays(osmium.index.create_map(kept))
    places.ignore_errors()
    pool, factory = osmium.io.ThreadPool(), osmium.geom.WKBFactory()
    # Objects handed to osmium are kept alive here: its iterators do not do so.
    filters = osmium.filter.EntityFilter(osmium.osm.WAY), osmium.filter.KeyFilter("highway")
    features = {header.get(f"pbf_optional_feature_{n}") for n in range(4)}
    is_plain = _is_pbf(path) and not header.has_multiple_object_versions and "LocationsOnWays" not in features
    census = None if is_plain else _Census.of(path, pool)
    if is_plain:
        for part, share in _parts(path):
            with osmium.io.Reader(part, osmium.osm.NODE, thread_pool=pool) as reader:
                osmium.apply(reader, places)
            advance(share / 2)
    for part, share in _parts(path):
        with osmium.io.Reader(part, osmium.osm.WAY, thread_pool=pool) as reader:
            way: Any
            for way in osmium.OsmFileIterator(reader, *filters, *([places] if is_plain else [])):
                if census is None and any(node.ref < 0 for node in way.nodes):
                    census = _Census.of(path, pool)
                if census is None or (way.id, way.version) not in census.old_ways:
                    yield way, _way_shape(way, factory, census)
        advance((1 + share) / 2)


def _way_shape(way: Any, factory: Any, census: _Census | None) -> Any:
    """Return a way as WKB, in pieces between the nodes whose places are not known; None where nothing is left."""
    import osmium
    import shapely

    try:
        return factory.create_linestring(way)
    except (RuntimeError, osmium.InvalidLocationError):  # fewer than two different nodes, or some without a place
        nodes = list(way.nodes)
    own = [node.location.valid() for node in nodes]
    points = census.places([node.ref for node in nodes]) if census else np.full((len(nodes), 2), np.nan)
    for k in np.flatnonzero(own):
        points[k] = nodes[k].location.lon, nodes[k].location.lat
    return shapely.to_wkb(line_through(points))


@dataclass(frozen=True)
class _Census:
    """Where all nodes of a file lie in their newest versions, and which versions of ways are no longer true.

    Attributes
    ----------
    ids : (N,) int64, ascending
    xy : (N, 2) int32, degrees times ten million
    old_ways : set of (id, version)
    """

    ids: IntArray
    xy: AnyArray
    old_ways: set[tuple[int, int]]

    @classmethod
    def of(cls, path: Path, pool: Any) -> _Census:
        """Go through a file once."""
        import osmium

        nodes, xy, ways = array("q"), array("i"), array("q")
        for part, _ in _parts(path):
            item: Any
            for item in osmium.FileProcessor(part, osmium.osm.NODE | osmium.osm.WAY, pool):
                if item.is_way():
                    ways.extend((item.id, item.version))
                else:
                    nodes.extend((item.id, item.version))
                    xy.extend((item.location.x, item.location.y))
        kept, _ = _newest(nodes)
        _, old = _newest(ways)
        ids = np.frombuffer(nodes, np.int64).reshape(-1, 2)[kept, 0] if nodes else np.empty(0, np.int64)
        places = np.frombuffer(xy, np.int32).reshape(-1, 2)[kept] if xy else np.empty((0, 2), np.int32)
        return cls(ids, places, old)

    def places(self, refs: Sequence[int]) -> FloatArray:
        """Return longitudes and latitudes of nodes; (n, 2), NaN where they are not known."""
        lonlat = np.full((len(refs), 2), np.nan)
        if len(self.ids):
            at = np.minimum(np.searchsorted(self.ids, refs), len(self.ids) - 1)
            is_stored = (self.ids[at] == refs) & (np.abs(self.xy[at]) <= (1_800_000_000, 900_000_000)).all(axis=1)
            lonlat[is_stored] = self.xy[at[is_stored]] / 1e7
        return lonlat


def _newest(objects: array[int]) -> tuple[IntArray, set[tuple[int, int]]]:
    """Return of pairs (id, version) the place of the newest of each id, by id, and the pairs that are older."""
    pairs = np.frombuffer(objects, np.int64).reshape(-1, 2) if objects else np.empty((0, 2), np.int64)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    ids, versions = pairs[order].T
    last = np.append(ids[1:] != ids[:-1], True)[: len(ids)]
    older = np.flatnonzero(~last)
    older = older[versions[older] < versions[np.searchsorted(ids, ids[older], side="right") - 1]]
    return order[last], set(map(tuple, pairs[order[older]].tolist()))


def _deleted_ways(path: Path) -> set[int]:
    """Return the ids of the ways that JOSM's user has deleted: they stay in its files. And bound what is unpacked.

    Raises
    ------
    RoadSourceError
        It is an answer that Overpass did not complete.
    """
    ways, tail = set(), b""
    for chunk in read_chunks(path):
        text = tail + chunk
        if b"delete" in text:
            deleted = (_ID.search(tag) for tag in _WAY.findall(text) if _IS_DELETED.search(tag))
            ways |= {int(number[1]) for number in deleted if number}
        if remark := _REMARK.search(text):
            said = remark[1].decode("utf-8", "replace")[:200].strip(" .")
            raise RoadSourceError(f"{path}: {GAVE_UP}: {said}; {ASK_LESS}")
        tail = text[-_MOST_TAG:]
    return ways


def _is_pbf(path: Path) -> bool:
    return path.name.lower().endswith(".pbf")


def _parts(path: Path) -> Iterator[tuple[Any, float]]:
    """Yield the sources that osmium reads one after another, and the share of the file that is read then.

    A PBF file is cut into parts that are checked, for osmium does not report its progress. Others are left whole.
    """
    import osmium

    for part, share in read_parts(path) if _is_pbf(path) else ((str(path), 1.0),):
        yield (osmium.io.FileBuffer(part, "pbf") if isinstance(part, bytes) else part), share
