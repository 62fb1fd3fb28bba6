"""Figure 6: precision and recall over the inlier-ratio threshold; and, for `auto`, over the threshold of its odds.

    python examples/paper/figure6.py boston-ma --out results

Scenes of 1.5 x 1.5 km with 30 intersections or more. The paper's search ends at the first hypothesis above the
threshold, so `pair` runs anew for each; `auto` runs once, and its answers are cut at each threshold.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import experiments as paper

from roadgeo.evaluation.scoring import evaluate
from roadgeo.evaluation.trials import DrawnMasks
from roadgeo.workflows import LocateOptions

RATIOS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
ODDS = (-2, 0, 2, 4, 6, 8, 12, 16, 24, 32)


def main() -> None:
    """Run the experiment."""
    parser = paper.arguments(__doc__, queries=50)
    parser.add_argument("--noise", default="segmented", choices=list(paper.NOISE_MODELS))
    options = parser.parse_args()
    area = paper.search_area(options.reference, options.out)
    queries = DrawnMasks(area, ((paper.masks(1500.0, options.noise, options.seed), options.queries),))
    results: dict[str, list[dict[str, Any]]] = {method: [] for method in options.methods}
    if "pair" in options.methods:
        for ratio in RATIOS:
            pair = replace(paper.PAIR, delta_inlier=ratio, time_limit_s=options.time_limit)
            _, found = paper.trials(queries, paper.PairLocator(area, pair), options, f"pair, inlier ratio {ratio:g}")
            results["pair"].append({"threshold": ratio, **paper.point(found)})
    if "auto" in options.methods:
        default = LocateOptions()
        search = replace(default.search, time_limit_s=options.time_limit)
        anything = replace(default, min_log10_odds=min(ODDS), search=search)
        done, _ = paper.trials(queries, paper.AutoLocator(area, anything), options, "auto, any odds")
        for odds in ODDS:
            cut = [
                t.answer if (t.answer.get("log10_odds") or -99) >= odds else {**t.answer, "status": "not_located"}
                for t in done
            ]
            found = evaluate([t.truth for t in done], cut)
            results["auto"].append({"threshold": odds, **paper.point(found)})
    paper.save(options.out, "figure6", {"reference": area.stem, "noise": options.noise, "points": results})
    draw(area.stem, results, options.out)


def draw(area: str, results: dict[str, list[dict[str, Any]]], out: paper.Path) -> None:
    """Plot precision and recall over the thresholds."""
    figure, panels = paper.axes(1, len(results), squeeze=False)
    labels = {"pair": "inlier-ratio threshold", "auto": "threshold of log10 odds"}
    for ax, method in zip(panels[0], results, strict=True):
        for share, color in (("precision", "C0"), ("recall", "C1")):
            points = results[method]
            paper.plot_share(ax, [p["threshold"] for p in points], [p[share] for p in points], share, color=color)
        ax.set(xlabel=labels[method], title=f"{area}, {method}")
        ax.legend()
    figure.savefig(out / "figure6.png", dpi=110)


if __name__ == "__main__":
    main()
