"""Figure 5: precision over the number of intersections N_r, for two scene sizes.

    python examples/paper/figure5.py boston-ma --out results

`pair` gets N_r intersections of each mask, chosen at random, as in the paper; `auto`, which goes by the roads as well,
gets the middle of the mask that holds N_r of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import experiments as paper

from roadgeo.evaluation.trials import DrawnMasks
from roadgeo.workflows import LocateOptions

SCENES_M = (1000.0, 1500.0)


def main() -> None:
    """Run the experiment."""
    parser = paper.arguments(__doc__, queries=50)
    parser.add_argument("--n-r", type=int, nargs="+", default=[10, 15, 20, 25, 30, 40, 50, 60])
    parser.add_argument("--noise", default="clean", choices=list(paper.NOISE_MODELS))
    options = parser.parse_args()
    area = paper.search_area(options.reference, options.out)
    results = []
    for scene in SCENES_M:
        queries = DrawnMasks(
            area, ((paper.masks(scene, options.noise, options.seed, max(options.n_r)), options.queries),)
        )
        for method in options.methods:
            for n_r in options.n_r:
                name = f"{method}, scene {scene:g} m, N_r {n_r}"
                _, found = paper.trials(queries, locator(method, area, n_r, options.time_limit), options, name)
                results.append({"method": method, "scene_m": scene, "n_r": n_r, **paper.point(found)})
    paper.save(options.out, "figure5", {"reference": area.stem, "noise": options.noise, "points": results})
    draw(area.stem, results, options.out)


def draw(area: str, results: list[dict[str, Any]], out: paper.Path) -> None:
    """Plot precision and recall over N_r."""
    figure, panels = paper.axes(1, 2, sharey=True)
    for ax, share in zip(panels, ("precision", "recall"), strict=True):
        for method in dict.fromkeys(p["method"] for p in results):
            for scene in SCENES_M:
                points = [p for p in results if p["method"] == method and p["scene_m"] == scene]
                color, line = ("C1" if method == "pair" else "C0"), ("--" if scene == SCENES_M[0] else "-")
                label = f"{method}, {scene / 1000:g} km"
                paper.plot_share(
                    ax, [p["n_r"] for p in points], [p[share] for p in points], label, color=color, ls=line
                )
        ax.set(xlabel="number of intersections $N_r$", ylabel=share, title=f"{area}: {share}")
    panels[0].axhline(0.9, color="grey", lw=1, ls=":")
    panels[0].axvline(30, color="grey", lw=1, ls=":")
    panels[1].legend()
    figure.savefig(out / "figure5.png", dpi=110)


def locator(method: str, area: paper.Path, n_r: int, time_limit: float) -> object:
    """The method under test, on N_r intersections."""
    if method == "pair":
        return paper.PairLocator(area, replace(paper.PAIR, time_limit_s=time_limit), n_r)
    default = LocateOptions()
    return paper.AutoLocator(area, replace(default, search=replace(default.search, time_limit_s=time_limit)), n_r)


if __name__ == "__main__":
    main()
