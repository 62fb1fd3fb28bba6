"""Figure 8: run time under different cross-ratio errors, clean masks of scenes of 1.5 x 1.5 km.

As in the paper, times are of the search: tracing the mask is left out. They are counted, in seconds of a usual
machine, so that they do not depend on the load.
"""

from __future__ import annotations

from typing import Any

import experiments as paper
import numpy as np

ERRORS = (0.1, 0.2, 0.3, 0.4)


def run(setting: paper.Setting) -> None:
    """Run the experiment."""
    queries = setting.masks(1500.0, "clean")
    locators = {f"pair, error {error:g}": setting.locator("pair", delta=error) for error in ERRORS}
    results = []
    for name, locator in {**locators, "auto": setting.locator("auto")}.items():
        done, found = paper.trials(queries, locator, setting.jobs, name)
        seconds = np.sort([trial.answer["stats"]["work_ms"] / 1000 for trial in done])
        within = float(np.mean(seconds <= 1.0))
        print(f"  {100 * within:.0f} % within 1 s")
        results.append({"name": name, "within_1_s": within, "seconds": seconds.round(4).tolist(), **paper.point(found)})
    paper.save(setting, "figure8", {"points": results})
    draw(setting, results)


def draw(setting: paper.Setting, results: list[dict[str, Any]]) -> None:
    """Plot the share of masks that were answered within a time."""
    figure, ax = paper.axes(1, 1)
    for point in results:
        seconds = np.array(point["seconds"])
        within, recall = 100 * point["within_1_s"], 100 * point["recall"]["value"]
        label = f"{point['name']}: {within:.0f} % in 1 s, recall {recall:.0f} %"
        ax.step(np.maximum(seconds, 1e-3), np.arange(1, len(seconds) + 1) / len(seconds), label=label, where="post")
    ax.set(xscale="log", xlabel="seconds", ylabel="share of masks", title=f"{setting.area.stem}: time of the search")
    ax.axvline(1.0, color="grey", lw=1, ls=":")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    figure.savefig(setting.out / "figure8.png", dpi=110)
