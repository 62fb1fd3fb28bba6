"""Make many maps of one, none a twin of it: how a search grows with what it searches.

    roadgeo index --roads roads.parquet --shards auto --out maps/map_00.shards
    python examples/scale/maps.py maps/map_00.shards --count 10

Writes maps/map_01.shards and so on beside it: each the same network seen in a mirror, stretched and turned, indexed
anew, on a part of the Earth of its own. No view of a camera from above is one of its mirror image, so a mask drawn from
the first map has no place on the others. Maps that exist are kept: run it again to go on.
"""

import argparse
import math
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo.geometry.projection import LocalPlane, to_lonlat
from roadgeo.matching.index import build_index
from roadgeo.reference.index_file import write_index
from roadgeo.reference.network_file import network_digest, read_network
from roadgeo.reference.shards import Manifest, ShardEntry, manifest_path, read_manifest, write_manifest
from roadgeo.roads.network import RoadNetwork

#: Degrees of longitude from one map to the next, and the ground around a shard's intersections.
APART_DEG, MARGIN_DEG = 12.0, 0.02


def transformation(k: int) -> np.ndarray:
    """Return the (2, 2) matrix of map k: a mirror, a stretch and a turn."""
    rng = np.random.default_rng(k)
    stretch = np.diag(rng.uniform(0.85, 1.2, 2))
    angle = rng.uniform(0.0, 2.0 * math.pi)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return turn @ stretch @ np.diag([-1.0, 1.0])


def turned(angles: np.ndarray, matrix: np.ndarray, period: float, low: float) -> np.ndarray:
    """Return directions under a matrix, in [low, low + period), ascending, NaN behind the last."""
    vectors = np.stack([np.cos(angles), np.sin(angles)], axis=-1) @ matrix.T
    moved = (np.arctan2(vectors[..., 1], vectors[..., 0]) - low) % period + low
    return np.sort(moved, axis=1).astype(np.float32)


def transform(network: RoadNetwork, matrix: np.ndarray, crs: str) -> RoadNetwork:
    """Return a network under a matrix, on a plane of another CRS."""
    graph, found = network.graph, network.intersections
    graph = replace(graph, xy=graph.xy @ matrix.T, coords=graph.coords @ matrix.T)
    rays = turned(found.rays, matrix, 2.0 * math.pi, -math.pi)
    tangents = turned(found.tangents, matrix, math.pi, 0.0)
    found = replace(found, xy=found.xy @ matrix.T, rays=rays, tangents=tangents)
    x, y = matrix @ np.array(network.plane.origin)
    return replace(network, graph=graph, intersections=found, plane=LocalPlane(crs, (float(x), float(y))), coverage=())


def make_shard(source: Path, entry: ShardEntry, target: Path, k: int, build: str) -> ShardEntry:
    """Write a shard of map k; return its entry in the manifest."""
    crs = f"+proj=aeqd +lat_0=0 +lon_0={APART_DEG * k} +datum=WGS84 +units=m"
    network = transform(read_network(source), transformation(k), crs)
    network = replace(network, meta={**network.meta, "shard_of": build})
    index = build_index(network)
    digest = network_digest(network)
    write_index(target, dict(index.meta), index.arrays(), {"name": target.stem, "network": digest})
    lonlat = to_lonlat(crs, network.plane.to_crs(index.xy))
    low, high = lonlat.min(axis=0) - MARGIN_DEG, lonlat.max(axis=0) + MARGIN_DEG
    box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return replace(entry, ground=box, reach=box, crs=crs, bytes=target.stat().st_size, digest=digest)


def make_map(first: Path, folder: Path, k: int) -> None:
    """Write map k, unless it is there."""
    manifest = read_manifest(first)
    entries: list[Any] = []
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    for entry in manifest.filled:
        source = first.parent / manifest.build / f"{entry.name}.gpkg"
        entries.append(make_shard(source, entry, folder / "shards" / f"{entry.name}.index", k, f"map_{k:02d}"))
    reported = {**asdict(manifest), "name": folder.stem, "build": "shards", "shards": tuple(entries), "coarse": None}
    write_manifest(folder, Manifest(**reported))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path)
    parser.add_argument("--count", type=int, default=10)
    given = parser.parse_args()
    first = manifest_path(given.first)
    if first is None:
        raise SystemExit(f"Error: {given.first}: no reference in shards; build one with `roadgeo index --shards auto`")
    for k in range(1, given.count):
        folder = given.first.with_name(f"map_{k:02d}.shards")
        if not (folder / "manifest.json").is_file():
            started = time.process_time()
            make_map(first, folder, k)
            print(f"{folder.name}: {time.process_time() - started:.0f} s", flush=True)


if __name__ == "__main__":
    main()
