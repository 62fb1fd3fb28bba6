"""Measure how well and how fast masks are located: python examples/benchmark.py roads.gpkg ... (any road lines)

Every argument is a city: a file of road lines, from which a reference is built and masks are drawn, or a folder of
masks with a truth.csv (as `roadgeo simulate` writes) and a file of road lines. Kinds of masks, 1500 x 1500 pixels:

clean       north up, 1 m per pixel, roads 9 or 10 pixels wide, nothing wrong
homography  a pinhole camera: any heading, tilt to 30 degrees, 0.7 to 1.4 m per pixel
mild        like that, and 5 to 10 % of the roads missing, 2 to 5 % false ones, blobs and holes, bent by 0.8 pixels
noisy       15 to 25 % missing, 5 to 12 % false, three times as many blobs and holes, ragged, bent by 1.5 pixels
hard        tilt 30 to 50 degrees, 0.3 to 3 m per pixel, focal length 1000 to 3500 pixels, only 12 to 30 intersections
            visible: in half of the masks the whole frame shows no more, in the others all but its middle is black

All but the hard ones show 30 intersections or more. Some masks are also looked for on the map of the next city (with
one city, turned over): what is found there is wrong, and how long it takes to find nothing is told. One process does
one mask after the other on one core; times are of tracing, and of matching and refining; "cpu" is the processor time
of all that, which other programs on the machine disturb less. Errors are those of the masks located rightly.
"""

from __future__ import annotations

import argparse
import cProfile
import importlib
import json
import math
import os
import pkgutil
import pstats
import sys
import tempfile
import time
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402

import roadgeo.kernels  # noqa: E402
from roadgeo.errors import MaskError, RoadgeoError, RoadSourceError  # noqa: E402
from roadgeo.evaluation.demo import demo_masks  # noqa: E402
from roadgeo.evaluation.landscape import Landscape, visible_intersections  # noqa: E402
from roadgeo.evaluation.noise import NoiseModel, draw_mask  # noqa: E402
from roadgeo.evaluation.scoring import Score, Share, calibrate_odds, calibrate_sigma, score, share  # noqa: E402
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query  # noqa: E402
from roadgeo.evaluation.trials import Mask, MaskFiles, QuerySet, Trial, run_trials  # noqa: E402
from roadgeo.evaluation.truth import Truth, read_truth  # noqa: E402
from roadgeo.geometry.pinhole import make_view, sees_ground  # noqa: E402
from roadgeo.kernels.compilation import Kernel  # noqa: E402
from roadgeo.reference.reference import open_reference  # noqa: E402
from roadgeo.roads.simplification import planarize  # noqa: E402
from roadgeo.sources.masks import read_mask  # noqa: E402
from roadgeo.workflows import LocateOptions, build_reference, locate  # noqa: E402

TILTED = ViewOptions(
    gsd_m=(0.7, 1.4), tilt_deg=(0.0, 30.0), heading_deg=(0.0, 360.0), focal_px=1500.0, road_width_px=(9.0, 10.0)
)
KINDS = {
    "clean": SimulationOptions(ViewOptions(road_width_px=(9.0, 10.0)), kind="clean"),
    "homography": SimulationOptions(TILTED, kind="homography"),
    "mild": SimulationOptions(
        replace(TILTED, road_width_px=(7.0, 12.0)),
        NoiseModel((0.05, 0.10), (0.02, 0.05), blobs=(3, 9), holes=(3, 9), warp_px=0.8, raggedness=0.12),
        "mild",
    ),
    "noisy": SimulationOptions(
        replace(TILTED, road_width_px=(7.0, 12.0)),
        NoiseModel((0.15, 0.25), (0.05, 0.12), blobs=(9, 27), holes=(9, 27), warp_px=1.5, raggedness=0.22),
        "noisy",
    ),
}
HARD = NoiseModel((0.02, 0.06), (0.0, 0.02), blobs=(1, 4), warp_px=0.6, raggedness=0.08)
SIDE = 1500


# --- masks ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DrawnQueries:
    """`count` masks of each kind, drawn from road lines as they are, not as the reference simplifies them."""

    roads: Path
    kinds: tuple[str, ...]
    count: int
    seed: int

    def __len__(self) -> int:
        return len(self.kinds) * self.count

    def open(self) -> Callable[[int], tuple[Truth, Mask]]:
        landscape = read_landscape(self.roads)

        def draw(k: int) -> tuple[Truth, Mask]:
            kind = self.kinds[k // self.count]
            if kind == "hard":
                return draw_hard(landscape, self.seed, k % self.count)
            query = simulate_query(landscape, replace(KINDS[kind], seed=self.seed), k % self.count)
            return query.truth, query.mask

        return draw


@dataclass(frozen=True)
class Elsewhere:
    """Some masks of a set, to be looked for where they are not: on another map, or turned over."""

    queries: QuerySet
    chosen: tuple[int, ...]
    mirrored: bool

    def __len__(self) -> int:
        return len(self.chosen)

    def open(self) -> Callable[[int], tuple[Truth, Mask]]:
        draw = self.queries.open()

        def displace(k: int) -> tuple[Truth, Mask]:
            truth, mask = draw(self.chosen[k])
            if self.mirrored:
                pixels = cv2.imread(mask, cv2.IMREAD_UNCHANGED) if isinstance(mask, str) else mask
                mask = np.ascontiguousarray(pixels[:, ::-1])
            return replace(truth, kind="turned over" if self.mirrored else "elsewhere", on_map=False), mask

        return displace


def read_lines(path: Path) -> Any:
    """Read road lines; of a file with several layers, the one called roads."""
    import geopandas as gpd
    import pyogrio

    layers = [str(name) for name, _ in pyogrio.list_layers(path)]
    return gpd.read_file(path, layer="roads" if "roads" in layers else layers[0])


def read_landscape(path: Path) -> Landscape:
    from roadgeo.sources.roads import project_lines

    roads = read_lines(path)
    lines, plane = project_lines(roads.geometry, roads.crs)
    graph = planarize(lines)
    return Landscape(graph, graph.xy[graph.degree() >= 3], plane)


def draw_hard(landscape: Landscape, seed: int, k: int) -> tuple[Truth, Mask]:
    """Draw a hard mask; its sampling is kept until a place for it is found."""
    rng = np.random.default_rng([seed, zlib.crc32(b"hard"), k])
    for _ in range(20):
        gsd = math.exp(rng.uniform(math.log(0.3), math.log(3.0)))
        for _ in range(500):
            drawn = _try_hard(landscape, gsd, k % 2 == 0, rng)
            if drawn is not None:
                truth, mask = drawn
                return replace(truth, file=f"hard/q_{k:04d}.png"), mask
    raise RoadSourceError("the map has no place for a hard mask: give a larger one")


def _try_hard(
    landscape: Landscape, gsd: float, whole: bool, rng: np.random.Generator
) -> tuple[Truth, np.ndarray[Any, Any]] | None:
    middle = landscape.intersections[rng.integers(len(landscape.intersections))] + rng.normal(0.0, 400.0, 2)
    focal = 1500.0 if rng.random() < 0.5 else math.exp(rng.uniform(math.log(1000), math.log(3500)))
    angles = rng.uniform((30.0, 0.0, 0.0), (50.0, 360.0, 360.0))
    view = make_view((middle[0], middle[1]), (SIDE, SIDE), gsd, *angles, focal)
    if not sees_ground(view):
        return None
    reach = np.sort(np.abs(visible_intersections(landscape, view) - SIDE / 2).max(axis=1))
    wanted = int(rng.integers(12, 31))
    half = SIDE / 2 if whole or len(reach) <= wanted else float(np.clip(reach[wanted - 1] + 15.0, 250.0, SIDE / 2))
    low, high = round(SIDE / 2 - half), round(SIDE / 2 + half)
    shown = view.homography(np.array([[low, low], [high, low], [high, high], [low, high]], float))
    if not 12 <= int((reach < half - 14.0).sum()) <= 30 or not landscape.covers(shown):
        return None
    in_metres = bool(rng.random() < 0.5)
    drawn, properties = draw_mask(landscape, view, HARD, (8.0, 8.0) if in_metres else (9.0, 10.0), rng, not in_metres)
    mask = np.zeros_like(drawn)
    mask[low:high, low:high] = drawn[low:high, low:high]
    if not mask.any():
        return None
    matrix = landscape.plane.to_crs_matrix() @ view.homography.matrix
    properties |= {"gsd_m": gsd, "tilt_deg": view.tilt_deg, "n_intersections": int((reach < half - 14.0).sum())}
    return Truth("", "hard", matrix / matrix[2, 2], landscape.plane.crs, (SIDE, SIDE), True, properties), mask


# --- locating ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TimedLocator:
    """`locate` on one reference, with the processor time that it took."""

    reference: Path
    options: LocateOptions

    def open(self) -> Callable[[Mask], dict[str, Any]]:
        cv2.setNumThreads(1)
        reference = open_reference(self.reference)
        locate(read_mask(demo_masks()[0].path), reference, self.options)  # what is loaded once counts for no mask

        def answer(mask: Mask) -> dict[str, Any]:
            try:
                pixels = read_mask(mask)
                started = time.process_time()
                found = locate(pixels, reference, self.options).to_dict()
                return found | {"cpu_s": time.process_time() - started}
            except MaskError as error:
                return {"status": "not_located", "reason": str(error)}

        return answer


@dataclass(frozen=True)
class City:
    """A name, a reference, and masks."""

    name: str
    reference: Path
    queries: QuerySet


def open_city(source: Path, options: argparse.Namespace, folder: Path) -> City:
    """Build the reference of an argument, unless an earlier run has, and find or plan its masks."""
    if source.is_dir():
        roads = source / options.roads if options.roads else _road_file(source)
        truths = [one for one in read_truth(source / "truth.csv") if one.kind in options.kinds or not one.on_map]
        queries: QuerySet = MaskFiles(source, tuple(_first(truths, options.count)))
    else:
        roads = source
        queries = DrawnQueries(source, tuple(options.kinds), options.count or 12, options.seed)
    name = source.stem
    path = folder / f"{name}.gpkg"
    try:
        open_reference(path)
    except RoadgeoError:
        tell(f"{name}: building the reference from {roads}")
        build_reference(read_lines(roads), name).save(path)
    return City(name, path, queries)


def _road_file(folder: Path) -> Path:
    for name in ("ref_20km.gpkg", "roads.gpkg"):
        if (folder / name).is_file():
            return folder / name
    raise SystemExit(f"{folder} holds no ref_20km.gpkg or roads.gpkg; name the file of road lines with --roads")


def _first(truths: Sequence[Truth], count: int | None) -> Iterator[Truth]:
    """Yield the first `count` of each kind."""
    seen: Counter[str] = Counter()
    for truth in truths:
        seen[truth.kind] += 1
        if count is None or seen[truth.kind] <= count:
            yield truth


def measure(cities: Sequence[City], method: str, options: argparse.Namespace, folder: Path) -> list[tuple[str, Trial]]:
    """Locate all masks of all cities, and some of each where they are not."""
    default = LocateOptions()
    search = replace(default.search, time_limit_s=options.time_limit)
    located_by = replace(default, method="pair" if method == "pair" else "auto", search=search)
    trials = []
    for i, city in enumerate(cities):
        other = cities[(i + 1) % len(cities)]
        step = max(1, len(city.queries) // max(options.elsewhere, 1))
        absent = Elsewhere(city.queries, tuple(range(0, len(city.queries), step))[: options.elsewhere], other is city)
        for queries, reference, part in ((city.queries, city.reference, ""), (absent, other.reference, "_elsewhere")):
            if len(queries) == 0:
                continue
            record = folder / f"{city.name}_{method}{part}.jsonl"
            names = ("seed", "count", "kinds", "time_limit", "elsewhere")
            settings = {name: getattr(options, name) for name in names}
            ran = run_trials(queries, TimedLocator(reference, located_by), options.jobs, record, settings, _count_up())
            trials += [(city.name, trial) for trial in ran]
            tell(f"{city.name}{part.replace('_', ' ')}, {method}: {len(ran)} masks")
    return trials


def _count_up() -> Callable[[Trial], None]:
    counts: Counter[str] = Counter()

    def count(trial: Trial) -> None:
        counts[trial.answer["status"]] += 1
        if sys.stderr.isatty():
            print("\r" + ", ".join(f"{n} {status}" for status, n in counts.items()), end="\r", file=sys.stderr)

    return count


# --- tables -----------------------------------------------------------------------------------------------------------


SPREADS = (
    "In brackets: 95 % confidence. Metres: median / 95 %. ms: tracing 50 / 90 %, matching and refining 50 / 90 / 99 /"
    " 100 %,\nprocessor 50 / 99 %."
)


@dataclass(frozen=True)
class Row:
    """What is known of one mask."""

    city: str
    score: Score
    cpu_s: float

    @property
    def vectorize_s(self) -> float:
        return self.score.seconds.get("vectorize", math.nan)

    @property
    def match_s(self) -> float:
        return self.score.seconds.get("match", math.nan) + self.score.seconds.get("refine", math.nan)


def describe_shares(rows: Sequence[Row]) -> list[str]:
    right = sum(row.score.right for row in rows)
    precision = share(right, sum(row.score.located for row in rows))
    recall = share(right, sum(row.score.on_map for row in rows))
    return [str(len(rows)), percent(precision), percent(recall)]


def is_wrong(one: Score) -> bool:
    return one.located and not one.right


def percent(estimate: Share) -> str:
    if estimate.of == 0:
        return "-"
    return f"{100 * estimate.value:.1f} ({100 * estimate.low:.1f}-{100 * estimate.high:.1f})"


def spread(values: Sequence[float], quantiles: Sequence[float], scale: float = 1.0, digits: int = 0) -> str:
    known = np.array([value for value in values if math.isfinite(value)])
    if len(known) == 0:
        return "-"
    return " / ".join(f"{scale * np.quantile(known, q):.{digits}f}" for q in quantiles)


def kind_table(rows: Sequence[Row]) -> list[list[str]]:
    """One row per city and kind, then per kind, then for everything that has a place."""
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    present = [row for row in rows if row.score.on_map]
    for row in present:
        groups[row.city, row.score.kind].append(row)
    for row in present if len({city for city, _ in groups}) > 1 else ():
        groups["all", row.score.kind].append(row)
    groups["all", "all"] = present
    heads = ["city", "kind", "n", "precision %", "recall %", "centre m", "corners m"]
    table = [[*heads, "trace ms", "match + refine ms", "cpu ms"]]
    for (city, kind), members in groups.items():
        right = [row.score for row in members if row.score.right]
        table.append(
            [
                city,
                kind,
                *describe_shares(members),
                spread([one.center_m for one in right], (0.5, 0.95), digits=1),
                spread([one.corners_rms_m for one in right], (0.5, 0.95), digits=1),
                spread([row.vectorize_s for row in members], (0.5, 0.9), 1000),
                spread([row.match_s for row in members], (0.5, 0.9, 0.99, 1.0), 1000),
                spread([row.cpu_s for row in members], (0.5, 0.99), 1000),
            ]
        )
    return table


def refusal_table(rows: Sequence[Row]) -> list[list[str]]:
    table = [["city", "masks that are", "n", "refused", "match + refine ms", "cpu ms"]]
    absent = [row for row in rows if not row.score.on_map]
    for city in [*dict.fromkeys(row.city for row in absent), "all"]:
        members = [row for row in absent if city in {row.city, "all"}]
        kinds = ", ".join(dict.fromkeys(row.score.kind for row in members))
        refused = share(sum(not row.score.located for row in members), len(members))
        times = [[row.match_s for row in members], [row.cpu_s for row in members]]
        table.append(
            [
                city,
                kinds,
                str(len(members)),
                percent(refused),
                *(spread(some, (0.5, 0.95, 1.0), 1000) for some in times),
            ]
        )
    return table


def odds_table(scores: Sequence[Score]) -> list[list[str]]:
    table = [["claimed odds >=", "located", "wrong", "wrong % (95 %)", "allowed %", "holds"]]
    for step in calibrate_odds(scores):
        if step.wrong.of:
            allowed = f"{100 * step.allowed:.2g}"
            counts = [str(step.wrong.of), str(step.wrong.hits), percent(step.wrong)]
            table.append([f"10^{step.at_least:g}", *counts, allowed, "yes" if step.holds else "NO"])
    return table


def sigma_table(scores: Sequence[Score]) -> list[list[str]]:
    found = calibrate_sigma(scores)
    head = ["corner error / claim", "rms", "robust", "within 1", "within 2", "within 3"]
    within = [percent(part) for part in (found.within_1, found.within_2, found.within_3)]
    honest = ["if honest", "1", "1", "63.2", "98.2", "99.99"]
    return [head, ["right masks", f"{found.rms:.2f}", f"{found.robust:.2f}", *within], honest]


def render(table: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def draw_calibration(path: Path, scores: Sequence[Score]) -> None:
    """Draw claimed odds against the share of wrong ones, and corner errors against their claims."""
    try:
        import matplotlib as mpl
    except ImportError:
        tell("no picture of the calibration: pip install matplotlib")
        return
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    steps = [step for step in calibrate_odds(scores, np.arange(0.0, 40.0, 0.5).tolist()) if step.wrong.of]
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), constrained_layout=True)
    at = [step.at_least for step in steps]
    left.plot(at, [step.allowed for step in steps], "--", color="0.5", label="promised at most")
    left.fill_between(at, 1e-5, [step.wrong.high for step in steps], color="C0", alpha=0.15, label="95 % upper bound")
    left.plot(at, [max(step.wrong.value, 1e-5) for step in steps], color="C0", label="measured")
    left.set(yscale="log", ylim=(1e-5, 1), xlabel="located at log10 odds of at least", ylabel="share that is wrong")
    left.legend()
    ratios = np.sort(
        [
            error / (math.sqrt(2) * sigma)
            for one in scores
            if one.right
            for error, sigma in zip(one.corners_m, one.sigma_m, strict=True)
            if sigma > 0
        ]
    )
    fine = np.linspace(0, 4, 200)
    right.plot(fine, 1 - np.exp(-(fine**2)), "--", color="0.5", label="honest")
    right.plot(ratios, (np.arange(len(ratios)) + 1) / max(len(ratios), 1), color="C0", label="measured")
    right.set(xlim=(0, 4), ylim=(0, 1), xlabel="corner error / (sqrt(2) corner_sigma_m)", ylabel="share of corners")
    right.legend()
    figure.savefig(path, dpi=120)
    tell(f"wrote {path}")


# --- where the time goes ----------------------------------------------------------------------------------------------

STAGES = {
    "trace": ("vectorization", "thinning", "tracing"),
    "simplify": ("simplification", "graph"),
    "intersections and scene": ("intersections", "scene", "buckets"),
    "look up": ("triples", "pairs"),
    "screen and compare roads": ("roads",),
    "grow and match": ("growth",),
    "refine": ("adjustment", "refinement"),
    "verify": ("verification",),
    "search": ("estimator", "robust", "camera"),
    "describe": ("workflows", "location", "projection", "homography"),
}


def profile(city: City, options: argparse.Namespace) -> str:
    """Locate a few masks of each kind under a profiler; tell the share of each stage and the longest functions."""
    draw, reference = city.queries.open(), open_reference(city.reference)
    chosen, seen = [], Counter[str]()
    for k in range(len(city.queries)):
        truth, mask = draw(k)
        seen[truth.kind] += 1
        if seen[truth.kind] <= options.profile:
            chosen.append(read_mask(mask))
    located_by = replace(LocateOptions(), search=replace(LocateOptions().search, time_limit_s=options.time_limit))
    for mask in chosen[:2]:
        locate(mask, reference, located_by)
    name_kernels()
    profiler = cProfile.Profile()
    with profiler:
        for mask in chosen:
            locate(mask, reference, located_by)
    stats: Any = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    by_stage: defaultdict[str, float] = defaultdict(float)
    by_function: defaultdict[str, float] = defaultdict(float)
    for function, (_, _, own, _, callers) in stats.items():
        if (function[0] == "~" or Path(function[0]).stem == "compilation") and callers:  # its callers' work
            for caller, (*_, spent, _) in callers.items():
                by_stage[_stage(caller)] += spent
                by_function[f"{_label(caller)}: {function[2]}"] += spent
        else:
            by_stage[_stage(function)] += own
            by_function[_label(function)] += own
    total = sum(by_stage.values())
    table = [["stage", "ms per mask", "%"]]
    for stage, spent in sorted(by_stage.items(), key=lambda entry: -entry[1]):
        table.append([stage, f"{1000 * spent / len(chosen):.2f}", f"{100 * spent / total:.1f}"])
    longest = [["function", "ms per mask", "%"]]
    for name, spent in sorted(by_function.items(), key=lambda entry: -entry[1])[:20]:
        longest.append([name[:90], f"{1000 * spent / len(chosen):.2f}", f"{100 * spent / total:.1f}"])
    head = f"{city.name}, {len(chosen)} masks, {1000 * total / len(chosen):.1f} ms each under the profiler"
    return f"{head}\n\n{render(table)}\n\n{render(longest)}"


def name_kernels() -> None:
    """Call each kernel by a function of its own name and file, which a profiler can tell from the others."""

    def named(one: Kernel, file: str) -> Callable[..., Any]:
        run = one._run or one._prepare()

        def call(*args: Any) -> Any:
            return run(*args)

        call.__code__ = call.__code__.replace(co_name=one.name, co_filename=file)
        return call

    for found in pkgutil.iter_modules(roadgeo.kernels.__path__):
        module = importlib.import_module(f"roadgeo.kernels.{found.name}")
        for one in vars(module).values():
            if isinstance(one, Kernel) and one.module == module.__name__:
                one._run = named(one, str(module.__file__))


def _stage(function: tuple[str, int, str]) -> str:
    stem = Path(function[0]).stem
    return next((stage for stage, modules in STAGES.items() if stem in modules), "numpy and others")


def _label(function: tuple[str, int, str]) -> str:
    return f"{Path(function[0]).stem}.{function[2]}"


# --- all together -----------------------------------------------------------------------------------------------------


def tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    text = __doc__.split("\n\n", 1)
    parser = argparse.ArgumentParser(
        description=text[0], epilog=text[1], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cities", nargs="+", type=Path, help="files of road lines, or folders of masks with truth.csv")
    parser.add_argument("-o", "--out-dir", type=Path, help="keep references, answers, tables; go on where one stopped")
    parser.add_argument("-n", "--count", type=int, help="masks of each kind and city (drawn: 12; of a folder: all)")
    parser.add_argument("--kinds", nargs="+", default=[*KINDS, "hard"], choices=[*KINDS, "hard"], metavar="KIND")
    parser.add_argument("--methods", nargs="+", default=["auto", "pair"], choices=["auto", "pair"], metavar="METHOD")
    parser.add_argument("--elsewhere", type=int, default=12, help="masks of each city to look for where they are not")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds a mask (60: a search ends by itself)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--roads", help="file of road lines in each folder of masks (ref_20km.gpkg or roads.gpkg)")
    parser.add_argument("-j", "--jobs", type=int, default=1, help="processes; times are honest with 1 only")
    parser.add_argument(
        "--profile", type=int, nargs="?", const=3, help="also tell where the time goes, for N of a kind"
    )
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    folder = options.out_dir or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    cities = [open_city(source, options, folder) for source in options.cities]
    parts = []
    for method in options.methods:
        rows = [
            Row(city, score(trial.truth, trial.answer), trial.answer.get("cpu_s", math.nan))
            for city, trial in measure(cities, method, options, folder)
        ]
        scores = [row.score for row in rows]
        parts += [f"Method {method}\n{SPREADS}", render(kind_table(rows))]
        if options.elsewhere:
            everything = describe_shares(rows)
            parts += ["Looked for where they are not (50 / 95 / 100 %)", render(refusal_table(rows))]
            parts += [f"Precision over everything located, these included: {everything[1]} %"]
        if method == "auto":
            parts += ["Do the odds mean what they say?", render(odds_table(scores)), render(sigma_table(scores))]
            draw_calibration(folder / "calibration.png", scores)
        wrong = [f"{row.city} {row.score.kind} {row.score.file}" for row in rows if is_wrong(row.score)]
        parts += [f"Wrong: {', '.join(wrong)}"] if wrong else []
    if options.profile:
        parts += ["Where the time goes", *(profile(city, options) for city in cities[:1])]
    text = "\n\n".join(parts)
    print(text)
    if options.out_dir:
        (folder / "benchmark.txt").write_text(text + "\n", encoding="utf-8")
        settings = {name: str(value) for name, value in vars(options).items()}
        (folder / "settings.json").write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except RoadgeoError as error:
        raise SystemExit(f"Error: {error}") from error
