"""How far a score can be trusted: search for masks that have no place on the map, and count what is found.

    python examples/trust/trust.py CITY.gpkg CITY.gpkg ... --out results --count 200 --effort quick --jobs 4

Every argument is a file of road lines; its reference is built from all roads but a band across the middle,
3.5 km wide. `--count` masks are drawn of each city and kind, worn in five ways (see `WORN`), and searched:

there       of the city's roads outside the band, to compare with: these have a place
forbidden   of the roads in the band: the city is right, the place is missing from the map
elsewhere   of the next city's roads
mirrored    like `there`, turned over: no camera sees that
shuffled    like `there`, cut into 6 x 6 blocks that were mixed and turned: roads like the map's, laid out like none

Every search is a line in `results/EFFORT/CITY_KIND.jsonl`; a run that was stopped goes on where it was, and a larger
count goes on from a smaller one. Masks of all cities and kinds take turns, so that a table of half a run is fair. In
the end `results/EFFORT.csv` holds a short line of each; `--add` counts such files of earlier runs, of other seeds, with
this one. The table shows, for thresholds of the score, how many masks with a place would be located rightly, and how
many others or places would be reported wrongly, with bounds of 95 % confidence (Clopper and Pearson, Biometrika 26,
1934).
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import shapely  # noqa: E402

from roadgeo.errors import RoadgeoError  # noqa: E402
from roadgeo.evaluation.landscape import Landscape  # noqa: E402
from roadgeo.evaluation.noise import NoiseModel  # noqa: E402
from roadgeo.evaluation.scoring import Score, score  # noqa: E402
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query  # noqa: E402
from roadgeo.evaluation.trials import Mask, ReferenceLocator, Trial, run_trials  # noqa: E402
from roadgeo.evaluation.truth import Truth  # noqa: E402
from roadgeo.location import ERROR_RATES  # noqa: E402
from roadgeo.reference.opening import open_reference  # noqa: E402
from roadgeo.sources.roads import Roads, read_roads  # noqa: E402
from roadgeo.workflows import LocateOptions, build_reference  # noqa: E402

KINDS = ("there", "forbidden", "elsewhere", "mirrored", "shuffled")
THRESHOLDS = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 8.0, 10.0, 15.0)
BAND_M = 3500.0
BLOCKS = 6
CHUNK = 5

VIEW = ViewOptions((1200, 1200), gsd_m=(0.7, 2.0), tilt_deg=(0.0, 40.0), heading_deg=(0.0, 360.0), focal_px=1500.0)
FEW = replace(VIEW, gsd_m=(0.4, 0.9), intersections=(8, 18))
MILD = NoiseModel((0.05, 0.10), (0.02, 0.05), blobs=(3, 9), holes=(3, 9), warp_px=0.8, raggedness=0.12)
NOISY = NoiseModel((0.15, 0.25), (0.05, 0.12), blobs=(9, 27), holes=(9, 27), warp_px=1.5, raggedness=0.22)
#: How masks are worn: names, views and noise, in turn.
WORN = {
    "mild": (VIEW, MILD),
    "noisy": (VIEW, NOISY),
    "few": (FEW, MILD),
    "torn": (VIEW, replace(NOISY, missing=(0.3, 0.5), false_roads=(0.1, 0.4))),
    "outdated": (VIEW, replace(MILD, outdated=(0.2, 0.4))),
}


# --- masks ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class City:
    """A file of road lines, the reference of all of it but the band, and where that lies: its x, metres."""

    name: str
    roads: Path
    reference: Path


@lru_cache(maxsize=40)
def landscapes(roads: Path) -> tuple[Landscape, Landscape]:
    """Return the roads outside the band and those in it, to draw masks from."""
    found = read_roads(roads)
    inside, outside = split(found)
    return Landscape.from_lines(outside, found.plane, sides_of(found)), Landscape.from_lines(inside, found.plane)


def band_of(roads: Roads) -> tuple[float, float]:
    """Return the least and greatest x of the band, around the middle of the roads."""
    middle = float(np.median(shapely.get_coordinates(roads.lines)[:, 0]))
    return middle - BAND_M / 2, middle + BAND_M / 2


def split(roads: Roads) -> tuple[Any, Any]:
    """Cut the lines at the band's edges: those inside, those outside."""
    low, high = band_of(roads)
    _, south, _, north = shapely.total_bounds(roads.lines)
    band = shapely.box(low, south - 1.0, high, north + 1.0)
    parts = [shapely.get_parts(cut(roads.lines, band)) for cut in (shapely.intersection, shapely.difference)]
    inside, outside = (part[(shapely.get_type_id(part) == 1) & (shapely.length(part) > 1.0)] for part in parts)
    return inside, outside


def sides_of(roads: Roads) -> tuple[Any, ...]:
    """Return the two rings around the ground outside the band."""
    low, high = band_of(roads)
    west, south, east, north = shapely.total_bounds(roads.lines)
    sides = (shapely.box(west, south, low, north), shapely.box(high, south, east, north))
    return tuple(shapely.get_coordinates(side) for side in sides)


@dataclass(frozen=True)
class Searched:
    """`count` masks of one kind, to be looked for on the reference of `city`; `other` is the next city."""

    city: City
    other: City
    kind: str
    seed: int
    count: int

    def __len__(self) -> int:
        return self.count

    def open(self) -> Callable[[int], tuple[Truth, Mask]]:
        outside, band = landscapes((self.other if self.kind == "elsewhere" else self.city).roads)
        landscape = band if self.kind == "forbidden" else outside
        names = list(WORN)

        def draw(k: int) -> tuple[Truth, Mask]:
            worn = names[k % len(names)]
            view, noise = WORN[worn]
            options = SimulationOptions(view, noise, f"{self.kind}_{worn}", self.seed, self.kind == "mirrored")
            query = simulate_query(landscape, options, k // len(names))
            mask = shuffled(query.mask, k) if self.kind == "shuffled" else query.mask
            return replace(query.truth, on_map=self.kind == "there"), mask

        return draw


def shuffled(mask: Any, k: int) -> Any:
    """Cut a mask into blocks, turn them by quarters, and lay them out in another order."""
    side = min(mask.shape) // BLOCKS
    rng = np.random.default_rng(k)
    cells = [(r * side, c * side) for r in range(BLOCKS) for c in range(BLOCKS)]
    out = np.zeros((side * BLOCKS, side * BLOCKS), mask.dtype)
    for (r, c), i in zip(cells, rng.permutation(len(cells)), strict=True):
        y, x = cells[i]
        out[r : r + side, c : c + side] = np.rot90(mask[y : y + side, x : x + side], int(rng.integers(4)))
    return out


# --- searches ---------------------------------------------------------------------------------------------------------


def open_city(roads: Path, folder: Path) -> City:
    """Build the reference of a city without its band, unless an earlier run has."""
    city = City(roads.stem, roads, folder / f"{roads.stem}.gpkg")
    try:
        open_reference(city.reference)
    except RoadgeoError:
        tell(f"{city.name}: building the reference")
        found = read_roads(roads)
        build_reference(replace(found, lines=split(found)[1]), city.name, path=city.reference)
    return city


def search_all(cities: Sequence[City], options: argparse.Namespace) -> Iterator[tuple[str, str, list[Trial]]]:
    """Search in turns until all masks were; yield city, kind and trials of each at the end, or when time is up."""
    folder = options.out / options.effort
    folder.mkdir(parents=True, exist_ok=True)
    default = LocateOptions()
    search = replace(default.search, time_limit_s=options.time_limit)
    asked = replace(default, effort=options.effort, search=search)
    trials: dict[tuple[str, str], list[Trial]] = {}
    for count in [*range(CHUNK, options.count, CHUNK), options.count]:
        for city, other in zip(cities, [*cities[1:], cities[0]], strict=True):
            for kind in KINDS:
                queries = Searched(city, other, kind, options.seed, count)
                record = folder / f"{city.name}_{kind}.jsonl"
                settings = {"seed": options.seed, "effort": options.effort, "time_limit": options.time_limit}
                locator = Opened(ReferenceLocator((city.reference,), asked))
                trials[city.name, kind] = run_trials(queries, locator, options.jobs, record, settings)
        tell(f"{sum(map(len, trials.values()))} searches")
    for (name, kind), ran in trials.items():
        yield name, kind, ran


@dataclass(frozen=True)
class Opened:
    """A locator that stays open from one round to the next."""

    locator: ReferenceLocator

    def open(self) -> Callable[[Mask], dict[str, Any]]:
        cv2.setNumThreads(1)
        return _open(self.locator.references, self.locator)


_opened: dict[tuple[Path, ...], Callable[[Mask], dict[str, Any]]] = {}


def _open(key: tuple[Path, ...], locator: ReferenceLocator) -> Callable[[Mask], dict[str, Any]]:
    if key not in _opened:
        _opened[key] = locator.open()
    return _opened[key]


# --- tables -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """The outcome of one search: the kind of its mask, the best score, and whether the place was right."""

    city: str
    seed: int
    kind: str
    worn: str
    score: float
    right: bool
    seconds: float

    def reported(self, threshold: float) -> bool:
        """Whether the place would be reported with this threshold."""
        return self.score >= threshold


def row_of(city: str, seed: int, kind: str, trial: Trial) -> Row:
    found: Score = score(trial.truth, trial.answer)
    best = found.log10_odds if math.isfinite(found.log10_odds) else -math.inf
    if found.status != "located" and best >= LocateOptions().min_log10_odds:
        best = -math.inf  # refused for another reason, as half a place: it is reported at no threshold
    seconds = sum(found.seconds.get(step, 0.0) for step in ("match", "refine"))
    return Row(city, seed, kind, trial.truth.kind.split("_")[-1], best, found.right, seconds)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a line of comma-separated values a search."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([f.name for f in fields(Row)])
        for r in rows:
            numbers = (f"{r.score:.2f}", int(r.right), f"{r.seconds:.2f}")
            writer.writerow([r.city, r.seed, r.kind, r.worn, *numbers])


def read_rows(path: Path) -> list[Row]:
    """Read what `write_rows` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        next(file)
        return [
            Row(city, int(seed), kind, worn, float(best), right == "1", float(seconds))
            for city, seed, kind, worn, best, right, seconds in csv.reader(file)
        ]


def bounds(hits: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval of Clopper and Pearson for a share."""
    from scipy.stats import beta

    rest = (1.0 - confidence) / 2.0
    low = float(beta.ppf(rest, hits, of - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1.0 - rest, hits + 1, of - hits)) if hits < of else 1.0
    return low, high


def percent(hits: int, of: int) -> str:
    if of == 0:
        return "-"
    low, high = bounds(hits, of)
    return f"{hits} of {of}: {100 * hits / of:.2f} % ({100 * low:.2f}-{100 * high:.2f})"


def threshold_table(rows: Sequence[Row], least: float) -> list[list[str]]:
    """List for each threshold the places reported; below the usual one it is unknown which were right."""
    there, nowhere = [r for r in rows if r.kind == "there"], [r for r in rows if r.kind != "there"]
    table = [["score at least", "with a place: right", "with a place: wrong", "without a place: wrong"]]
    for threshold in THRESHOLDS:
        wrong = sum(r.reported(threshold) for r in nowhere)
        cells = ["-", "-"]
        if threshold >= least:
            found = [r.right for r in there if r.reported(threshold)]
            cells = [percent(sum(found), len(there)), percent(len(found) - sum(found), len(there))]
        table.append([f"{threshold:g}", *cells, percent(wrong, len(nowhere))])
    return table


def band_table(rows: Sequence[Row], least: float) -> list[list[str]]:
    """List for each band of `ERROR_RATES`, which results state, the share of wrong places."""
    table = [["score", "reported", "wrong"]]
    edges = [least, *(rate.score for rate in ERROR_RATES["mask"] if rate.score > least)]
    for low, high in zip(edges, [*edges[1:], math.inf], strict=True):
        inside = [r for r in rows if low <= r.score < high]
        name = f"{low:g} to {high:g}" if high < math.inf else f"{low:g} and more"
        table.append([name, str(len(inside)), percent(sum(not r.right for r in inside), len(inside))])
    return table


def kind_table(rows: Sequence[Row], least: float) -> list[list[str]]:
    """List the outcome of each kind and wear."""
    table = [["mask", *WORN, "highest score without a place", "match + refine s, median / 95 %"]]
    for kind in KINDS:
        some = [r for r in rows if r.kind == kind]
        if not some:
            continue
        cells = []
        for worn in WORN:
            mine = [r for r in some if r.worn == worn]
            cells.append(f"{sum(r.reported(least) for r in mine)} of {len(mine)}")
        highest = "" if kind == "there" else f"{max(r.score for r in some):.1f}"
        spent = np.nanquantile([r.seconds for r in some], [0.5, 0.95])
        table.append([kind, *cells, highest, f"{spent[0]:.2f} / {spent[1]:.2f}"])
    return table


def render(table: Sequence[Sequence[str]]) -> str:
    """Write a table as Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in table]
    return "\n".join([lines[0], "|" + "---|" * len(table[0]), *lines[1:]])


# --- all together -----------------------------------------------------------------------------------------------------


def tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    text = __doc__.split("\n\n", 1)
    parser = argparse.ArgumentParser(
        description=text[0], epilog=text[1], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cities", nargs="+", type=Path, help="files of road lines")
    parser.add_argument("--out", type=Path, required=True, help="references, searches, table")
    parser.add_argument("--count", type=int, default=20, help="masks of each city and kind")
    parser.add_argument("--effort", choices=["quick", "full"], default="full")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--add", type=Path, nargs="*", default=[], help="EFFORT.csv of earlier runs, to be counted with"
    )
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds a mask (60: the search ends by itself)")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    cities = [open_city(path, options.out) for path in options.cities]
    found = search_all(cities, options)
    rows = [row_of(city, options.seed, kind, trial) for city, kind, ran in found for trial in ran]
    write_rows(options.out / f"{options.effort}.csv", rows)
    rows += [row for path in options.add for row in read_rows(path)]
    least = LocateOptions().min_log10_odds
    n = sum(r.kind != "there" for r in rows)
    n_maps = len({r.city for r in rows})
    head = f"{len(rows)} searches with {options.effort} effort on {n_maps} maps, {n} of masks without a place"
    tables = (threshold_table(rows, least), band_table(rows, least), kind_table(rows, least))
    text = "\n\n".join([head, *map(render, tables)])
    print(text)
    (options.out / f"{options.effort}.md").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except RoadgeoError as error:
        raise SystemExit(f"Error: {error}") from error
