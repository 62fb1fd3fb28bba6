"""Figure 8: run time under different cross-ratio errors, scenes of 1.5 x 1.5 km.

    python examples/paper/figure8.py boston-ma --out results

One core. The paper's figure counts the time of its search; so do these (vectorizing the mask is left out).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import experiments as paper
import numpy as np

from roadgeo.evaluation.trials import DrawnMasks, Trial
from roadgeo.workflows import LocateOptions

ERRORS = (0.1, 0.2, 0.3, 0.4)


def main() -> None:
    """Run the experiment."""
    parser = paper.arguments(__doc__, queries=100)
    parser.add_argument("--noise", default="clean", choices=list(paper.NOISE_MODELS))
    options = parser.parse_args()
    area = paper.search_area(options.reference, options.out)
    queries = DrawnMasks(area, ((paper.masks(1500.0, options.noise, options.seed), options.queries),))
    default = LocateOptions()
    locators: dict[str, object] = {}
    if "pair" in options.methods:
        for error in ERRORS:
            pair = replace(paper.PAIR, delta_cross_ratio=error, time_limit_s=options.time_limit)
            locators[f"pair, error {error:g}"] = paper.PairLocator(area, pair)
    if "auto" in options.methods:
        search = replace(default.search, time_limit_s=options.time_limit)
        locators["auto"] = paper.AutoLocator(area, replace(default, search=search))

    results = []
    for name, locator in locators.items():
        done, found = paper.trials(queries, locator, options, name)
        seconds = np.sort([search_seconds(trial) for trial in done])
        within = float(np.mean(seconds <= 1.0))
        print(f"  {100 * within:.0f} % within 1 s")
        results.append({"name": name, "within_1_s": within, "seconds": seconds.round(4).tolist(), **paper.point(found)})
    paper.save(options.out, "figure8", {"reference": area.stem, "noise": options.noise, "points": results})
    draw(area.stem, results, options.out)


def draw(area: str, results: list[dict[str, Any]], out: paper.Path) -> None:
    """Plot the share of masks that were answered within a time."""
    figure, ax = paper.axes(1, 1)
    for point in results:
        seconds = np.array(point["seconds"])
        within, recall = 100 * point["within_1_s"], 100 * point["recall"]["value"]
        label = f"{point['name']}: {within:.0f} % in 1 s, recall {recall:.0f} %"
        ax.step(np.maximum(seconds, 1e-3), np.arange(1, len(seconds) + 1) / len(seconds), label=label, where="post")
    ax.set(xscale="log", xlabel="seconds", ylabel="share of masks", title=f"{area}: time of the search")
    ax.axvline(1.0, color="grey", lw=1, ls=":")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    figure.savefig(out / "figure8.png", dpi=110)


def search_seconds(trial: Trial) -> float:
    """Time of matching and refining."""
    seconds = trial.answer["seconds"]
    return float(seconds.get("match", 0.0) + seconds.get("refine", 0.0))


if __name__ == "__main__":
    main()
