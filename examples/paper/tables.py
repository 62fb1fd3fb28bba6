"""Tables 1 to 3: precision and recall on the Massachusetts Roads Dataset, by the paper's areas of 20 x 20 km.

Label masks are searched on a map of OpenStreetMap; photographs, segmented by the network that ships, on the map drawn
from the dataset's labels. Table 2 has them north up, Table 3 under random perspectives. The dataset: V. Mnih, "Machine
Learning for Aerial Image Labeling", 2013.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import experiments as paper
import numpy as np
from places import draw_places

from roadgeo.evaluation.scoring import evaluate, summarize
from roadgeo.evaluation.trials import ReferenceLocator, Trial
from roadgeo.evaluation.truth import Truth
from roadgeo.geometry.homography import shift
from roadgeo.geometry.pinhole import warp_mask
from roadgeo.running.options import ReadOptions
from roadgeo.running.queries import read_roads
from roadgeo.sources.roads import read_roads as read_map
from roadgeo.workflows import build_reference

#: What the experiment reads, in the dataset's folder.
NEEDED = ("tiles.csv", "masks", "roads_from_labels.parquet", "segmentation/tiles.csv", "segmentation/images")

#: Tables 1 to 3: area, its centre in EPSG:26986, its images, precision and recall in percent, aligned and under
#: perspective.
PAPER = {
    1: (104175.9, 889718.6, 39, 80.2, 70.6, 86.3, 73.8),
    2: (104175.9, 869718.6, 91, 76.9, 68.9, 74.5, 53.9),
    3: (124175.9, 869718.6, 71, 92.3, 68.8, 96.9, 92.8),
    4: (164175.9, 889718.6, 75, 86.7, 67.1, 85.0, 62.3),
    5: (184175.9, 889718.6, 77, 80.0, 69.4, 83.3, 71.5),
    6: (184175.9, 869718.6, 73, 100.0, 88.9, 100.0, 92.9),
    7: (204175.9, 889718.6, 82, 87.5, 74.5, 92.1, 78.8),
    8: (224175.9, 949718.6, 35, 81.3, 68.4, 84.6, 62.4),
    9: (224175.9, 909718.6, 83, 74.6, 54.9, 75.4, 55.9),
    10: (224175.9, 889718.6, 113, 72.6, 58.2, 76.9, 62.6),
    11: (244175.9, 929718.6, 71, 96.3, 65.0, 98.4, 54.0),
    12: (244175.9, 909718.6, 88, 76.9, 61.9, 81.4, 66.3),
    13: (244175.9, 889718.6, 70, 72.7, 57.1, 74.4, 57.8),
    14: (244175.9, 869718.6, 21, 86.7, 50.0, 76.5, 54.2),
    15: (244175.9, 849718.6, 39, 100.0, 70.0, 100.0, 58.2),
    16: (264175.9, 929718.6, 26, 100.0, 100.0, 85.7, 85.7),
    17: (264175.9, 869718.6, 57, 87.5, 70.0, 88.9, 72.7),
}


@dataclass(frozen=True)
class Images:
    """Images of the dataset: label masks, or photographs, which are segmented.

    With `times`, each is seen under as many random perspectives: tilted to 30 degrees, of any heading; void corners
    stay black. Without, north up.
    """

    folder: Path
    truths: tuple[Truth, ...]
    segmented: bool
    times: int = 0
    seed: int = 0

    def __len__(self) -> int:
        """How many queries there are."""
        return max(self.times, 1) * len(self.truths)

    def open(self) -> Callable[[int], tuple[Truth, Any]]:
        """Return the function that gives the k-th query: a mask, or probabilities of road."""
        return self._query

    def _query(self, k: int) -> tuple[Truth, Any]:
        truth, pixels = self.view(k)
        if not self.segmented:
            return truth, np.where(pixels > 127, 255, 0).astype(np.uint8)
        return truth, read_roads(pixels, (1.0, 1.0), ReadOptions(segment="always")).probability

    def view(self, k: int) -> tuple[Truth, Any]:
        """Return where the k-th lies, and its pixels: (H, W), or (H, W, 3) RGB."""
        truth = self.truths[k // max(self.times, 1)]
        pixels = cv2.imread(str(self.folder / truth.file))[..., ::-1]
        pixels = np.ascontiguousarray(pixels if self.segmented else pixels[..., 0])
        return self._warp(k, truth, pixels) if self.times else (truth, pixels)

    def _warp(self, k: int, truth: Truth, pixels: Any) -> tuple[Truth, Any]:
        rng = np.random.default_rng([self.seed, k])
        _, matrix = warp_mask(np.zeros(pixels.shape[:2], np.uint8), rng.uniform(0.0, 30.0), *rng.uniform(0, 360, 2))
        source = shift(-0.5, -0.5) @ matrix @ shift(0.5, 0.5)  # OpenCV counts from pixel centres
        seen = cv2.warpPerspective(pixels, source, truth.size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        lies = truth.homography @ matrix
        return replace(truth, homography=lies / lies[2, 2]), seen


def read_tiles(table: Path, file: str) -> tuple[Truth, ...]:
    """Read where the dataset's tiles lie: north up, 1500 x 1500 pixels of 1 m around a centre in EPSG:26986."""
    return tuple(_truth(row, file) for row in csv.DictReader(table.open(encoding="utf-8")))


def _truth(row: dict[str, str], file: str) -> Truth:
    west, north = float(row["easting"]) - 750.0, float(row["northing"]) + 750.0
    matrix = np.array([[1.0, 0.0, west], [0.0, -1.0, north], [0.0, 0.0, 1.0]])
    on_map = row.get("in_map", "True") == "True"
    return Truth(file.format(row["tile"]), "tile", matrix, "EPSG:26986", (1500, 1500), on_map)


def run(setting: paper.Setting) -> None:
    """Run the experiments."""
    folder, seen = setting.dataset, setting.dataset / "segmentation"
    images = {
        "labels": Images(folder, read_tiles(folder / "tiles.csv", "masks/{}.png"), segmented=False),
        "photographs": Images(seen, read_tiles(seen / "tiles.csv", "images/{}.jpg"), segmented=True),
    }
    maps = {"labels": setting.reference, "photographs": dataset_map(setting)}
    tiles = {name: [Path(truth.file).stem for truth in of.truths if truth.on_map] for name, of in images.items()}
    paper.save(setting, "table1", {"tiles": tiles})
    text = count_images(images)
    for times, table, figure in ((0, "Table 2: north up", "figure9"), (setting.perspectives, "Table 3", "figure10")):
        rows = []
        for name, of in images.items():
            queries = replace(of, times=times, seed=setting.seed)
            masks, answers = paper.keep_masks(queries, setting.work / f"{name}-{times}"), {}
            for method in paper.METHODS:
                locator = ReferenceLocator((maps[name],), setting.options(method))
                answers[method], _ = paper.trials(masks, locator, setting.jobs, f"{table}, {name}, {method}")
                rows += [{"of": name, **row} for row in by_area(method, answers[method])]
            if name == "photographs":
                draw_places(setting.out / f"{figure}.png", queries, masks, answers["pair"], maps[name])
        paper.save(setting, table[:7].lower().replace(" ", ""), {"perspectives": times, "rows": rows})
        title = f"{table}, {times} random perspectives of each" if times else table
        text += f"\n## {title}\n\n{as_markdown(rows, perspective=times > 0)}"
    (setting.out / "tables.md").write_text(text)


def dataset_map(setting: paper.Setting) -> Path:
    """Build the map that the dataset's labels show."""
    target = setting.work / "massachusetts.gpkg"
    if not target.is_file():
        build_reference(read_map(setting.dataset / "roads_from_labels.parquet"), "massachusetts", path=target)
    return target


def count_images(images: dict[str, Images]) -> str:
    """Table 1: how many images of each area there are, beside the paper's."""
    areas = {name: [area_of(truth) for truth in of.truths if truth.on_map] for name, of in images.items()}
    lines = ["## Table 1: images", "", f"| area | center, EPSG:26986 | the paper's | {' | '.join(areas)} |"]
    lines.append("|---" * (3 + len(areas)) + "|")
    for area, (x, y, count, *_) in PAPER.items():
        ours = " | ".join(str(found.count(area)) for found in areas.values())
        lines.append(f"| {area} | {x:.1f}, {y:.1f} | {count} | {ours} |")
    ours = " | ".join(str(found.count(0)) for found in areas.values())
    return "\n".join([*lines, f"| none of them | | | {ours} |", ""])


def by_area(method: str, done: list[Trial]) -> list[dict[str, Any]]:
    """Precision and recall in each area of the paper, of all, and how many masks from elsewhere were refused."""
    found = evaluate([trial.truth for trial in done], [trial.answer for trial in done])
    areas = np.array([area_of(trial.truth) for trial in done])
    rows = []
    for area in [*sorted({int(area) for area in areas if area}), 0]:
        chosen = [s for s, at in zip(found.scores, areas, strict=True) if area in (0, at) and (s.on_map or not area)]
        if not chosen:
            continue
        total = summarize(str(area), chosen)
        shares = {key: getattr(total, key) for key in ("precision", "recall", "refused")}
        rows.append(
            {
                "method": method,
                "area": area or "all",
                "queries": total.recall.of,
                **{key: {"value": s.value if s.of else None, "hits": s.hits, "of": s.of} for key, s in shares.items()},
                "center_m_median": total.center_m.median if total.recall.hits else None,
            }
        )
    return rows


def area_of(truth: Truth) -> int:
    """Number of the paper's subarea that a mask's centre lies in; 0 for none."""
    inside = [n for n, (x, y, *_) in PAPER.items() if np.abs(truth.center - (x, y)).max() <= 10_000]
    return inside[0] if inside else 0


def as_markdown(rows: list[dict[str, Any]], perspective: bool) -> str:
    """Return a table: precision / recall in percent, right places of images in brackets, the paper's figures beside."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = [f"| images | area | the paper's | {' | '.join(methods)} |", "|---" * (3 + len(methods)) + "|"]
    for of, area in dict.fromkeys((row["of"], row["area"]) for row in rows):
        theirs = PAPER.get(area, ())[5 if perspective else 3 :][:2]
        cells = [_cell(row) for row in rows if (row["of"], row["area"]) == (of, area)]
        lines.append(f"| {of} | {area} | {' / '.join(map(str, theirs))} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def _cell(row: dict[str, Any]) -> str:
    shares = [row[key]["value"] for key in ("precision", "recall")]
    figures = " / ".join("-" if share is None else f"{100 * share:.0f}" for share in shares)
    return f"{figures} ({row['recall']['hits']} of {row['recall']['of']})"
