"""Figure 6: precision and recall over the inlier-ratio threshold; and, for `auto`, over the threshold of its score.

Scenes of 1.5 x 1.5 km with 30 intersections or more, masks with a segmenter's errors. The paper's search ends at the
first hypothesis above the threshold, so `pair` runs anew for each; `auto` runs once, and its answers are cut at each
threshold.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import experiments as paper

from roadgeo.evaluation.scoring import evaluate
from roadgeo.evaluation.trials import ReferenceLocator

RATIOS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8)
SCORES = (-2.0, 0.0, 1.0, 2.0, 3.0, 3.5, 4.0, 6.0, 8.0, 16.0, 32.0)


def run(setting: paper.Setting) -> None:
    """Run the experiment."""
    queries = setting.masks(1500.0, "segmented")
    results: dict[str, list[dict[str, Any]]] = {"pair": [], "auto": []}
    for ratio in RATIOS:
        locator = setting.locator("pair", delta_inlier=ratio)
        _, found = paper.trials(queries, locator, setting.jobs, f"pair, inlier ratio {ratio:g}")
        results["pair"].append({"threshold": ratio, **paper.point(found)})
    anything = replace(setting.options("auto"), min_log10_odds=min(SCORES))
    done, _ = paper.trials(queries, ReferenceLocator((setting.area,), anything), setting.jobs, "auto, any score")
    for score in SCORES:
        cut = [
            t.answer if (t.answer.get("log10_odds") or -99) >= score else {**t.answer, "status": "not_located"}
            for t in done
        ]
        results["auto"].append({"threshold": score, **paper.point(evaluate([t.truth for t in done], cut))})
    paper.save(setting, "figure6", {"points": results})
    draw(setting, results)


def draw(setting: paper.Setting, results: dict[str, list[dict[str, Any]]]) -> None:
    """Plot precision and recall over the thresholds."""
    figure, panels = paper.axes(1, len(results), squeeze=False)
    labels = {"pair": "inlier-ratio threshold", "auto": "threshold of the score"}
    for ax, (method, points) in zip(panels[0], results.items(), strict=True):
        for share, color in (("precision", "C0"), ("recall", "C1")):
            paper.plot_share(ax, [p["threshold"] for p in points], [p[share] for p in points], share, color=color)
        ax.set(xlabel=labels[method], title=f"{setting.area.stem}, {method}")
        ax.legend()
    figure.savefig(setting.out / "figure6.png", dpi=110)
