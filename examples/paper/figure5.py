"""Figure 5: precision, and recall, over the number of intersections N_r, for two scene sizes; clean masks."""

from __future__ import annotations

from typing import Any

import experiments as paper

SCENES_M = (1000.0, 1500.0)
N_R = (10, 20, 30, 40, 60)


def run(setting: paper.Setting) -> None:
    """Run the experiment."""
    points = []
    for scene in SCENES_M:
        queries = setting.masks(scene, "clean", max(N_R))
        for method in ("pair", "auto"):
            for n_r in N_R:
                locator = paper.FewLocator(setting.area, setting.options(method), n_r)
                _, found = paper.trials(queries, locator, setting.jobs, f"{method}, scene {scene:g} m, N_r {n_r}")
                points.append({"method": method, "scene_m": scene, "n_r": n_r, **paper.point(found)})
    paper.save(setting, "figure5", {"points": points})
    draw(setting, points)


def draw(setting: paper.Setting, results: list[dict[str, Any]]) -> None:
    """Plot precision and recall over N_r."""
    figure, panels = paper.axes(1, 2, sharey=True)
    for ax, share in zip(panels, ("precision", "recall"), strict=True):
        for method in dict.fromkeys(p["method"] for p in results):
            for scene in SCENES_M:
                points = [p for p in results if p["method"] == method and p["scene_m"] == scene]
                style = {"color": paper.COLORS[method], "ls": "--" if scene == SCENES_M[0] else "-"}
                label = f"{method}, {scene / 1000:g} km"
                paper.plot_share(ax, [p["n_r"] for p in points], [p[share] for p in points], label, **style)
        ax.set(xlabel="number of intersections $N_r$", ylabel=share, title=f"{setting.area.stem}: {share}")
    panels[0].axhline(0.9, color="grey", lw=1, ls=":")
    panels[0].axvline(30, color="grey", lw=1, ls=":")
    panels[1].legend()
    figure.savefig(setting.out / "figure5.png", dpi=110)
