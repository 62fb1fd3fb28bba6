"""Measure the probability maps of held-out photographs that train.py wrote; needs roadgeo, not PyTorch.

    python score.py DATA runs/maps_1m [--threshold 0.4] [--roads roads_from_labels.parquet --work scored]

Per tile: IoU; F1 with 3 px of tolerance (Mnih's relaxed precision and recall); intersections of the true mask that
the predicted one keeps, and their precision, within 10 m: both as roadgeo sees them. Without --threshold each fold is
cut at the threshold that keeps the intersections of the other folds best (F1). With --roads the masks are located too.
With maps of one fold only, give --threshold: there is nothing else to choose it on.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import geopandas
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

THRESHOLDS = (0.2, 0.3, 0.4, 0.5, 0.6)
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Map:
    """A predicted and a true mask of a tile, at `scale` metres per pixel. Dimensions: H rows, W columns."""

    name: str
    fold: int
    scale: float
    road: NDArray[np.uint8]  # (H, W) probability, 0..255
    truth: Flags  # (H, W)
    observed: Flags  # (H, W)


def main() -> None:
    options = _parse()
    maps = read_maps(options.data, options.maps, options.folds)
    with tempfile.TemporaryDirectory() as folder:
        work = options.work or Path(folder)
        truths = find_intersections({m.name: (m.truth, m.observed) for m in maps}, work / "truth")
        found = {t: _cut_and_trace(maps, t, work) for t in ([options.threshold] if options.threshold else THRESHOLDS)}
        kept = {t: {m.name: count_kept(truths[m.name], found[t][m.name], m.scale) for m in maps} for t in found}
        chosen = {m.name: _choose(m.fold, maps, kept) for m in maps}
        _print_table(maps, kept, chosen)
        if options.roads:
            locate_all(maps, chosen, options, work)


def read_maps(data: Path, folder: Path, folds: int) -> list[Map]:
    """Read every TILE.png of the folder, and the truth of that tile in pixels of the same size."""
    names = sorted(p.stem for p in (data / "images").iterdir())
    maps = []
    for path in sorted(folder.glob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(data / "masks" / path.name), cv2.IMREAD_GRAYSCALE)
        h, w = image.shape[:2]
        truth = cv2.resize(mask, (w, h), interpolation=cv2.INTER_AREA if w < mask.shape[1] else cv2.INTER_LINEAR) > 127
        maps.append(
            Map(path.stem, names.index(path.stem) % folds, mask.shape[1] / w, image[..., 0], truth, image[..., 3] > 127)
        )
    return maps


def pixel_scores(m: Map, threshold: float, tolerance: float = 3) -> dict[str, float]:
    """Return the areas that IoU and relaxed precision and recall are quotients of; tolerance in pixels."""
    predicted, truth = (m.road > 255 * threshold) & m.observed, m.truth & m.observed
    size = 2 * int(tolerance) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    near_truth, near_predicted = (cv2.dilate(x.astype(np.uint8), disc).astype(bool) for x in (truth, predicted))
    return {
        "both": (predicted & truth).sum(),
        "either": (predicted | truth).sum(),
        "right": (predicted & near_truth).sum(),
        "predicted": predicted.sum(),
        "kept": (truth & near_predicted).sum(),
        "true": truth.sum(),
    }


def find_intersections(masks: dict[str, tuple[Flags, Flags]], folder: Path) -> dict[str, NDArray[np.float64]]:
    """Return the intersections, (N, 2) in pixels, that `roadgeo vectorize` sees in each mask."""
    write_masks(masks, folder)
    subprocess.run([*ROADGEO, "vectorize", "-o", str(folder / "seen"), str(folder)], check=False, capture_output=True)
    found = {}
    for name in masks:
        path = folder / "seen" / f"{name}_vectorized.gpkg"
        points = geopandas.read_file(path, layer="intersections").geometry if path.exists() else []
        found[name] = np.array([[p.x, p.y] for p in points], float).reshape(-1, 2)
    return found


def write_masks(masks: dict[str, tuple[Flags, Flags]], folder: Path) -> None:
    """Write each mask as grey with alpha 0 where nothing was observed."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (road, observed) in masks.items():
        grey, alpha = np.uint8(255) * (road & observed), np.uint8(255) * observed
        cv2.imwrite(str(folder / f"{name}.png"), np.dstack([grey, grey, grey, alpha]))


def count_kept(
    truth: NDArray[np.float64], found: NDArray[np.float64], scale: float, reach_m: float = 10
) -> NDArray[np.int64]:
    """Return (true kept, true, found right, found): within `reach_m` of one of the other set."""
    if not len(truth) or not len(found):
        return np.array([0, len(truth), 0, len(found)])
    near = np.linalg.norm(truth[:, None] - found[None], axis=2) * scale <= reach_m
    return np.array([near.any(1).sum(), len(truth), near.any(0).sum(), len(found)])


def locate_all(maps: list[Map], chosen: dict[str, float], options: argparse.Namespace, work: Path) -> None:
    """Locate the predicted and the true masks on the map, and print how many lie within 5 m of their place."""
    reference = work / "roads.gpkg"
    if not reference.exists():
        subprocess.run([*ROADGEO, "index", "--roads", str(options.roads), "--out", str(reference), "-q"], check=True)
    places = read_places(options.data, reference)
    kinds = {
        "true masks": {m.name: (m.truth, m.observed) for m in maps},
        "predicted masks": {m.name: (m.road > 255 * chosen[m.name], m.observed) for m in maps},
    }
    for kind, masks in kinds.items():
        folder = work / kind.replace(" ", "_")
        write_masks(masks, folder)
        command = [*ROADGEO, "locate", str(folder), "-r", str(reference), "--json", "-q", "-o", str(folder / "located")]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        located, wrong = judge([json.loads(line) for line in done.stdout.splitlines()], places)
        print(f"{kind}: {len(located)} of {len(masks)} located within 5 m, {len(wrong)} wrongly {wrong}")
        print(" ", *located)


def judge(results: list[dict], places: dict[str, tuple[float, float]]) -> tuple[list[str], list[str]]:
    """Return the tiles located within 5 m of their place, and those located elsewhere."""
    located: list[str] = []
    wrong: list[str] = []
    for result in results:
        name = Path(result["query"]).stem
        if result["status"] == "located":
            x, y = places[name]
            error = np.hypot(result["center"]["x"] - x, result["center"]["y"] - y)
            (located if error <= 5 else wrong).append(name)
    return located, wrong


ROADGEO = [sys.executable, "-m", "roadgeo"]


def read_places(data: Path, reference: Path) -> dict[str, tuple[float, float]]:
    crs = geopandas.read_file(reference, layer="roads", rows=1).crs
    to_map = Transformer.from_crs(26986, crs, always_xy=True)
    with (data / "tiles.csv").open() as lines:
        return {
            row["tile"]: to_map.transform(float(row["easting"]), float(row["northing"]))
            for row in csv.DictReader(lines)
        }


def _cut_and_trace(maps: list[Map], threshold: float, work: Path) -> dict[str, NDArray[np.float64]]:
    return find_intersections(
        {m.name: (m.road > 255 * threshold, m.observed) for m in maps}, work / f"at_{threshold:g}"
    )


def _choose(fold: int, maps: list[Map], kept: dict[float, dict[str, NDArray[np.int64]]]) -> float:
    """Return the threshold that is best on the tiles of the other folds."""
    others = [m.name for m in maps if m.fold != fold]
    if not others and len(kept) > 1:
        raise SystemExit("the maps are of one fold: give --threshold")
    others = others or [m.name for m in maps]
    return max(kept, key=lambda t: _f1(*_rates(sum(kept[t][name] for name in others))))


def _rates(counts: NDArray[np.int64]) -> tuple[float, float]:
    """Return recall and precision; NaN where there is nothing to keep or to be right."""
    kept, true, right, found = counts
    return kept / true if true else np.nan, right / found if found else np.nan


def _f1(recall: float, precision: float) -> float:
    return 2 * recall * precision / (recall + precision) if recall + precision else 0.0


def _print_table(maps: list[Map], kept: dict[float, dict[str, NDArray[np.int64]]], chosen: dict[str, float]) -> None:
    print("| tile | fold | threshold | IoU | F1, 3 px | intersections | recall | precision |")
    print("|---|---|---|---|---|---|---|---|")
    sums, counts = None, np.zeros(4, int)
    for m in maps:
        scores, mine = pixel_scores(m, chosen[m.name]), kept[chosen[m.name]][m.name]
        sums = scores if sums is None else {key: sums[key] + scores[key] for key in sums}
        counts += mine
        print(f"| {m.name} | {m.fold} | {chosen[m.name]:g} | {_row(scores, mine)} |")
    print(f"| all {len(maps)} | | | {_row(sums, counts)} |")
    for threshold, tiles in kept.items():
        totals = [pixel_scores(m, threshold) for m in maps]
        print(f"at {threshold:g}: {_row({k: sum(t[k] for t in totals) for k in totals[0]}, sum(tiles.values()))}")


def _row(scores: dict[str, float], counts: NDArray[np.int64]) -> str:
    """Return IoU, relaxed F1, number of true intersections, their recall and precision as cells of a table."""
    iou = scores["both"] / scores["either"] if scores["either"] else np.nan
    recall = scores["kept"] / scores["true"] if scores["true"] else np.nan
    precision = scores["right"] / scores["predicted"] if scores["predicted"] else np.nan
    kept, right = _rates(counts)
    return f"{iou:.3f} | {_f1(recall, precision):.3f} | {counts[1]} | {kept:.2f} | {right:.2f}"


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("maps", type=Path, help="a folder of maps that train.py wrote")
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--threshold", type=float, help="of all tiles; default: chosen on other folds")
    parser.add_argument("--roads", type=Path, help="roads of the tiles' region: also locate the masks on them")
    parser.add_argument("--work", type=Path, help="folder to keep masks and results in")
    return parser.parse_args()


if __name__ == "__main__":
    main()
