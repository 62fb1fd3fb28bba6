"""Where on a reference masks would be located: trials all over it, and a map learnt from them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import BoolArray
from roadgeo._progress import Counting, count_nothing
from roadgeo.evaluation.localizability import (
    PALETTE,
    LocalizabilityMap,
    draw_localizability,
    lay_grid,
    map_localizability,
    to_geotiff,
)
from roadgeo.evaluation.scoring import score, share
from roadgeo.evaluation.simulation import SimulationOptions, footprint_area
from roadgeo.evaluation.trials import DrawnMasks, QuerySet, ReferenceLocator, Trial, run_trials
from roadgeo.outputs.drawing.raster import write_png
from roadgeo.outputs.registry import LOCALIZABILITY
from roadgeo.reference.network_file import read_network
from roadgeo.roads.network import RoadNetwork
from roadgeo.storage.files import replacing, write_bytes, write_text
from roadgeo.storage.qml import draw_palette

__all__ = ["ANY", "Survey", "write_survey"]

#: Any number of intersections is allowed: the map shows its effect.
ANY = (0, 1_000_000)


@dataclass(frozen=True)
class Survey:
    """Options of a map of localizability.

    Attributes
    ----------
    trials : int
        Masks to learn from: a quarter of them anywhere, a quarter where those leave hope, half where these leave much.
    check : int
        Other masks that the map is held against.
    jobs : int
        Processes.
    settings : mapping
        Plain values that identify these masks and this locator.
    out_dir : Path or None
        Where every trial is kept, so that the same survey goes on from there. None: nowhere.
    counting : Counting
        Shows how many masks are tried.
    """

    reference: Path
    simulation: SimulationOptions
    locator: ReferenceLocator
    trials: int
    check: int = 0
    jobs: int = 1
    settings: Mapping[str, Any] = field(default_factory=dict)
    out_dir: Path | None = None
    counting: Counting = count_nothing

    def learn(self, network: RoadNetwork) -> LocalizabilityMap:
        """Try masks all over the map of a network, and learn a map from them."""
        grid = lay_grid(network, footprint_area(self.simulation.view))
        rng = np.random.default_rng(self.simulation.seed)
        hope = grid.counts >= 3
        quarter = self.trials // 4
        places, located = np.empty((0, 2)), np.empty(0, bool)
        # Classes of higher probability need more trials.
        rounds = (quarter, 0.5), (quarter, 0.85), (self.trials - 2 * quarter, 1.0)
        for number, (count, least) in enumerate(rounds, 1):
            centers = grid.draw(count, hope, rng)
            at: Any = tuple(map(tuple, centers.tolist()))
            masks = DrawnMasks(self.reference, ((self.simulation, count),), centers=at, first=len(places))
            places = np.vstack([places, centers])
            located = np.concatenate([located, _located(self._try(masks, f"{number}"))])
            localizability = map_localizability(grid, places, located)
            hope = np.nan_to_num(localizability.probability) >= least
        return localizability

    def _try(self, masks: QuerySet, part: str) -> list[Trial]:
        record = None
        if self.out_dir is not None:
            record = self.out_dir / f"{self.reference.stem}{LOCALIZABILITY}_trials_{part}.jsonl"
        with self.counting(len(masks)) as count:
            return run_trials(masks, self.locator, self.jobs, record, self.settings, count)

    def summarize(self, localizability: LocalizabilityMap) -> dict[str, Any]:
        """Return the area of each class, and how many of the test masks were located there."""
        summary: dict[str, Any] = {"schema": "roadgeo.localizability/1", "trials": self.trials, "classes": []}
        checked, located = np.empty(0, np.uint8), np.empty(0, bool)
        if self.check:
            held_out = replace(self.simulation, kind=f"{self.simulation.kind}-check")
            trials = self._try(DrawnMasks(self.reference, ((held_out, self.check),)), "check")
            checked = localizability.at(
                localizability.grid.plane.from_crs(np.array([trial.truth.center for trial in trials]))
            )
            located = _located(trials)
        n_judged = max(int((localizability.classes > 0).sum()), 1)
        for value, (_, _, label) in list(PALETTE.items())[1:]:
            hits = located[checked == value]
            summary["classes"].append(
                {
                    "value": value,
                    "label": label,
                    "area_share": float((localizability.classes == value).sum() / n_judged),
                    "located": asdict(share(int(hits.sum()), len(hits))) if len(hits) else None,
                }
            )
        return summary


def write_survey(
    survey: Survey, out_dir: Path, further: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], list[Path]]:
    """Make the map, and write it as GeoTIFF with a style for QGIS, as picture and in figures.

    Parameters
    ----------
    further : mapping, optional
        Further plain values for the figures: version, command and so on.

    Returns
    -------
    summary, files
        As written to the JSON file.

    Raises
    ------
    OutputError
        A file cannot be written, or the trials kept in the folder belong to another survey.
    """
    network = read_network(survey.reference)
    localizability = survey.learn(network)
    window = round(localizability.grid.footprint_m2**0.5)
    title = f"{survey.reference.stem}: masks of {window} x {window} m, {survey.simulation.kind}"
    stem = f"{survey.reference.stem}{LOCALIZABILITY}"
    files = [out_dir / f"{stem}{suffix}" for suffix in (".tif", ".qml", ".png", ".json")]
    write_bytes(files[0], to_geotiff(localizability))
    write_text(files[1], draw_palette(PALETTE))
    with replacing(files[2]) as temporary:
        write_png(temporary, draw_localizability(network, localizability, title))
    summary = {**survey.summarize(localizability), "settings": survey.settings, **(further or {})}
    write_text(files[3], json.dumps(summary, indent=1) + "\n")
    return summary, files


def _located(trials: list[Trial]) -> BoolArray:
    return np.array([score(trial.truth, trial.answer).right for trial in trials], bool)
