"""Shared by the paper's experiments: settings, search area, masks, methods, and how results are shown.

Li, Yang, Wang, He, "Road-network-based Rapid Geolocalization" (arXiv 1906.12174), section 4.
"""

from __future__ import annotations

import json
import subprocess
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.scoring import Evaluation, evaluate
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions
from roadgeo.evaluation.trials import DrawnMasks, MaskFiles, QuerySet, ReferenceLocator, Trial, run_trials
from roadgeo.evaluation.truth import Truth, read_truth, write_truth
from roadgeo.geometry.mask import RoadMask
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import search_references
from roadgeo.matching.paper import PAPER
from roadgeo.matching.scene import Query, prepare_scene, read_query
from roadgeo.matching.verdict import decide
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.network import RoadNetwork, as_stored
from roadgeo.sources.segmentation.probability import ProbabilityMap
from roadgeo.workflows import LocateOptions, locate

#: Section 4.3: "an area of 10 x 10 km2".
AREA_M = 10_000.0
#: The paper to the letter; the steps of `--method pair`; roadgeo's own.
METHODS = {
    "paper": LocateOptions(method="pair", pair=PAPER),
    "pair": LocateOptions(method="pair"),
    "auto": LocateOptions(),
}
COLORS = {"paper": "C3", "pair": "C1", "auto": "C0"}


@dataclass(frozen=True)
class Setting:
    """The settings that all experiments share.

    Attributes
    ----------
    reference, area : Path
        `REF.gpkg` of the whole map, and of its square of 10 x 10 km with the most intersections.
    dataset : Path
        Folder of the Massachusetts Roads Dataset.
    out, work : Path
        Folders of the results, and of masks and maps, which are kept for another run.
    queries, perspectives : int
        Masks per point; random perspectives of each image of the dataset.
    work_limit_s : float
        Most work for a mask, in seconds of a usual machine: it is counted, so that results do not depend on the load.
    """

    reference: Path
    area: Path
    dataset: Path
    out: Path
    work: Path
    queries: int
    perspectives: int
    seed: int
    jobs: int
    work_limit_s: float

    def options(self, method: str, **pair: Any) -> LocateOptions:
        """Return the options of a method; `pair` sets some of the paper's."""
        options, limits = METHODS[method], {"work_limit_s": self.work_limit_s, "time_limit_s": 3600.0}
        search = replace(options.search, **limits)
        return replace(options, search=search, pair=replace(options.pair, **limits, **pair))

    def locator(self, method: str, **pair: Any) -> ReferenceLocator:
        """Return a method on the search area."""
        return ReferenceLocator((self.area,), self.options(method, **pair))

    def masks(self, scene_m: float, noise: str, least: int = 30) -> MaskFiles:
        """Draw masks of scenes of a side under "random homography transformations", at 1 m per pixel, once."""
        view = ViewOptions(
            window_m=scene_m, tilt_deg=(0.0, 30.0), heading_deg=(0.0, 360.0), intersections=(least, 1_000_000)
        )
        name = f"{self.area.stem}-{scene_m:g}m-{noise}-{least}-{self.seed}"
        drawn = SimulationOptions(view, NOISE_MODELS[noise], name, self.seed)
        return keep_masks(DrawnMasks(self.area, ((drawn, self.queries),)), self.work / name)


# --- the search area and the masks ------------------------------------------------------------------------------------


def cut_area(source: Path, work: Path, side_m: float = AREA_M) -> Path:
    """Cut the square of this side with the most intersections out of a reference, as a reference of its own."""
    target = work / f"{source.stem}-{side_m / 1000:g}km.gpkg"
    if not target.is_file():
        network = as_stored(cut_network(read_network(source), side_m))
        Reference(build_index(network), network).save(target)
    return target


def cut_network(network: RoadNetwork, side_m: float, step_m: float = 500.0) -> RoadNetwork:
    """Keep the edges that lie in the densest square of a network."""
    xy = network.intersections.xy
    low = xy.min(axis=0)
    spans = np.maximum((np.ptp(xy, axis=0) - side_m) // step_m, 0).astype(int) + 1
    corners = [low + np.array([i, j]) * step_m for i, j in np.ndindex(*spans)]
    corner = max(corners, key=lambda at: int(((xy >= at) & (xy <= at + side_m)).all(axis=1).sum()))
    graph = network.graph
    inside = ((graph.coords >= corner) & (graph.coords <= corner + side_m)).all(axis=1)
    kept = np.flatnonzero(np.minimum.reduceat(inside, graph.offsets[:-1]))
    nodes, ends = np.unique(graph.edges[kept], return_inverse=True)
    part = RoadGraph.from_polylines(graph.xy[nodes], ends.reshape(-1, 2), [graph.polyline(e) for e in kept])
    square = corner + side_m * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    return RoadNetwork(part, find_intersections(part), network.plane, (square,), network.meta)


def keep_masks(queries: QuerySet, folder: Path) -> MaskFiles:
    """Write the masks of a query set to a folder; if they are there already, nothing is drawn again."""
    if not (folder / "truth.csv").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        draw = queries.open()
        write_truth(folder, [_keep_mask(*draw(k), folder / str(k)) for k in range(len(queries))])
    return MaskFiles(folder, tuple(read_truth(folder / "truth.csv")))


def _keep_mask(truth: Truth, mask: Any, path: Path) -> Truth:
    """Write a mask, or a map of probabilities."""
    if isinstance(mask, ProbabilityMap):
        path = path.with_suffix(".tif")
        mask.write(path)
    else:
        path = path.with_suffix(".png")
        cv2.imwrite(str(path), mask)
    return replace(truth, file=path.name)


# --- fewer intersections ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FewLocator:
    """A method on N_r of a mask's intersections.

    The paper's gets some at random (section 4.3). roadgeo's own goes by the roads too, and would keep most of its
    knowledge: it gets the middle of the mask that holds as many.
    """

    reference: Path
    options: LocateOptions
    n_r: int

    def open(self) -> Callable[[Any], dict[str, Any]]:
        """Open the reference."""
        reference = open_reference(self.reference)
        least = replace(self.options.pair, min_intersections=self.n_r)
        options = replace(self.options, pair=least)

        def answer(mask: Any) -> dict[str, Any]:
            query = read_query(mask)
            if options.method == "auto":
                return locate(middle(query, mask, self.n_r), reference, options).to_dict()
            query = subset(query, self.n_r)
            searched = search_references(query, reference.parts, options, options.pair.time_limit_s)
            return decide(query, searched, options).to_dict()

        return answer


def subset(query: Query, n_r: int) -> Query:
    """Keep N_r intersections at random, always the same of the same mask."""
    found = query.scene.intersections
    rng = np.random.default_rng(zlib.crc32(found.xy.tobytes()))
    kept = found.only(np.sort(rng.permutation(len(found))[:n_r]))
    return replace(query, scene=prepare_scene(query.graph, kept, query.scene.size))


def middle(query: Query, path: Any, n_r: int) -> RoadMask:
    """Keep the smallest square around the middle of a mask that shows N_r intersections; the rest was not observed."""
    from roadgeo.sources.masks import read_mask

    mask, (width, height) = read_mask(path), query.scene.size
    rows, columns = (np.abs(np.arange(n) + 0.5 - n / 2) for n in (height, width))
    away = np.abs(query.scene.intersections.xy * (1, -1) - (width / 2, height / 2)).max(axis=1)
    # Those near its border lose a branch, so a square around N_r of them does not show as many.
    for half in np.sort(away)[n_r :: max(n_r // 5, 1)]:
        observed = (rows[:, None] < half) & (columns[None, :] < half)
        part = RoadMask(mask.roads & observed, observed, mask.name)
        if len(read_query(part).scene.intersections) >= n_r:
            return part
    return mask


# --- results ----------------------------------------------------------------------------------------------------------


def trials(queries: QuerySet, locator: Any, jobs: int, what: str) -> tuple[list[Trial], Evaluation]:
    """Run one point of an experiment and report it."""
    done = run_trials(queries, locator, jobs)
    found = evaluate([trial.truth for trial in done], [trial.answer for trial in done])
    total = found.total
    print(
        f"{what}: precision {percent(total.precision.value)}, recall {percent(total.recall.value)} "
        f"({total.recall.hits} of {total.recall.of})",
        flush=True,
    )
    return done, found


def percent(value: float) -> str:
    """As the paper's tables."""
    return "-" if np.isnan(value) else f"{100 * value:.1f} %"


def point(found: Evaluation) -> dict[str, Any]:
    """The figures of an evaluation, as plain values."""
    plain = found.to_dict()["total"]
    return {name: plain[name] for name in ("queries", "located", "precision", "recall", "center_m")}


def save(setting: Setting, name: str, results: dict[str, Any]) -> None:
    """Write results as JSON, with their conditions."""
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    about = {name: getattr(setting, name) for name in ("queries", "perspectives", "seed", "work_limit_s")}
    about |= {"commit": commit, "reference": setting.area.stem}
    (setting.out / f"{name}.json").write_text(json.dumps(about | results, indent=1) + "\n")


def axes(rows: int = 1, columns: int = 2, **options: Any) -> Any:
    """Make a figure and its axes."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=(5.2 * columns, 3.9 * rows), layout="constrained", **options)


def plot_share(ax: Any, xs: Sequence[float], shares: Iterable[dict[str, Any]], label: str, **style: Any) -> None:
    """Draw shares with their intervals over something."""
    known = [(x, s) for x, s in zip(xs, shares, strict=True) if s["of"]]
    if not known:
        return
    x = [at for at, _ in known]
    value, low, high = (np.array([s[name] for _, s in known]) for name in ("value", "low", "high"))
    reach = np.maximum([value - low, high - value], 0.0)
    ax.errorbar(x, value, reach, label=label, capsize=2, marker="o", markersize=4, **style)
    ax.set_ylim(0, 1.03)
    ax.grid(alpha=0.3)
