"""Masks among many maps, false hints, repeated districts and mirrored blocks: easy masks, in company.

    export ROADGEO_DATA=/path/to/development/data     (the atlas of 33 cities)
    python examples/company/company.py shards         masks of five cities, on the atlas in shards
    python examples/company/company.py told           frames with a circle of 40 m on the wrong blocks, and on the right
    python examples/company/company.py twice          maps that hold a district twice
    python examples/company/company.py soft           soft masks of grids, also mirrored: those have no place
    python examples/company/company.py table          count the results again

Every search is a row in results/NAME.csv; a run that was stopped goes on where it was. Maps are built once, in --maps.
Seconds are processor time of one thread.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
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
import shapely  # noqa: E402
from bench import city_roads, options_of  # noqa: E402
from correlate import DrawnMap, side_of, turn_north  # noqa: E402
from shapely import affinity  # noqa: E402

import roadgeo  # noqa: E402
from roadgeo.errors import RoadSourceError  # noqa: E402
from roadgeo.evaluation.landscape import Landscape  # noqa: E402
from roadgeo.evaluation.scoring import score  # noqa: E402
from roadgeo.evaluation.simulation import SimulatedQuery, simulate_query  # noqa: E402
from roadgeo.geometry.projection import to_lonlat  # noqa: E402
from roadgeo.sources.roads import read_roads  # noqa: E402

ATLAS = Path(os.environ.get("ROADGEO_DATA", "")) / "atlas" / "roads_packed_plane.parquet"
#: Cities of it: of many kinds; of blocks that look alike; and with a district that stands twice.
SHARDS = ("porto", "chicago", "auckland", "slc", "liege")
ALIKE = ("montevideo", "chicago", "bucaramanga", "boston", "slc")
TWICE = ("boston", "porto", "montevideo", "chicago", "liege", "columbus")
#: A false circle and a true one, and how far its middle may be off: metres.
FALSE_M, TRUE_M, TRUE_OFF_M = 40.0, 60.0, 25.0
#: Searches end by their own rules, not by the clock of a busy machine.
TIME_LIMIT_S = 900.0
#: A look-alike lies at least so far from the truth, metres.
APART_M = 80.0
#: Outcomes that are counted beside those that are located: a column, and its value.
SAID = (("status", "ambiguous"), ("code", "fits_elsewhere"))
#: Sides of a district and of the map around it, and how far the copies are apart, metres.
DISTRICT_M, AROUND_M, BETWEEN_M = 2600.0, 11_000.0, 5200.0


@dataclass(frozen=True)
class Case:
    """A mask to be located on a map; `city`, `kind` and `k` name it.

    It is the `number`-th mask of a kind of `examples/bench.py`, drawn of `roads`. `circle` is "true" or "false" where
    scale, heading and a circle are given. A soft mask is drawn as a network draws it.
    """

    city: str
    kind: str
    k: int
    reference: Path
    roads: Path
    mask: str
    number: int
    circle: str = ""
    mirrored: bool = False
    soft: bool = False

    @property
    def key(self) -> dict[str, Any]:
        return {"city": self.city, "kind": self.kind, "k": self.k}

    def draw(self, seed: int) -> SimulatedQuery | None:
        """Draw the mask; None where the roads have no place for one."""
        options = options_of(self.mask, "turned over" if self.mirrored else "", seed)
        try:
            query = simulate_query(landscape_of(self.roads), options, self.number)
        except RoadSourceError:
            return None
        return replace(query, mask=soften(query.mask, np.random.default_rng(self.k))) if self.soft else query

    def hints(self, query: SimulatedQuery) -> dict[str, Any]:
        """Return the scale within 7 %, the heading within 8 degrees, and a circle; or nothing."""
        truth, rng = query.truth, np.random.default_rng(self.k)
        if not self.circle:
            return {}
        gsd, off = truth.properties["gsd_m"], rng.uniform(-TRUE_OFF_M, TRUE_OFF_M, 2)
        middle = truth.center + off if self.circle == "true" else look_alike(query, self.roads)
        lon, lat = to_lonlat(str(truth.crs), np.array([middle]))[0]
        near = float(lon), float(lat), TRUE_M if self.circle == "true" else FALSE_M
        return {"gsd": (0.93 * gsd, 1.07 * gsd), "heading": (truth.properties["heading_deg"], 8.0), "near": near}


@dataclass(frozen=True)
class Setting:
    """Where maps are kept, roads of all cities, the seed, how many masks of each kind and city, and which cities."""

    maps: Path
    atlas: Path
    seed: int
    count: int
    cities: tuple[str, ...] = ()

    def roads(self, city: str) -> Path:
        """Return the file of the roads of a city, 20 x 20 km."""
        path = self.maps / f"{Path(city).stem}.parquet"
        if not path.is_file():
            city_roads(city).to_parquet(path)
        return path

    def build(self, roads: Path, name: str, *options: str) -> Path:
        """Build a map, unless an earlier run has."""
        path = self.maps / name
        if not path.exists():
            command = [sys.executable, "-m", "roadgeo", "index", "-q", "--roads", roads, "--out", path, *options]
            subprocess.run(list(map(str, command)), check=True)
        return path


@cache
def landscape_of(roads: Path) -> Landscape:
    read = read_roads(roads)
    return Landscape.from_lines(read.lines, read.plane)


def soften(mask: Any, rng: np.random.Generator) -> Any:
    """Return a mask, (H, W) uint8, as a network would draw it: blurred roads in a haze."""
    height, width = mask.shape
    coarse = rng.standard_normal((height // 40 + 2, width // 40 + 2)).astype(np.float32)
    haze = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 4.0)
    return np.clip(0.8 * blurred + 18.0 + 14.0 * haze, 0.0, 255.0).astype(np.uint8)


# --- a map of many cities ---------------------------------------------------------------------------------------------


def shards(setting: Setting) -> Iterator[Case]:
    """Masks of some cities, clean and with 40 % gone and 40 % false, on a map of all of them in shards."""
    reference = setting.build(setting.atlas, "atlas.shards", "--shards", "auto")
    for k in range(setting.count):
        for city in setting.cities or SHARDS:
            for kind in ("gone40false40", "clean"):
                yield Case(city, kind, k, reference, setting.roads(city), kind, k)


# --- false and true hints ---------------------------------------------------------------------------------------------


def told(setting: Setting) -> Iterator[Case]:
    """Frames with scale, heading and a circle given: around the place that looks most alike, and around their own."""
    for k in range(setting.count):
        for city in setting.cities or ALIKE:
            roads = setting.roads(city)
            reference = setting.build(roads, f"{roads.stem}.gpkg")
            for frame in ("frame512", "frame800"):
                for circle in ("false", "true"):
                    yield Case(city, f"{frame}, {circle}", k, reference, roads, frame, k, circle)


def look_alike(query: SimulatedQuery, roads: Path) -> tuple[float, float]:
    """Return x, y of the place, other than its own, whose roads correlate best with the mask, north up and to scale."""
    side = side_of(1600, 0.55)
    return drawn_map(roads, side).find(*turn_north(query.mask, query.truth, side), (*query.truth.center, APART_M))


@cache
def drawn_map(roads: Path, side: int) -> DrawnMap:
    landscape = landscape_of(roads)
    return DrawnMap(shapely.transform(landscape.lines, landscape.plane.to_crs), side)


# --- soft masks -------------------------------------------------------------------------------------------------------


def soft(setting: Setting) -> Iterator[Case]:
    """Frames whose blocks may nearly equal their mirror image, and their mirror images."""
    for k in range(setting.count):
        for city in setting.cities or ALIKE:
            roads = setting.roads(city)
            reference = setting.build(roads, f"{roads.stem}.gpkg")
            for frame in ("frame512", "frame800"):
                yield Case(city, frame, k, reference, roads, frame, k, soft=True)
                yield Case(city, f"{frame}, mirrored", k, reference, roads, frame, k, mirrored=True, soft=True)


# --- districts that stand twice ---------------------------------------------------------------------------------------


def twice(setting: Setting) -> Iterator[Case]:
    """Masks of a district on a map that holds it twice: moved, turned, larger, or with 5 % of its streets gone."""
    for k in range(setting.count):
        for number, city in enumerate(setting.cities or TWICE):
            kind = ("moved", "turned", "larger", "streets gone")[(k + number) % 4]
            folder = setting.maps / f"{Path(city).stem}_{kind.replace(' ', '_')}_{setting.seed}_{k}"
            reference = setting.maps / f"{folder.name}.gpkg"
            if not folder.is_dir():
                write_twice(setting.roads(city), folder, kind, np.random.default_rng([setting.seed, k, number]))
            setting.build(folder / "map.parquet", reference.name)
            for mask in range(3):
                yield Case(city, kind, 3 * k + mask, reference, folder / "district.parquet", "clean", mask)


def write_twice(roads: Path, folder: Path, kind: str, rng: np.random.Generator) -> None:
    """Write the roads of a district, and a map that holds it twice: west of the middle of the city, and east."""
    found = gpd.read_parquet(roads)
    lines = shapely.get_parts(shapely.force_2d(found.geometry.to_numpy()))
    middle = np.median(shapely.get_coordinates(lines), axis=0) + rng.uniform(-800.0, 800.0, 2)
    half = np.array([BETWEEN_M / 2, 0.0])
    west, east = middle - half, middle + half
    square = shapely.box(*(west - DISTRICT_M / 2), *(west + DISTRICT_M / 2))
    district = shapely.get_parts(shapely.line_merge(shapely.union_all(shapely.intersection(lines, square))))
    angle = 0.0 if kind == "moved" else rng.uniform(20.0, 340.0)
    scale = rng.uniform(1.15, 1.3) if kind == "larger" else 1.0

    def copied(shape: Any) -> Any:
        turned = affinity.rotate(affinity.scale(shape, scale, scale, origin=tuple(west)), angle, origin=tuple(west))
        return affinity.translate(turned, *(east - west))

    kept = [line for line in district if kind != "streets gone" or rng.random() > 0.05]
    around = shapely.box(*(middle - AROUND_M / 2), *(middle + AROUND_M / 2)) - copied(square)
    whole = [*shapely.get_parts(shapely.intersection(lines, around)), *map(copied, kept)]
    folder.mkdir(parents=True)
    for name, shapes in (("district", district), ("map", whole)):
        shapes = [shape for shape in shapes if shape.geom_type == "LineString" and shape.length > 0.5]
        columns = {"highway": ["residential"] * len(shapes)}
        gpd.GeoDataFrame(columns, geometry=shapes, crs=found.crs).to_parquet(folder / f"{name}.parquet")


# --- searches and their counts ----------------------------------------------------------------------------------------


def measure(cases: Iterator[Case], seed: int, out: Path) -> None:
    """Search for all that `out` does not hold yet."""
    version = results.commit()
    for case in cases:
        if results.holds(out, {**case.key, "seed": seed}):
            continue
        query = case.draw(seed)
        if query is None:
            print(f"{case.city}, {case.kind}: no place for such a mask", file=sys.stderr)
            continue
        hints = case.hints(query)
        opened = open_map(case.reference)
        started = time.process_time()
        answer = roadgeo.locate(query.mask, opened, time_limit=TIME_LIMIT_S, **hints)
        seconds = time.process_time() - started
        radius = max(20.0, 0.02 * query.truth.properties["gsd_m"] * max(query.truth.size))
        found = score(query.truth, answer.to_dict(), radius)
        outcome = {"status": found.status, "right": int(found.right), "code": answer.reason_code.value}
        numbers = {"score": f"{found.log10_odds:.2f}", "off_m": f"{found.center_m:.1f}", "cpu_s": f"{seconds:.2f}"}
        results.append(out, {**case.key, "seed": seed, **outcome, **numbers, "commit": version})


@cache
def open_map(path: Path) -> Any:
    """Open a map; a first search, whose time counts for no mask, loads the program."""
    opened = roadgeo.open_reference(path)
    cross = np.zeros((400, 400), np.uint8)
    cross[190:210] = cross[:, 190:210] = 1
    roadgeo.locate(cross > 0, opened)
    return opened


def count(path: Path) -> str:
    """Return the counts of each kind in a file of results, as Markdown."""
    rows, lines = results.read(path), []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind]
        located = [row for row in mine if row["status"] == "located"]
        wrong = sum(row["right"] == "0" for row in located)
        spent = [[float(row["cpu_s"]) for row in mine if (row in located) == is_it] for is_it in (True, False)]
        located_s, refused_s = (f"{np.median(some):.2g}, {np.mean(some):.2g}" if some else "-" for some in spent)
        said = [sum(row[name] == value for row in mine) for name, value in SAID]
        lines.append([kind, results.share(len(located) - wrong, len(mine)), wrong, *said, located_s, refused_s])
    head = ["kind", "located right", "wrong", "ambiguous", "fits elsewhere"]
    return results.table([*head, "seconds located: median, mean", "refused"], lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sets = {"shards": shards, "told": told, "twice": twice, "soft": soft}
    parser.add_argument("what", choices=[*sets, "table"])
    parser.add_argument("-n", "--count", type=int, default=6, help="masks of each kind and city; `twice`: maps of each")
    parser.add_argument("--seed", type=int, default=72)
    parser.add_argument("--cities", nargs="+", default=(), help="of the atlas, or files of roads")
    parser.add_argument("--atlas", type=Path, default=ATLAS, help="roads of the map in shards")
    parser.add_argument("--maps", type=Path, default=Path("maps"), help="folder of the maps that are built")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    if options.what in sets:
        options.maps.mkdir(parents=True, exist_ok=True)
        setting = Setting(options.maps, options.atlas, options.seed, options.count, tuple(options.cities))
        measure(sets[options.what](setting), options.seed, options.out / f"{options.what}.csv")
    for name in sets if options.what == "table" else (options.what,):
        if (options.out / f"{name}.csv").is_file():
            print(f"\n{name}\n\n{count(options.out / f'{name}.csv')}")


if __name__ == "__main__":
    main()
