"""Tables 2 and 3: precision and recall on masks of the Massachusetts Roads Dataset, by subarea of 20 x 20 km.

    python examples/paper/tables.py boston-ma --tiles massachusetts/tiles.csv --out results          (Table 2, aligned)
    python examples/paper/tables.py boston-ma --tiles massachusetts/tiles.csv --perspective --out results    (Table 3)

`tiles.csv` has the columns tile, easting, northing (of the centre, EPSG:26986) and in_map; the masks lie beside it in
`masks/TILE.png`. The dataset: V. Mnih, "Machine Learning for Aerial Image Labeling", 2013. Without --tiles, masks are
drawn from the reference itself with the noise of a segmenter. Only subareas on the map show up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import experiments as paper
import numpy as np

from roadgeo.evaluation.scoring import evaluate, summarize
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions
from roadgeo.evaluation.trials import DrawnMasks, MaskFiles, QuerySet, Trial
from roadgeo.evaluation.truth import Truth, read_truth
from roadgeo.geometry.pinhole import warp_mask
from roadgeo.reference.library import resolve_reference
from roadgeo.workflows import LocateOptions

#: Tables 1 to 3: area, its centre in EPSG:26986, and precision and recall in percent, aligned and under perspective.
PAPER = {
    1: (104175.9, 889718.6, 80.2, 70.6, 86.3, 73.8),
    2: (104175.9, 869718.6, 76.9, 68.9, 74.5, 53.9),
    3: (124175.9, 869718.6, 92.3, 68.8, 96.9, 92.8),
    4: (164175.9, 889718.6, 86.7, 67.1, 85.0, 62.3),
    5: (184175.9, 889718.6, 80.0, 69.4, 83.3, 71.5),
    6: (184175.9, 869718.6, 100.0, 88.9, 100.0, 92.9),
    7: (204175.9, 889718.6, 87.5, 74.5, 92.1, 78.8),
    8: (224175.9, 949718.6, 81.3, 68.4, 84.6, 62.4),
    9: (224175.9, 909718.6, 74.6, 54.9, 75.4, 55.9),
    10: (224175.9, 889718.6, 72.6, 58.2, 76.9, 62.6),
    11: (244175.9, 929718.6, 96.3, 65.0, 98.4, 54.0),
    12: (244175.9, 909718.6, 76.9, 61.9, 81.4, 66.3),
    13: (244175.9, 889718.6, 72.7, 57.1, 74.4, 57.8),
    14: (244175.9, 869718.6, 86.7, 50.0, 76.5, 54.2),
    15: (244175.9, 849718.6, 100.0, 70.0, 100.0, 58.2),
    16: (264175.9, 929718.6, 100.0, 100.0, 85.7, 85.7),
    17: (264175.9, 869718.6, 87.5, 70.0, 88.9, 72.7),
}


@dataclass(frozen=True)
class WarpedMasks:
    """Each mask under four random perspectives: tilted to 30 degrees, turned at will; void corners stay black."""

    masks: MaskFiles
    seed: int
    times: int = 4

    def __len__(self) -> int:
        """How many queries there are."""
        return self.times * len(self.masks)

    def open(self) -> Callable[[int], tuple[Truth, Any]]:
        """Return the function that warps the k-th."""
        return self._warp

    def _warp(self, k: int) -> tuple[Truth, Any]:
        truth = self.masks.truths[k // self.times]
        rng = np.random.default_rng([self.seed, k])
        mask = cv2.imread(str(self.masks.folder / truth.file), cv2.IMREAD_GRAYSCALE)
        tilt = rng.uniform(0.0, 30.0)
        warped, matrix = warp_mask(mask, tilt, rng.uniform(0.0, 360.0), rng.uniform(0.0, 360.0))
        matrix = truth.homography @ matrix
        name = f"{truth.file}#{k % self.times}"
        return replace(truth, file=name, homography=matrix / matrix[2, 2], properties={"tilt_deg": tilt}), warped


def main() -> None:
    """Run the experiment."""
    parser = paper.arguments(__doc__)
    parser.add_argument("--tiles", type=Path, help="tiles.csv beside the masks")
    parser.add_argument("--perspective", action="store_true", help="Table 3 instead of 2")
    options = parser.parse_args()
    reference = resolve_reference(options.reference)
    name = "table3" if options.perspective else "table2"
    queries = query_set(reference, options)
    default = LocateOptions()
    search = replace(default.search, time_limit_s=options.time_limit)
    locators = {
        "pair": paper.PairLocator(reference, replace(paper.PAIR, time_limit_s=options.time_limit)),
        "auto": paper.AutoLocator(reference, replace(default, search=search)),
    }
    answers = {method: paper.trials(queries, locators[method], options, method)[0] for method in options.methods}
    rows = [row for method, done in answers.items() for row in by_area(method, done)]
    paper.save(options.out, name, {"reference": reference.stem, "tiles": bool(options.tiles), "rows": rows})
    show(rows, options.perspective)


def query_set(reference: Path, options: Any) -> QuerySet:
    """The dataset's masks, or drawn ones."""
    if options.tiles is None:
        tilt, heading = ((0.0, 30.0), (0.0, 360.0)) if options.perspective else ((0.0, 0.0), (0.0, 0.0))
        view = ViewOptions(tilt_deg=tilt, heading_deg=heading)
        drawn = SimulationOptions(view, paper.NOISE_MODELS["segmented"], "drawn", options.seed)
        return DrawnMasks(reference, ((drawn, options.queries),))
    files = MaskFiles(options.tiles.parent, tuple(read_truth(options.tiles)))
    return WarpedMasks(files, options.seed) if options.perspective else files


def by_area(method: str, done: list[Trial]) -> list[dict[str, Any]]:
    """Precision and recall in each subarea of the paper, of all, and how many masks from elsewhere were refused."""
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
                "compute_s_median": total.compute_s.median,
            }
        )
    return rows


def area_of(truth: Truth) -> int:
    """Number of the paper's subarea that a mask's centre lies in; 0 for none."""
    if truth.crs != "EPSG:26986":
        return 0
    inside = [n for n, (x, y, *_) in PAPER.items() if np.abs(truth.center - (x, y)).max() <= 10_000]
    return inside[0] if inside else 0


def show(rows: list[dict[str, Any]], perspective: bool) -> None:
    """Print a Markdown table with the paper's figures beside ours."""
    print("\n| area | masks | method | precision % | recall % | the paper's | centre m | ms | refused elsewhere |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in sorted(rows, key=lambda r: (r["area"] == "all", r["area"] if r["area"] != "all" else 0, r["method"])):
        theirs = PAPER.get(row["area"])
        beside = "" if theirs is None else "{:g} / {:g}".format(*(theirs[4:6] if perspective else theirs[2:4]))
        cells = [
            "-" if row[key]["value"] is None else f"{100 * row[key]['value']:.1f} ({row[key]['hits']}/{row[key]['of']})"
            for key in ("precision", "recall", "refused")
        ]
        center = "-" if row["center_m_median"] is None else f"{row['center_m_median']:.1f}"
        print(
            f"| {row['area']} | {row['queries']} | {row['method']} | {cells[0]} | {cells[1]} | {beside} | {center} "
            f"| {1000 * row['compute_s_median']:.0f} | {cells[2]} |"
        )


if __name__ == "__main__":
    main()
