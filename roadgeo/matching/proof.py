"""Places that are proved by their lead over all twins.

Where streets repeat, chance nearby is other blocks, and even the place of a good mask has few odds. A search would go
on until all its work is done, though the place was met at its beginning, and then refuse it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.ledger import Ledger
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.search import Search
from roadgeo.matching.triples import larger
from roadgeo.matching.twins import Twin, TwinOptions, best_twin, loses_part

__all__ = ["Proof", "Prover"]


class Proof(NamedTuple):
    """A place, its best twin, and the log10 odds by which it leads that."""

    model: Hypothesis
    twin: Twin
    log10_odds: float


class Prover:
    """Compares the place of each part that agrees best with its twins, each place once.

    It remembers those: places that agree less, where streets do not repeat, may push them out of a search's leaders.
    """

    def __init__(
        self, estimators: Mapping[Search[Hypothesis], TripleEstimator], options: LocateOptions, ledger: Ledger
    ) -> None:
        self.estimators, self.options, self.ledger = estimators, options, ledger
        self._compared: dict[Search[Hypothesis], list[tuple[Hypothesis, Twin | None]]] = {}

    def __call__(self, one: Search[Hypothesis]) -> bool:
        """Whether a place of a part is proved beyond what an answer needs, by the margin."""
        proof = self.proof(one)
        return proof is not None and proof.log10_odds >= self.options.min_log10_odds + self.options.min_margin

    def proof(self, one: Search[Hypothesis]) -> Proof | None:
        """Compare the place of a part that agrees best with its twins.

        None where streets do not repeat, and where a weak one loses a part of the frame.

        Twins are looked for around it; the larger the map, the more other places may lead theirs.
        """
        compared, twins, estimator = self._compared.setdefault(one, []), self.options.twins, self.estimators[one]
        met = [model for _, model in (*one.leaders, *one.promising)] + [model for model, _ in compared]
        fullest = max((model for model in met if _is_measured(model)), key=_agreement, default=None)
        if twins is None or fullest is None or _agreement(fullest) < twins.agreeing:
            return None
        if fullest.chance[1] < twins.repeating or fullest.log10_odds >= twins.certain:
            return None
        if all(model is not fullest for model, _ in compared):
            started = time.perf_counter()
            compared.append((fullest, self._best_twin(estimator, fullest, met, twins)))
            one.seconds += time.perf_counter() - started
        twin = next(twin for model, twin in compared if model is fullest)
        if twin is None:
            return None
        if max(twin.log10_lead, fullest.log10_odds) < twins.weak:
            scene, match = estimator.scene_of(fullest), self.options.match
            if loses_part(fullest.laid, scene, estimator.index, match, twins):
                return None
        return Proof(fullest, twin, twin.log10_lead - 2.0 * math.log10(larger(self.ledger.n_reference)))

    def _best_twin(
        self, estimator: TripleEstimator, model: Hypothesis, met: Sequence[Hypothesis], twins: TwinOptions
    ) -> Twin | None:
        known = [other.laid for other in met if not estimator.same(other, model)]
        scene, match = estimator.scene_of(model), self.options.match
        return best_twin(model.laid, scene, estimator.index, match, twins, estimator.near, known)


def _is_measured(model: Hypothesis) -> bool:
    """Whether a place was laid on the map, and chance was measured there."""
    return model.refined is not None and model.chance[1] < 1.0


def _agreement(model: Hypothesis) -> float:
    return 0.0 if model.found is None else model.found.mean
