"""Figure 7: how many tuples of two intersections there are of each type; and whether to draw the rarest first pays.

A type is d_b = [N_B(P1), N_B(P2), N_q(P1), N_q(P2)]: branches and tangents of both ends.
"""

from __future__ import annotations

import time
from typing import Any

import experiments as paper
import numpy as np

from roadgeo.matching.pairs import TupleOptions, paired
from roadgeo.reference.opening import open_reference


def run(setting: paper.Setting) -> None:
    """Run the experiment."""
    (part,) = open_reference(setting.area).parts
    index, begin = part.open(), time.process_time()
    table = paired(index, TupleOptions())
    build_s = time.process_time() - begin
    types = sorted(((len(of_type.pairs), _type(key)) for key, of_type in table.tuples.items()), reverse=True)
    counts = np.array([count for count, _ in types])
    shares = np.cumsum(counts) / counts.sum()
    print(f"{len(table):,} tuples of {len(counts)} types in {build_s:.1f} s; two hold {100 * shares[1]:.0f} %")
    print(f"{np.searchsorted(shares, 0.9) + 1} hold 90 %; {np.sum(counts < 100)} have fewer than 100 tuples")
    results = []
    for noise in ("clean", "segmented"):
        queries = setting.masks(1500.0, noise)
        for rarest in (True, False):
            locator = setting.locator("pair", rarest_first=rarest)
            name = f"{noise}, {'rarest type first' if rarest else 'any type'}"
            done, found = paper.trials(queries, locator, setting.jobs, name)
            tested = [t.answer["stats"]["hypotheses"] for t in done if t.answer["status"] == "located"]
            median = float(np.median(tested)) if tested else None
            about = {"noise": noise, "rarest_first": rarest, "median_hypotheses_of_located": median}
            results.append({**about, **paper.point(found)})
    listed = [{"type": of_type, "tuples": count} for count, of_type in types]
    paper.save(setting, "figure7", {"build_s": build_s, "types": listed, "rarest_first": results})
    draw(setting, counts, results)


def _type(key: int) -> list[int]:
    """Return the branch descriptor [N_B(P1), N_B(P2), N_q(P1), N_q(P2)] of a type (see `PairIndex.tuples`)."""
    first, second = divmod(key, 256)
    return [first // 16, second // 16, first % 16, second % 16]


def draw(setting: paper.Setting, counts: np.ndarray, results: list[dict[str, Any]]) -> None:
    """Plot how many tuples each type has, commonest first, and recall in either order of drawing."""
    figure, (bars, orders) = paper.axes()
    bars.bar(np.arange(len(counts)), counts, width=1.0)
    title = f"{setting.area.stem}: {counts.sum():,} tuples"
    bars.set(yscale="log", xlabel="types, by frequency", ylabel="tuples", title=title)
    for rarest, shift in ((True, -0.2), (False, 0.2)):
        chosen = [r["recall"] for r in results if r["rarest_first"] is rarest]
        value, low, high = (np.array([share[name] for share in chosen]) for name in ("value", "low", "high"))
        at = np.arange(len(chosen)) + shift
        label = "rarest type first" if rarest else "any type"
        orders.bar(at, value, 0.4, yerr=np.maximum([value - low, high - value], 0.0), capsize=3, label=label)
    kinds = list(dict.fromkeys(r["noise"] for r in results))
    orders.set(xticks=np.arange(len(kinds)), xticklabels=kinds, ylim=(0, 1.03), ylabel="recall of pair")
    orders.legend()
    figure.savefig(setting.out / "figure7.png", dpi=110)
