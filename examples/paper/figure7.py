"""Figure 7: how many tuples of two intersections there are of each type; and whether to draw the rarest first pays.

    python examples/paper/figure7.py boston-ma --out results

A type is d_b = [N_B(P1), N_B(P2), N_q(P1), N_q(P2)]: branches and tangents of both ends.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import experiments as paper
import numpy as np

from roadgeo.evaluation.trials import DrawnMasks
from roadgeo.matching.pairs import build_pair_index


def main() -> None:
    """Run the experiment."""
    parser = paper.arguments(__doc__, queries=50)
    options = parser.parse_args()
    area = paper.search_area(options.reference, options.out)
    table = build_pair_index(paper.read_network(area).intersections)
    keys = list(table.tuples)
    counts = np.array([len(item.pairs) for item in table.tuples.values()])
    order = np.argsort(-counts)
    shares = np.cumsum(counts[order]) / counts.sum()
    print(f"{len(table):,} tuples of {len(counts)} types; the commonest:")
    for t in order[:8]:
        print(f"  {_type(keys[t])}  {counts[t]:>9,}  {100 * counts[t] / counts.sum():.1f} %")
    print(
        f"{np.searchsorted(shares, 0.9) + 1} types hold 90 % of them; {np.sum(counts < 100)} types have fewer than 100"
    )

    results = []
    for noise in ("clean", "segmented", "poor"):
        queries = DrawnMasks(area, ((paper.masks(1500.0, noise, options.seed), options.queries),))
        for rarest in (True, False):
            pair = replace(paper.PAIR, rarest_first=rarest, time_limit_s=options.time_limit)
            name = f"{noise}, {'rarest type first' if rarest else 'any type'}"
            done, found = paper.trials(queries, paper.PairLocator(area, pair), options, name)
            tested = [t.answer["stats"]["hypotheses"] for t in done if t.answer["status"] == "located"]
            results.append(
                {
                    "noise": noise,
                    "rarest_first": rarest,
                    "median_hypotheses_of_located": float(np.median(tested)) if tested else None,
                    **paper.point(found),
                }
            )
    types = [{"type": _type(keys[t]), "tuples": int(counts[t])} for t in order]
    paper.save(options.out, "figure7", {"reference": area.stem, "types": types, "rarest_first": results})

    draw(area.stem, counts[order], results, options.out)


def _type(key: int) -> list[int]:
    """Return the branch descriptor [N_B(P1), N_B(P2), N_q(P1), N_q(P2)] of a type (see `PairIndex.tuples`)."""
    first, second = divmod(key, 256)
    return [first // 16, second // 16, first % 16, second % 16]


def draw(area: str, counts: np.ndarray, results: list[dict[str, Any]], out: paper.Path) -> None:
    """Plot how many tuples each type has, commonest first, and recall in either order of drawing."""
    figure, (bars, orders) = paper.axes()
    bars.bar(np.arange(len(counts)), counts, width=1.0)
    bars.set(yscale="log", xlabel="types, by frequency", ylabel="tuples", title=f"{area}: {counts.sum():,} tuples")
    for rarest, shift in ((True, -0.2), (False, 0.2)):
        chosen = [r["recall"] for r in results if r["rarest_first"] is rarest]
        value, low, high = (np.array([share[name] for share in chosen]) for name in ("value", "low", "high"))
        at = np.arange(len(chosen)) + shift
        label = "rarest type first" if rarest else "any type"
        orders.bar(at, value, 0.4, yerr=np.maximum([value - low, high - value], 0.0), capsize=3, label=label)
    kinds = list(dict.fromkeys(r["noise"] for r in results))
    orders.set(xticks=np.arange(len(kinds)), xticklabels=kinds, ylim=(0, 1.03), ylabel="recall of pair")
    orders.legend()
    figure.savefig(out / "figure7.png", dpi=110)


if __name__ == "__main__":
    main()
