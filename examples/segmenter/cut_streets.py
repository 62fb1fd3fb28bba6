"""Cut windows of real streets for painted scenes out of road files, such as extracts of OpenStreetMap.

    python cut_streets.py porto.osm.pbf=60 boston.gpkg=70 --out streets.npz     # 60 and 70 windows

Any file of lines with a column `highway` that pyogrio reads. Each window is 2.2 km wide, about a place on some road.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyogrio
import shapely
from numpy.random import Generator
from numpy.typing import NDArray

HALF_M = 1100.0
#: The order of `painting.WIDTHS`.
KINDS = (
    *("motorway", "trunk", "primary", "secondary", "tertiary", "residential", "unclassified"),
    *("service", "track", "link", "pedestrian"),
)
ALIKE = {"living_street": "residential", "road": "unclassified"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", metavar="FILE=WINDOWS")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rng, lines, kinds, windows = np.random.default_rng(0), [], [], [0]
    for text in options.files:
        name, _, number = text.rpartition("=")
        for cut in _windows(Path(name), int(number), rng):
            lines += [line for line, _ in cut]
            kinds += [kind for _, kind in cut]
            windows.append(len(lines))
    np.savez_compressed(
        options.out,
        xy=np.concatenate(lines),
        starts=np.cumsum([0, *map(len, lines)], dtype=np.int32),
        codes=np.array(kinds, np.int8),
        windows=np.array(windows, np.int32),
    )
    print(f"wrote {len(windows) - 1} windows of {len(lines)} lines to {options.out}")


def _windows(path: Path, number: int, rng: Generator) -> list[list[tuple[NDArray[np.int16], int]]]:
    """Return windows of a file, each as lines in decimetres about its middle with their kinds."""
    layer = "lines" if path.name.endswith((".pbf", ".osm")) else None
    roads = gpd.read_parquet(path) if path.suffix == ".parquet" else pyogrio.read_dataframe(path, layer=layer)
    roads["kind"] = [_kind(highway) for highway in roads.highway]
    roads = roads[roads.kind >= 0].to_crs(roads.estimate_utm_crs()).explode(index_parts=False)
    shapes, kinds = roads.geometry.to_numpy(), roads.kind.to_numpy()
    tree, places, found = shapely.STRtree(shapes), shapely.get_coordinates(shapes), []
    for _ in range(number):
        middle = places[rng.integers(len(places))] + rng.uniform(-300, 300, 2)
        box = shapely.box(*(middle - HALF_M), *(middle + HALF_M))
        cut = []
        for i in tree.query(box, predicate="intersects"):
            inside = shapely.simplify(shapely.intersection(shapes[i], box), 0.3)
            parts = [part for part in shapely.get_parts(inside) if part.geom_type == "LineString"]
            cut += [
                (np.rint((shapely.get_coordinates(part) - middle) * 10).astype(np.int16), int(kinds[i]))
                for part in parts
            ]
        if len(cut) >= 12:
            found.append(cut)
    return found


def _kind(highway: object) -> int:
    """Return the index of a kind of road, -1 for other lines; of several the first counts."""
    text = str(highway[0] if isinstance(highway, list | np.ndarray) and len(highway) else highway)
    text = text.strip("[]'\" ").split("'")[0].split(";")[0]
    text = "link" if text.endswith("_link") else ALIKE.get(text, text)
    return KINDS.index(text) if text in KINDS else -1


if __name__ == "__main__":
    main()
