"""How exactly a mask and the map agree at a place: its odds within finer tolerances, and in the foreground."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import fmean

from roadgeo.matching.foreground import foreground
from roadgeo.matching.hypothesis import MINIMAL, Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import Agreement, VerifyOptions, agreement, chance_agreement, log10_odds

__all__ = ["exact_log10_odds", "is_plain", "may_stand"]

#: In a lattice many wrong places look plain, but seldom before the right one.
_FIRST = 4
#: Masks are whole as often as not, as far as is known: each kind is charged for the other.
_TWO_KINDS = math.log10(2.0)


def may_stand(model: Hypothesis, options: VerifyOptions) -> bool:
    """Whether a place that was verified within the usual tolerance may be located after finer ones."""
    if model.found is None or not math.isfinite(model.log10_odds):
        return False
    return _is_whole(model.found, options) or model.log10_odds >= options.promising - options.most_raised


def is_plain(model: Hypothesis, n_verified: int, options: VerifyOptions) -> bool:
    """Whether so much agrees at one of the first places that are verified that it is probably right."""
    found = model.found
    return n_verified <= _FIRST and found is not None and min(found.forward, found.backward) >= options.plain


def exact_log10_odds(
    model: Hypothesis,
    scene: Scene,
    index: ReferenceIndex,
    n_candidates: int,
    options: VerifyOptions,
    certain: float,
    near: tuple[float, float, float] | None = None,
) -> float:
    """Return the log10 odds of a place: those of a mask of any kind, or of a whole one if they are higher.

    Of any kind they are the mean of those within the usual tolerance and within finer ones. How accurate a mask is on
    its map is not known. At its own place most of what agrees does so exactly, and the odds within all tolerances are
    alike; where something like it lies, such as another motorway junction, it agrees roughly. Odds are pooled by the
    mean of their logarithms (Genest and Zidek, Statistical Science 1, 1986), which is low where they disagree.
    `model.log10_odds` are those within the usual tolerance; they are raised by `options.most_raised` at most, and stay
    what they are from `certain` on.

    A whole mask shows nearly all that the map shows, and little else, within the finest tolerance. Then not only each
    road is a statement but every piece of it: a winding road of a kilometre is as hard to meet by chance as many short
    ones. In a lattice a place that was fitted agrees more exactly than its shifted copies: what chance reaches is taken
    within a wider tolerance, the finest but one.

    Where the camera leaned, the place has the odds of the foreground alone if they are higher and most agrees there
    (see `foreground`).
    """
    odds = _exact(model, scene, index, n_candidates, options, certain, near)
    if odds >= certain or not math.isfinite(odds):  # -inf: the camera, or where the frame may lie, rules it out
        return odds
    part = foreground(model, scene, options.foreground, options.least_whole)
    if part is None:
        return odds
    found, _, _ = agreement(model.matrix, part.scene, index, model.gsd_m, part.seeds[-MINIMAL:], options)
    if not _is_whole(found, options):
        return odds
    chance = chance_agreement(model.matrix, part.scene, index, model.gsd_m, options, near=near)
    usual = log10_odds(found, chance, part.scene.n_statements, n_candidates, options)
    seen = replace(model, found=found, chance=chance, log10_odds=usual, seeds=part.seeds)
    return max(odds, _exact(seen, part.scene, index, n_candidates, options, certain, near) - _TWO_KINDS)


def _exact(
    model: Hypothesis,
    scene: Scene,
    index: ReferenceIndex,
    n_candidates: int,
    options: VerifyOptions,
    certain: float,
    near: tuple[float, float, float] | None,
) -> float:
    """Return the odds of a place by all that a scene shows."""
    if model.log10_odds >= certain or not may_stand(model, options):
        return model.log10_odds
    logs = [model.log10_odds]
    found, chance, wider = None, model.chance, model.chance
    for share in options.finer:
        verify, wider = options.within(share), chance
        found, _, _ = agreement(model.matrix, scene, index, model.gsd_m, model.seeds[-MINIMAL:], verify)
        chance = chance_agreement(model.matrix, scene, index, model.gsd_m, verify, near=near)
        logs.append(log10_odds(found, chance, scene.n_statements, n_candidates, verify))
    pooled = min(fmean(logs), model.log10_odds + options.most_raised)
    if found is None or not _is_whole(found, options):
        return pooled
    whole = replace(options, least_rates=options.whole_rates, statement_m=options.whole_statement_m)
    n_pieces = scene.counting_length_px * model.gsd_m / options.whole_statement_m
    of_whole = log10_odds(found, wider, n_pieces, n_candidates, whole) - _TWO_KINDS
    return max(pooled, of_whole)


def _is_whole(found: Agreement, options: VerifyOptions) -> bool:
    return min(found.forward, found.backward) >= options.least_whole
