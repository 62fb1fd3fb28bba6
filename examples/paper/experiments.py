"""Shared by the paper's experiments: its settings and figures, its search area, locators, and how results are shown.

Li, Yang, Wang, He, "Road-network-based Rapid Geolocalization" (arXiv 1906.12174), section 4.
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.scoring import Evaluation, evaluate
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions
from roadgeo.evaluation.trials import QuerySet, Trial, run_trials
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask
from roadgeo.matching.index import build_index
from roadgeo.matching.pairs import PairIndex, build_pair_index
from roadgeo.matching.paper import PairOptions, match_pairs
from roadgeo.matching.scene import trace_query
from roadgeo.reference.library import resolve_reference
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import Intersections, find_intersections
from roadgeo.roads.network import RoadNetwork, as_stored
from roadgeo.workflows import LocateOptions, locate

#: Section 4.3: "an area of 10 x 10 km2"; section 4.4: cross-ratio error 0.3, inlier ratio 0.5, 30 intersections.
AREA_M = 10_000.0
PAIR = PairOptions(delta_cross_ratio=0.3, delta_inlier=0.5, min_intersections=30)


def arguments(description: str, queries: int = 100) -> argparse.ArgumentParser:
    """Options that all experiments take."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("reference", help="a reference: REF.gpkg, or a name in the library")
    parser.add_argument("--out", type=Path, default=Path(), help="folder for the results (default: here)")
    parser.add_argument("--queries", type=int, default=queries, help=f"masks per point (default {queries})")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--time-limit", type=float, default=10.0, help="seconds per mask (default 10)")
    parser.add_argument("--methods", nargs="+", choices=["pair", "auto"], default=["pair", "auto"])
    return parser


# --- the search area --------------------------------------------------------------------------------------------------


def search_area(reference: str, out: Path, side_m: float = AREA_M) -> Path:
    """Cut the square of this side with the most intersections out of a reference, as a reference of its own."""
    source = resolve_reference(reference)
    target = out / f"{source.stem}-{side_m / 1000:g}km.gpkg"
    if not target.is_file():
        out.mkdir(parents=True, exist_ok=True)
        network = as_stored(cut_network(read_network(source), side_m))
        Reference(build_index(network), network).save(target)
    return target


def cut_network(network: RoadNetwork, side_m: float, step_m: float = 500.0) -> RoadNetwork:
    """Keep the edges that lie in the densest square of a network."""
    xy = network.intersections.xy
    low = xy.min(axis=0)
    corners = [low + np.array([i, j]) * step_m for i, j in np.ndindex(*_steps(xy, side_m, step_m))]
    corner = max(corners, key=lambda at: int(((xy >= at) & (xy <= at + side_m)).all(axis=1).sum()))
    graph = network.graph
    inside = ((graph.coords >= corner) & (graph.coords <= corner + side_m)).all(axis=1)
    kept = np.flatnonzero(np.minimum.reduceat(inside, graph.offsets[:-1]))
    nodes, ends = np.unique(graph.edges[kept], return_inverse=True)
    part = RoadGraph.from_polylines(graph.xy[nodes], ends.reshape(-1, 2), [graph.polyline(e) for e in kept])
    square = corner + side_m * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    return RoadNetwork(part, find_intersections(part), network.plane, (square,), network.meta)


def _steps(xy: np.ndarray, side_m: float, step_m: float) -> tuple[int, int]:
    spans = np.ptp(xy, axis=0) - side_m
    columns, rows = (max(int(span // step_m), 0) + 1 for span in spans)
    return columns, rows


# --- queries and locators ---------------------------------------------------------------------------------------------


def views(scene_m: float, least: int = 30) -> ViewOptions:
    """Views of a scene of side d_r under "random homography transformations", at 1 m per pixel."""
    return ViewOptions(
        window_m=scene_m, tilt_deg=(0.0, 30.0), heading_deg=(0.0, 360.0), intersections=(least, 1_000_000)
    )


def masks(scene_m: float, noise: str, seed: int, least: int = 30) -> SimulationOptions:
    """Masks of such views."""
    return SimulationOptions(views(scene_m, least), NOISE_MODELS[noise], f"{scene_m:g} m, {noise}", seed)


@dataclass(frozen=True)
class PairLocator:
    """The paper's matcher, on a random subset of N_r of the mask's intersections where `n_r` is given."""

    reference: Path
    options: PairOptions = PAIR
    n_r: int | None = None

    def open(self) -> Callable[[Any], dict[str, Any]]:
        """Build the paper's tables."""
        network = read_network(self.reference)
        table = build_pair_index(network.intersections, self.options.d_max_m)
        return lambda mask: self._locate(mask, network, table)

    def _locate(self, mask: Any, network: RoadNetwork, table: PairIndex) -> dict[str, Any]:
        from time import perf_counter

        started = perf_counter()
        scene, _ = trace_query(as_mask(mask))
        traced = perf_counter()
        query, options = scene.intersections, self.options
        if self.n_r is not None:
            query, options = subset(query, self.n_r), replace(options, min_intersections=min(self.n_r, len(query)))
        match = match_pairs(query, table, scene.corners, options)
        answer = {
            "status": "not_located" if match.homography is None else "located",
            "reason": match.reason,
            "crs": network.plane.crs,
            "size": list(scene.size),
            "n_intersections": len(query),
            "inlier_ratio": match.inlier_ratio,
            "seconds": {"vectorize": traced - started, "match": match.seconds},
            "stats": {"tuples_sampled": match.n_samples, "hypotheses": match.hypotheses},
        }
        if match.homography is not None:
            matrix = network.plane.to_crs_matrix() @ match.homography @ PIXEL_TO_PLANE
            answer["homography"] = (matrix / matrix[2, 2]).tolist()
        return answer


@dataclass(frozen=True)
class AutoLocator:
    """roadgeo's default, on the middle of the mask that holds N_r of its intersections where `n_r` is given.

    It goes by the roads too, so a subset of the intersections would leave it most of its knowledge.
    """

    reference: Path
    options: LocateOptions = field(default_factory=LocateOptions)
    n_r: int | None = None

    def open(self) -> Callable[[Any], dict[str, Any]]:
        """Open the reference."""
        reference = open_reference(self.reference)

        def answer(mask: Any) -> dict[str, Any]:
            shown = as_mask(mask)
            return locate(middle(shown, self.n_r) if self.n_r else shown, reference, self.options).to_dict()

        return answer


def as_mask(mask: Any) -> RoadMask:
    """Take a drawn mask, or the file of one, as `roadgeo.locate` does: the void corners of a warped one are known."""
    from roadgeo.sources.masks import read_mask

    return read_mask(mask)


def subset(found: Intersections, n_r: int) -> Intersections:
    """Choose N_r intersections at random, always the same for the same mask (section 4.3)."""
    rng = np.random.default_rng(zlib.crc32(found.xy.tobytes()))
    kept = np.sort(rng.permutation(len(found))[:n_r])
    return Intersections(found.xy[kept], found.rays[kept], found.tangents[kept], found.residual[kept], found.node[kept])


def middle(mask: RoadMask, n_r: int) -> RoadMask:
    """Keep the smallest square around the middle that shows N_r intersections; the rest was not observed."""
    scene, _ = trace_query(mask)
    height, width = mask.shape
    rows, columns = (np.abs(np.arange(n) + 0.5 - n / 2) for n in (height, width))
    away = np.abs(scene.intersections.xy * (1, -1) - (width / 2, height / 2)).max(axis=1)
    # Those near its border lose a branch, so a square around N_r of them does not show as many.
    for half in np.sort(away)[n_r :: max(n_r // 5, 1)]:
        observed = (rows[:, None] < half) & (columns[None, :] < half)
        part = RoadMask(mask.roads & observed, observed, mask.name)
        if len(trace_query(part)[0].intersections) >= n_r:
            return part
    return mask


def trials(queries: QuerySet, locator: Any, options: argparse.Namespace, what: str) -> tuple[list[Trial], Evaluation]:
    """Run one point of an experiment and report it."""
    done = run_trials(queries, locator, options.jobs)
    found = evaluate([trial.truth for trial in done], [trial.answer for trial in done])
    total = found.total
    print(
        f"{what}: precision {percent(total.precision.value)}, recall {percent(total.recall.value)} "
        f"({total.recall.hits} of {total.recall.of}), median {1000 * total.compute_s.median:.0f} ms",
        flush=True,
    )
    return done, found


# --- results ----------------------------------------------------------------------------------------------------------


def percent(value: float) -> str:
    """As the paper's tables."""
    return "-" if np.isnan(value) else f"{100 * value:.1f} %"


def point(found: Evaluation) -> dict[str, Any]:
    """The figures of an evaluation, as plain values."""
    plain = found.to_dict()["total"]
    return {name: plain[name] for name in ("queries", "located", "precision", "recall", "center_m", "compute_s")}


def save(out: Path, name: str, results: dict[str, Any]) -> None:
    """Write results as JSON."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(results, indent=1) + "\n")


def axes(rows: int = 1, columns: int = 2, **options: Any) -> Any:
    """Make a figure and its axes."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=(5.2 * columns, 3.9 * rows), layout="constrained", **options)


def plot_share(ax: Any, xs: Sequence[float], shares: Sequence[dict[str, Any]], label: str, **style: Any) -> None:
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
