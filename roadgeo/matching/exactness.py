"""How exactly a mask and the map agree at a place: its odds within finer tolerances."""

from __future__ import annotations

from statistics import fmean

from roadgeo.matching.hypothesis import MINIMAL, Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import VerifyOptions, agreement, chance_agreement, log10_odds

__all__ = ["exact_log10_odds"]


def exact_log10_odds(
    model: Hypothesis,
    scene: Scene,
    index: ReferenceIndex,
    n_candidates: int,
    options: VerifyOptions,
    certain: float,
    near: tuple[float, float, float] | None = None,
) -> float:
    """Return the log10 odds of a place: the mean of those within the usual tolerance and within finer ones.

    How accurate a mask is on its map is not known. At its own place most of what agrees does so exactly, and the odds
    within all tolerances are alike; where something like it lies, such as another motorway junction, it agrees roughly.
    Odds are pooled by the mean of their logarithms (Genest and Zidek, Statistical Science 1, 1986), which is low where
    they disagree. `model.log10_odds` are those within the usual tolerance; they are raised by `options.most_raised`
    at most, and stay what they are from `certain` on.
    """
    if model.log10_odds >= certain:
        return model.log10_odds
    logs = [model.log10_odds]
    for share in options.finer:
        verify = options.within(share)
        found, _, _ = agreement(model.matrix, scene, index, model.gsd_m, model.seeds[-MINIMAL:], verify)
        chance = chance_agreement(model.matrix, scene, index, model.gsd_m, verify, near=near)
        logs.append(log10_odds(found, chance, scene.n_statements, n_candidates, verify))
    return min(fmean(logs), model.log10_odds + options.most_raised)
