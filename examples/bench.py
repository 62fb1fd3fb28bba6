"""Does a change locate more, and nothing wrongly? One command, on masks and maps that were chosen once.

    python examples/bench.py                      this checkout alone
    python examples/bench.py --against main       and, on the same masks, another commit (or a folder: a checkout)
    python examples/bench.py --against main --long    a night: twelve cities, many masks

Masks of each kind are drawn once from the roads of each city (20 x 20 km), and kept with all answers in `--out`; a run
that was stopped goes on where it was. Each checkout builds its own references and locates in its own processes, by what
`import roadgeo` offers, so that an engine is compared with any other. Cities come from the development data
(ROADGEO_DATA); without it from the small ones in tests/data/accept. `--cities` takes files of your own roads as well.

The table has a row for each kind of mask that has a place (`KINDS`), and one for each of masks that have none:
mirrored, as no camera sees the ground, and of the next city. Where two checkouts are compared, each cell holds this
one, then the other. "recall" counts places within 20 m or 2 % of the frame's side; "wrong" all others that were
reported. Corners: of right places, root mean square of the four, metres, median / 90 %. Error / claim: the same over
`corner_sigma_m`, median / root mean square; 1 is honest. Seconds are processor time, median / mean.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402

HERE = Path(__file__).resolve().parents[1]
SEED = 4711
SIDE_M = 20_000.0
#: Two plain cities and two grids; a night adds eight. Names are as in the atlas.
CITIES = ("boston", "montevideo", "saopaulo", "chicago")
LONG = (*CITIES, "liege", "slc", "wuhan", "porto", "douala", "columbus", "portland", "astana")
#: Masks of each kind and city, and of each kind without a place.
COUNT, LONG_COUNT = 6, 40


@dataclass(frozen=True)
class Kind:
    """How a kind differs from a usual view: of `ViewOptions`, of `NoiseModel`, half of the frame black, a lens."""

    view: dict[str, Any]
    noise: dict[str, Any]
    half_black: bool = False
    lens_k1: float = 0.0


_FRAME = {"size_px": (1024, 1024), "gsd_m": (0.45, 0.55), "tilt_deg": (0.0, 5.0), "intersections": (12, 1_000_000)}
_LOST = {"intersections": (8, 1_000_000)}  # as many as are left whole
KINDS = {
    "base": Kind({}, {}),
    "clean": Kind({"tilt_deg": (0.0, 0.0)}, {"missing": (0, 0), "false_roads": (0, 0), "warp_px": 0, "raggedness": 0}),
    "frame512": Kind(_FRAME, {"missing": (0, 0), "false_roads": (0, 0), "warp_px": 2.0}),
    "frame512gone20": Kind(_FRAME | _LOST, {"missing": (0.2, 0.2), "false_roads": (0.05, 0.05), "warp_px": 2.0}),
    "frame800": Kind(_FRAME | {"size_px": (1600, 1600)}, {"warp_px": 2.0}),
    "few8_12": Kind({"gsd_m": (0.36, 0.56), "intersections": (8, 12)}, {}),
    "gone50": Kind(_LOST, {"missing": (0.5, 0.5)}),
    "gone40false40": Kind(_LOST, {"missing": (0.4, 0.4), "false_roads": (0.4, 0.4)}),
    "false60": Kind({}, {"false_roads": (0.6, 0.6)}),
    "tilt50_60": Kind({"tilt_deg": (50.0, 60.0)}, {}),
    "warp6": Kind({}, {"warp_px": 6.0}),
    "lens": Kind({}, {}, lens_k1=-0.08),
    "stale40": Kind(_LOST, {"outdated": (0.4, 0.4)}),
    "void_half": Kind({}, {}, half_black=True),
}
#: Kinds that are also mirrored, and looked for in the next city.
NEGATIVE = ("base", "few8_12", "frame512", "gone50")
ABSENT = ("turned over", "elsewhere")


# --- masks ------------------------------------------------------------------------------------------------------------


def city_roads(name: str) -> Any:
    """Read the road lines of a city: a file, or one of the atlas, or one of the extracts that the tests have."""
    import geopandas as gpd
    import pyogrio

    atlas = Path(os.environ.get("ROADGEO_DATA", "")) / "atlas" / "roads_packed_plane.parquet"
    small = HERE / "tests" / "data" / "accept" / f"{name}.parquet"
    if Path(name).is_file() and Path(name).suffix != ".parquet":
        layers = [str(layer) for layer, _ in pyogrio.list_layers(name)]
        roads = gpd.read_file(name, layer="roads" if "roads" in layers else layers[0])
    elif Path(name).is_file():
        roads = gpd.read_parquet(name)
    elif os.environ.get("ROADGEO_DATA") and atlas.is_file():
        roads = gpd.read_parquet(atlas, filters=[("city", "==", name)])
    elif small.is_file():
        roads = gpd.read_parquet(small)
    else:
        raise SystemExit(f"Error: no roads of {name}: set ROADGEO_DATA, or name one of {', '.join(small_cities())}")
    if len(roads) == 0:
        raise SystemExit(f"Error: the atlas has no city {name}")
    if not roads.crs.is_projected:
        roads = roads.to_crs(roads.estimate_utm_crs())
    x, y = np.median(roads.geometry.get_coordinates().to_numpy(), axis=0)
    reach = SIDE_M / 2
    return roads.cx[x - reach : x + reach, y - reach : y + reach]


def small_cities() -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in (HERE / "tests" / "data" / "accept").glob("*.parquet")))


@dataclass(frozen=True)
class Asked:
    """The k-th mask of a kind to be looked for in a city; `how` it has no place, drawn from which city."""

    city: str
    source: str
    kind: str
    how: str
    k: int

    @property
    def name(self) -> str:
        """Path of the mask in the folder, without its suffix; it changes with whatever the mask depends on."""
        where = f"_{self.how.replace(' ', '_')}" if self.how else ""
        return f"{self.city}/{self.kind}{where}{'_' + self.source if self.source != self.city else ''}_{self.k:03d}"


def ask(cities: Sequence[str], kinds: Sequence[str], count: int) -> list[Asked]:
    """List the masks of a run: of each kind, then those without a place."""
    asked = []
    for city, other in zip(cities, [*cities[1:], cities[0]], strict=True):
        asked += [Asked(city, city, kind, "", k) for kind in kinds for k in range(count)]
        for how, source in (("turned over", city), ("elsewhere", other)):
            if how == "elsewhere" and other == city:
                continue
            asked += [Asked(city, source, kind, how, k) for kind in NEGATIVE if kind in kinds for k in range(count)]
    return asked


def draw_masks(folder: Path, asked: Sequence[Asked]) -> list[Asked]:
    """Draw the masks that no earlier run has drawn; return those for which there is a place."""
    from roadgeo.evaluation.landscape import Landscape
    from roadgeo.sources.roads import read_roads

    landscapes: dict[str, Landscape] = {}
    for entry in asked:
        path = folder / f"{entry.name}.json"
        if path.is_file():
            continue
        path.parent.mkdir(exist_ok=True)
        if entry.source not in landscapes:
            roads = read_roads(folder / f"{entry.source}.parquet")
            landscapes[entry.source] = Landscape.from_lines(roads.lines, roads.plane)
        record = draw(landscapes[entry.source], path.with_suffix(".png"), entry.kind, entry.how, entry.k)
        path.write_text(json.dumps(record), encoding="utf-8")
    drawn = [query for query in asked if (folder / f"{query.name}.png").is_file()]
    for entry in sorted(set(asked) - set(drawn), key=lambda item: item.name):
        tell(f"{entry.name}: no place for such a mask")
    return drawn


def options_of(kind: str, how: str = "", seed: int = SEED) -> Any:
    """Return the options of `simulate_query` for masks of a kind."""
    from roadgeo.evaluation.noise import NoiseModel
    from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions

    view = ViewOptions(
        (1500, 1500), gsd_m=(0.8, 1.25), tilt_deg=(0.0, 20.0), heading_deg=(0.0, 360.0), focal_px=1500.0,
        intersections=(25, 1_000_000), road_width_m=(8.0, 10.0),
    )  # fmt: skip
    noise = NoiseModel((0.08, 0.12), (0.03, 0.05), warp_px=0.8, raggedness=0.12)
    view, noise = replace(view, **KINDS[kind].view), replace(noise, **KINDS[kind].noise)
    return SimulationOptions(view, noise, kind + how, seed, how == "turned over")


def draw(landscape: Any, path: Path, kind: str, how: str, k: int) -> dict[str, Any] | None:
    """Draw one mask and write it; return its truth, or None where the city has no such place."""
    from roadgeo.errors import RoadSourceError
    from roadgeo.evaluation.simulation import simulate_query
    from roadgeo.evaluation.truth import truth_to_record

    chosen = KINDS[kind]
    try:
        query = simulate_query(landscape, options_of(kind, how), k)
    except RoadSourceError:
        return None
    mask = query.mask
    if chosen.lens_k1:
        mask = bend(mask, chosen.lens_k1)
    if chosen.half_black:
        angle = np.random.default_rng([SEED, k]).uniform(0.0, 2 * np.pi)
        y, x = np.mgrid[: mask.shape[0], : mask.shape[1]] - np.reshape(mask.shape, (2, 1, 1)) / 2
        mask = np.where(x * math.cos(angle) + y * math.sin(angle) > 0, np.uint8(0), mask)
    cv2.imwrite(str(path), mask, [cv2.IMWRITE_PNG_BILEVEL, 1])
    return truth_to_record(replace(query.truth, file=path.name, kind=how or kind, on_map=not how))


def bend(mask: Any, k1: float) -> Any:
    """See a mask through a lens that moves a pixel at r, in halves of the longer side, to r (1 + k1 r^2)."""
    height, width = mask.shape
    half = max(height, width) / 2
    row, column = np.mgrid[:height, :width] + 0.5
    x, y = (column - width / 2) / half, (row - height / 2) / half
    bent = np.hypot(x, y)
    plain = bent.copy()
    for _ in range(50):  # ground beyond the frame stays black
        plain = np.minimum(bent / np.maximum(1.0 + k1 * plain**2, 0.5), 3.0)
    scale = half * plain / np.maximum(bent, 1e-9)
    sources = [(width / 2 + scale * x - 0.5).astype(np.float32), (height / 2 + scale * y - 0.5).astype(np.float32)]
    seen = cv2.remap(mask, sources[0], sources[1], cv2.INTER_LINEAR)
    return np.where(np.asarray(seen) > 127, np.uint8(255), np.uint8(0))


# --- locating, in processes of their own ------------------------------------------------------------------------------


def locate_all(folder: Path, city: str, record: Path) -> None:
    """Locate the masks of a city with the checkout that is imported, through its public interface."""
    import roadgeo

    cv2.setNumThreads(1)
    masks = _unanswered(folder, city, record)
    reference = roadgeo.index(folder / f"{city}.parquet")
    roadgeo.locate(folder / f"{masks[0]}.png", reference)  # loading counts for no mask
    with record.open("a", encoding="utf-8") as file:
        for name in masks:
            started = time.process_time()
            try:
                answer = roadgeo.locate(folder / f"{name}.png", reference).to_dict()
            except roadgeo.RoadgeoError as error:
                answer = {"status": "not_located", "reason": str(error)}
            except Exception as error:  # an engine in the making: counted and reported
                answer = {"status": "error", "reason": f"{type(error).__name__}: {error}"}
            answer["cpu_s"] = time.process_time() - started
            file.write(json.dumps({"mask": name, "answer": answer}) + "\n")
            file.flush()


def _unanswered(folder: Path, city: str, record: Path) -> list[str]:
    """List the masks of a city that `record` holds no answer to."""
    done = read_answers(record)
    return [name for name in json.loads((folder / f"{city}.masks").read_text(encoding="utf-8")) if name not in done]


def read_answers(record: Path) -> dict[str, Any]:
    """Read the answers of a file, by mask; a line that was cut off is left out."""
    found: dict[str, Any] = {}
    for line in record.read_text(encoding="utf-8").splitlines() if record.is_file() else ():
        if line.endswith("}"):
            entry = json.loads(line)
            found[entry["mask"]] = entry["answer"]
    return found


def git(folder: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, check=True).stdout.strip()


def checkout(what: str, folder: Path) -> tuple[Path, str]:
    """Return where a checkout lies, unpacked if `what` is a commit, and a name that changes with its code."""
    if Path(what).is_dir():
        path = Path(what).resolve()
        digest = hashlib.sha256()
        for source in sorted((path / "roadgeo").rglob("*.py")):
            digest.update(source.read_bytes())
        return path, f"{path.name}_{digest.hexdigest()[:10]}"
    try:
        sha = git(HERE, "rev-parse", "--short=10", f"{what}^{{commit}}")
    except subprocess.CalledProcessError as error:
        raise SystemExit(f"Error: {what} is neither a folder nor a commit of {HERE}") from error
    path = folder / "checkouts" / sha
    if not (path / "roadgeo").is_dir():
        path.mkdir(parents=True, exist_ok=True)
        archive = subprocess.run(["git", "-C", str(HERE), "archive", sha, "roadgeo"], capture_output=True, check=True)
        subprocess.run(["tar", "-x", "-C", str(path)], input=archive.stdout, check=True)
    return path, sha


def locate_in_processes(
    checkouts: Sequence[tuple[Path, str]], folder: Path, cities: Sequence[str], jobs: int
) -> dict[str, dict[str, Any]]:
    """Have each checkout locate the masks of each city; return the answers by checkout, then by mask."""

    def run(city: str, place: Path, name: str) -> None:
        record = folder / f"answers_{name}_{city}.jsonl"
        if not _unanswered(folder, city, record):
            return
        command = [sys.executable, str(HERE / "examples" / "bench.py"), "--worker", city, str(record)]
        environment = os.environ | {"PYTHONPATH": str(place)}
        subprocess.run([*command, "--out", str(folder)], env=environment, check=True, cwd=folder)
        tell(f"{city}: located by {name}")

    with ThreadPoolExecutor(jobs) as pool:
        for future in [pool.submit(run, city, *checkout) for city in cities for checkout in checkouts]:
            future.result()
    return {
        name: {
            mask: answer
            for city in cities
            for mask, answer in read_answers(folder / f"answers_{name}_{city}.jsonl").items()
        }
        for _, name in checkouts
    }


# --- the table --------------------------------------------------------------------------------------------------------


def read_scores(folder: Path, asked: Sequence[Asked], answers: dict[str, Any]) -> dict[str, tuple[Any, float]]:
    """Score the answers to the masks of this run: a score and the processor seconds of each."""
    from roadgeo.evaluation.scoring import score
    from roadgeo.evaluation.truth import truth_from_record

    scores = {}
    for query in asked:
        truth = truth_from_record(json.loads((folder / f"{query.name}.json").read_text(encoding="utf-8")))
        answer = answers[query.name]
        radius = max(20.0, 0.02 * truth.properties["gsd_m"] * max(truth.size))
        scores[query.name] = (score(truth, answer, radius), answer["cpu_s"])
    return scores


def summarize(scores: Sequence[tuple[Any, float]]) -> dict[str, Any]:
    """Count some masks: plain numbers, for the table and for JSON."""
    found = [item for item, _ in scores]
    right = [result for result in found if result.right]
    errors = np.array([result.corners_rms_m for result in right])
    claims = np.array([math.sqrt(np.mean(np.square(result.sigma_m))) for result in right])
    odds = [result.log10_odds for result in found if math.isfinite(result.log10_odds)]
    spent = [seconds for _, seconds in scores]
    refused = [seconds for item, seconds in scores if not item.located]
    return {
        "masks": len(found),
        "right": len(right),
        "wrong": sum(result.located and not result.right for result in found),
        "errors": sum(result.status == "error" for result in found),
        "corners_m": _quantiles(errors, 0.5, 0.9),
        "error_over_claim": [*_quantiles(errors / claims, 0.5), _rms(errors / claims)],
        "highest_odds": max(odds, default=None),
        "cpu_s": [*_quantiles(spent, 0.5), *_mean(spent)],
        "refused_cpu_s": [*_quantiles(refused, 0.5), *_mean(refused)],
    }


def _quantiles(values: Any, *shares: float) -> list[float]:
    return [float(np.quantile(values, share)) if len(values) else math.nan for share in shares]


def _mean(values: Sequence[float]) -> list[float]:
    return [float(np.mean(values)) if values else math.nan]


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def _plain(value: Any) -> Any:
    """Plain values for JSON, which has no NaN."""
    if isinstance(value, dict):
        return {name: _plain(some) for name, some in value.items()}
    if isinstance(value, list):
        return [_plain(some) for some in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _show(values: Sequence[float]) -> str:
    return " / ".join("-" if math.isnan(value) else f"{value:.2f}" for value in values)


PRESENT: dict[str, Callable[[dict[str, Any]], str]] = {
    "recall": lambda s: f"{s['right'] / max(s['masks'], 1):.3f}",
    "wrong": lambda s: str(s["wrong"]),
    "corners m": lambda s: _show(s["corners_m"]),
    "error / claim": lambda s: _show(s["error_over_claim"]),
    "s a mask": lambda s: _show(s["cpu_s"]),
    "s a refusal": lambda s: _show(s["refused_cpu_s"]),
}
MISSING: dict[str, Callable[[dict[str, Any]], str]] = {
    "located": lambda s: str(s["wrong"]),
    "highest log10 odds": lambda s: "-" if s["highest_odds"] is None else f"{s['highest_odds']:.1f}",
    "s a mask": PRESENT["s a mask"],
}


def tabulate(
    runs: Sequence[dict[str, Any]], groups: Sequence[str], columns: dict[str, Any], head: str
) -> Iterator[str]:
    """Lay out the groups of masks: in each cell one value for each checkout."""
    rows = [[head, "masks", *columns]]
    for group in groups:
        cells = ["  |  ".join(show(run[group]) for run in runs) for show in columns.values()]
        rows.append([group, str(runs[0][group]["masks"]), *cells])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def compare(names: Sequence[str], scores: Sequence[dict[str, Any]], answers: Sequence[dict[str, Any]]) -> Iterator[str]:
    """List the masks that two checkouts answer differently."""
    item, other = scores
    for first, second, name in ((item, other, names[0]), (other, item, names[1])):
        only = [mask for mask in first if first[mask][0].right and not second[mask][0].right]
        yield f"right with {name} only: {len(only)}  {' '.join(only)}".rstrip()
    plain = [{k: _untimed(v) for k, v in some.items()} for some in answers]
    same = sum(plain[0][mask] == plain[1][mask] for mask in item)
    yield f"the same to the last bit, times aside: {same} of {len(item)}"


def _untimed(answer: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in answer.items() if key not in {"seconds", "cpu_s", "query", "version"}}


def report(names: Sequence[str], scores: Sequence[dict[str, Any]], answers: Sequence[Any]) -> tuple[str, Any]:
    """Write the tables and their data."""
    runs = []
    for item in scores:
        found = list(item.values())
        kinds = list(dict.fromkeys(score.kind for score, _ in found))
        groups = {kind: [entry for entry in found if entry[0].kind == kind] for kind in kinds}
        groups["all"] = [entry for entry in found if entry[0].on_map]
        runs.append({kind: summarize(members) for kind, members in groups.items()})
    order = [kind for kind in (*KINDS, "all") if kind in runs[0]]
    absent = [kind for kind in ABSENT if kind in runs[0]]
    lines = [f"{'  |  '.join(names)}", "", *tabulate(runs, order, PRESENT, "with a place")]
    lines += ["", *tabulate(runs, absent, MISSING, "without a place")] if absent else []
    for name, item in zip(names, scores, strict=True):
        bad = [f"{mask} (10^{s.log10_odds:.1f})" for mask, (s, _) in item.items() if s.located and not s.right]
        broken = [f"{mask} ({s.reason})" for mask, (s, _) in item.items() if s.status == "error"]
        lines += ["", f"wrong with {name}: {', '.join(bad) or 'none'}"]
        lines += [f"errors with {name}: {', '.join(broken)}"] if broken else []
    lines += ["", *compare(names, scores, answers)] if len(names) == 2 else []
    return "\n".join(lines), dict(zip(names, runs, strict=True))


# --- all together -----------------------------------------------------------------------------------------------------


def tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    text = __doc__.split("\n\n", 1)
    parser = argparse.ArgumentParser(
        description=text[0], epilog=text[1], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", metavar="COMMIT", help="another commit, or the folder of a checkout")
    parser.add_argument("--long", action="store_true", help="twelve cities, forty masks of each kind: a night")
    parser.add_argument(
        "--cities", nargs="+", metavar="CITY", help="others than the fixed ones: names, or files of road lines"
    )
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND")
    parser.add_argument("-n", "--count", type=int, help=f"masks of each kind and city ({COUNT}; long: {LONG_COUNT})")
    parser.add_argument("-j", "--jobs", type=int, default=2, help="processes (2)")
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "roadgeo-bench")
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    folder = options.out.resolve()
    if options.worker:
        locate_all(folder, options.worker[0], Path(options.worker[1]))
        return
    folder.mkdir(parents=True, exist_ok=True)
    usual = LONG if options.long else CITIES
    given = options.cities or (usual if os.environ.get("ROADGEO_DATA") else small_cities())
    cities = [Path(city).stem for city in given]
    count = options.count or (LONG_COUNT if options.long else COUNT)
    for city, source in zip(cities, given, strict=True):
        if not (folder / f"{city}.parquet").is_file():
            city_roads(source).to_parquet(folder / f"{city}.parquet")
    asked = draw_masks(folder, ask(cities, options.kinds, count))
    tell(f"{len(asked)} masks are drawn")
    for city in cities:
        names = [query.name for query in asked if query.city == city]
        (folder / f"{city}.masks").write_text(json.dumps(names), encoding="utf-8")
    checkouts = [checkout(what, folder) for what in (str(HERE), options.against) if what]
    if len({name for _, name in checkouts}) < len(checkouts):
        raise SystemExit(f"Error: {options.against} is this checkout; give another commit or folder")
    located = locate_in_processes(checkouts, folder, cities, options.jobs)
    names, answers = [name for _, name in checkouts], list(located.values())
    scores = [read_scores(folder, asked, some) for some in answers]
    text, numbers = report(names, scores, answers)
    print(text)
    (folder / "bench.txt").write_text(text + "\n", encoding="utf-8")
    (folder / "bench.json").write_text(json.dumps(_plain(numbers), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
