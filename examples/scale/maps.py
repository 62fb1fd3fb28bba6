"""Make many maps of one, none a twin of it, and build each in shards: how a search grows with what it searches.

    python examples/scale/maps.py roads.parquet maps --count 10

Writes maps/map_00.shards, the roads as they are, and map_01.shards and so on: the same roads seen in a mirror, turned
and stretched, each on a part of the Earth of its own. No view of a camera from above is one of its mirror image, so a
mask drawn from the first has no place on the others. What is there already is kept: run it again to go on.
"""

import argparse
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

#: Degrees of longitude from one map to the next.
APART_DEG = 12


def transformation(k: int) -> np.ndarray:
    """Return the (2, 2) matrix of map k: the identity of the first, else a mirror, a stretch and a turn."""
    if k == 0:
        return np.eye(2)
    rng = np.random.default_rng(k)
    stretch = np.diag(rng.uniform(0.85, 1.2, 2))
    angle = rng.uniform(0.0, 2.0 * math.pi)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return turn @ stretch @ np.diag([-1.0, 1.0])


def write_roads(source: Path, target: Path, k: int) -> None:
    """Write the roads of map k."""
    import geopandas as gpd
    import shapely

    roads = gpd.read_parquet(source)
    coords = shapely.get_coordinates(roads.geometry.values)
    middle = (coords.min(axis=0) + coords.max(axis=0)) / 2.0
    moved = (coords - middle) @ transformation(k).T
    lines = shapely.set_coordinates(roads.geometry.values.copy(), moved)
    crs = f"+proj=aeqd +lat_0=0 +lon_0={APART_DEG * k} +datum=WGS84 +units=m"
    columns = {"highway": roads["highway"].to_numpy()} if "highway" in roads else {}
    gpd.GeoDataFrame(columns, geometry=lines, crs=crs).to_parquet(target, row_group_size=50_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("roads", type=Path, help="GeoParquet, in metres on a plane")
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for k in range(given.count):
        shards, lines = given.out / f"map_{k:02d}.shards", given.out / f"map_{k:02d}.parquet"
        if (shards / "manifest.json").is_file():
            continue
        write_roads(given.roads, lines, k)
        started = time.perf_counter()
        command = [sys.executable, "-m", "roadgeo", "index", "--quiet", "--roads", lines, "--shards", "auto"]
        subprocess.run([*map(str, command), "--jobs", str(given.jobs), "--out", str(shards)], check=True)
        print(f"{shards.name}: {time.perf_counter() - started:.0f} s", flush=True)
        lines.unlink()


if __name__ == "__main__":
    main()
