"""Locate the queries of the authors' programs with roadgeo, with `--method pair` and by plain correlation.

    python examples/peers/ours.py --queries FOLDER [--methods roadgeo pair correlation] [--areas 10 20]

FOLDER holds a folder for each city, with `truth.csv`, the masks, and the maps `ref_10km.gpkg` and `ref_20km.gpkg`. The
queries are those that `results/programs.csv` names, the same maps too. Correlation gets the true heading and scale, the
others nothing. Every search is a row of `results/ours.csv`; a run that was stopped goes on. Times are processor
seconds of one thread: reading, tracing and search; maps are read and built before.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2  # noqa: E402
import geopandas as gpd  # noqa: E402
import numpy as np  # noqa: E402
import results  # noqa: E402
from correlate import DrawnMap, side_of, turn_north  # noqa: E402

import roadgeo  # noqa: E402
from roadgeo.evaluation.truth import Truth, read_truth  # noqa: E402
from roadgeo.matching.options import LocateOptions  # noqa: E402

RESULTS = Path(__file__).parent / "results"
#: Columns that name a query and its map.
QUERY = ("city", "area_km", "kind", "query")
#: Searches end by their own rules, not by the clock of a busy machine.
TIME_LIMIT_S = 600.0

#: Whether a place was reported, and x and y of the middle there, in the CRS of the truth.
Found = tuple[bool, tuple[float, float] | None]


def asked(folder: Path, areas: list[int]) -> Iterator[dict[str, str]]:
    """Yield the queries of `results/programs.csv` whose masks are at hand, each once."""
    rows = {tuple(row[name] for name in QUERY) for row in results.read(RESULTS / "programs.csv")}
    for row in sorted(rows, key=lambda row: (row[3], *row)):
        query = dict(zip(QUERY, row, strict=True))
        if int(query["area_km"]) in areas and (folder / query["city"]).is_dir():
            yield query


@cache
def truths(city: Path) -> dict[str, Truth]:
    return {truth.file: truth for truth in read_truth(city / "truth.csv")}


# --- methods ----------------------------------------------------------------------------------------------------------


@cache
def reference(roads: Path) -> Any:
    return roadgeo.index(gpd.read_file(roads, layer="roads"), roads.parent.name)


def locate(mask: Path, truth: Truth, roads: Path, options: LocateOptions | None = None) -> Found:
    """Locate with roadgeo."""
    answer = roadgeo.locate(mask, reference(roads), options, time_limit=TIME_LIMIT_S)
    if answer.homography is None:
        return False, None
    middle = replace(truth, homography=answer.homography, crs=answer.crs).places(np.divide(truth.size, 2.0), truth.crs)
    return answer.located, (float(middle[0]), float(middle[1]))


def pair(mask: Path, truth: Truth, roads: Path) -> Found:
    """Locate with the paper's matcher."""
    return locate(mask, truth, roads, LocateOptions(method="pair"))


@cache
def drawn(roads: Path) -> DrawnMap:
    return DrawnMap(gpd.read_file(roads, layer="roads").geometry.to_numpy(), side_of(1500, 1.4))


def correlate(mask: Path, truth: Truth, roads: Path) -> Found:
    """Take the peak of the correlation, with the true heading and scale."""
    read = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
    return True, drawn(roads).find(*turn_north(read, truth, drawn(roads).side))


METHODS: dict[str, Callable[[Path, Truth, Path], Found]] = {"roadgeo": locate, "pair": pair, "correlation": correlate}


# --- searches ---------------------------------------------------------------------------------------------------------


def measure(method: str, query: dict[str, str], folder: Path) -> dict[str, Any]:
    """Search for one query; return its outcome as in `programs.csv`."""
    city = folder / query["city"]
    truth = truths(city)[f"{query['kind']}/{query['query']}.png"]
    roads = city / f"ref_{query['area_km']}km.gpkg"
    (drawn if method == "correlation" else reference)(roads)
    started = time.process_time()
    found, middle = METHODS[method](city / truth.file, truth, roads)
    seconds = time.process_time() - started
    off = "" if middle is None else f"{np.hypot(*np.subtract(middle, truth.center)):.1f}"
    return {"found": int(found), "centre_err_m": off, "time_s": f"{seconds:.3f}"}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--queries", type=Path, required=True)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--areas", nargs="+", type=int, choices=(10, 20), default=[10, 20])
    parser.add_argument("--most", type=int, default=1_000_000, help="queries of each method")
    parser.add_argument("--out", type=Path, default=RESULTS / "ours.csv")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    version = results.commit()
    for method in options.methods:
        for query in list(asked(options.queries, options.areas))[: options.most]:
            key = {"peer": method, **query}
            if not results.holds(options.out, key):
                results.append(options.out, {**key, **measure(method, query, options.queries), "commit": version})


if __name__ == "__main__":
    main()
