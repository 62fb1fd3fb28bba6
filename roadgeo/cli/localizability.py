"""`roadgeo evaluate --map`: where on a reference masks would be located."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from roadgeo.cli.queries import count_up

if TYPE_CHECKING:
    from roadgeo.evaluation.localizability import LocalizabilityMap
    from roadgeo.evaluation.simulation import SimulationOptions
    from roadgeo.evaluation.trials import QuerySet, ReferenceLocator, Trial

__all__ = ["Survey"]

#: No number of intersections is asked for: how many a place shows is what matters.
ANY = (0, 1_000_000)


@dataclass(frozen=True)
class Survey:
    """What a map of localizability is made with.

    Attributes
    ----------
    trials : int
        Masks to learn from: a quarter of them anywhere, a quarter where those leave hope, half where these leave much.
    check : int
        Other masks that the map is held against.
    settings : dict
        Plain values that tell these masks and this locator from others.
    out_dir : Path or None
        Where every trial is kept, so that the same command goes on from there. None: nowhere.
    """

    reference: Path
    simulation: SimulationOptions
    locator: ReferenceLocator
    trials: int
    check: int
    jobs: int
    quiet: bool
    settings: dict[str, Any]
    out_dir: Path | None

    def run(self, as_json: bool) -> None:
        """Make the map, and write and print it."""
        from roadgeo.evaluation.localizability import draw_localizability, to_geotiff, to_qml
        from roadgeo.reference.network_file import read_network
        from roadgeo.storage.files import write_bytes, write_text

        network = read_network(self.reference)
        found = self._learn(network)
        out_dir = self.out_dir or Path()
        stem = f"{self.reference.stem}_localizability"
        window = round(found.grid.footprint_m2**0.5)
        title = f"{self.reference.stem}: masks of {window} x {window} m, {self.simulation.kind}"
        write_bytes(out_dir / f"{stem}.tif", to_geotiff(found))
        write_text(out_dir / f"{stem}.qml", to_qml())
        write_bytes(out_dir / f"{stem}.png", draw_localizability(network, found, title))
        summary = self._summary(found)
        write_text(out_dir / f"{stem}.json", json.dumps(summary, indent=1) + "\n")
        if as_json:
            click.echo(json.dumps(summary))
        elif not self.quiet:
            _print(summary)
            click.echo(f"wrote {out_dir / stem}.tif, .qml, .png, .json", err=True)

    def _learn(self, network: Any) -> LocalizabilityMap:
        from roadgeo.evaluation.localizability import lay_grid, map_localizability
        from roadgeo.evaluation.simulation import footprint_area
        from roadgeo.evaluation.trials import PlacedMasks

        grid = lay_grid(network, footprint_area(self.simulation.view))
        rng = np.random.default_rng(self.simulation.seed)
        hope = grid.counts >= 3
        quarter = self.trials // 4
        places, located = np.empty((0, 2)), np.empty(0, bool)
        # The surer a class of places is to be, the more trials it takes to tell.
        rounds = (quarter, 0.5), (quarter, 0.85), (self.trials - 2 * quarter, 1.0)
        for number, (count, least) in enumerate(rounds, 1):
            centers = grid.draw(count, hope, rng)
            masks = PlacedMasks(self.reference, self.simulation, tuple(map(tuple, centers.tolist())), len(places))
            places = np.vstack([places, centers])
            located = np.concatenate([located, _located(self._try(masks, f"{number}"))])
            found = map_localizability(grid, places, located)
            hope = np.nan_to_num(found.probability) >= least
        return found

    def _try(self, masks: QuerySet, part: str) -> list[Trial]:
        from roadgeo.evaluation.trials import run_trials

        record = None
        if self.out_dir is not None:
            record = self.out_dir / f"{self.reference.stem}_localizability_trials_{part}.jsonl"
        with count_up(len(masks), self.quiet) as count:
            return run_trials(
                masks,
                self.locator,
                self.jobs,
                record,
                self.settings,
                lambda trial: count(trial.answer["status"].replace("_", " ")),
            )

    def _summary(self, found: LocalizabilityMap) -> dict[str, Any]:
        """Say how much ground is in each class, and how many of the masks held against it were located there."""
        from dataclasses import asdict

        from roadgeo.evaluation.localizability import PALETTE
        from roadgeo.evaluation.scoring import share
        from roadgeo.evaluation.trials import DrawnMasks

        summary: dict[str, Any] = {"schema": "roadgeo.localizability/1", "trials": self.trials, "classes": []}
        checked, located = np.empty(0, np.uint8), np.empty(0, bool)
        if self.check:
            held_out = replace(self.simulation, kind=f"{self.simulation.kind}-check")
            trials = self._try(DrawnMasks(self.reference, ((held_out, self.check),)), "check")
            checked = found.at(found.grid.plane.from_crs(np.array([trial.truth.center for trial in trials])))
            located = _located(trials)
        known = max(int((found.classes > 0).sum()), 1)
        for value, (_, _, label) in list(PALETTE.items())[1:]:
            hits = located[checked == value]
            summary["classes"].append(
                {
                    "value": value,
                    "label": label,
                    "area_share": float((found.classes == value).sum() / known),
                    "located": asdict(share(int(hits.sum()), len(hits))) if len(hits) else None,
                }
            )
        return summary


def _located(trials: list[Trial]) -> Any:
    from roadgeo.evaluation.scoring import score

    return np.array([score(trial.truth, trial.answer).right for trial in trials], bool)


def _print(summary: dict[str, Any]) -> None:
    for entry in summary["classes"]:
        line = f"{entry['label']:<28} {100 * entry['area_share']:5.1f} % of the map"
        if entry["located"]:
            line += f"; located there: {entry['located']['hits']} of {entry['located']['of']}"
        click.echo(line)
    if not summary["classes"][0]["area_share"]:
        click.echo(
            "No promise can be made anywhere: too few masks were located, or tried; a larger -n, wider windows or"
            " better masks may help."
        )
