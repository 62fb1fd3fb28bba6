"""Write the tables of docs/how-well.md from the results that are kept: python examples/tables.py.

`results/bench.json` is the file `bench.json` of `python examples/bench.py --out FOLDER`; of two checkouts the first one
counts. The other tables count the searches that `examples/trust`, `examples/photographs`, `examples/company` and
`examples/peers` keep in their `results`. The bands of the score come from `roadgeo.location.ERROR_RATES`, which a test
counts anew. `--check` writes nothing, and fails if a table would change.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

EXAMPLES = Path(__file__).resolve().parent
sys.path[:0] = [str(EXAMPLES), *(str(EXAMPLES / name) for name in ("company", "peers", "photographs"))]

import company  # noqa: E402
import join  # noqa: E402
import photographs  # noqa: E402
import results  # noqa: E402

from roadgeo.location import ERROR_RATES, ErrorRate, Kind  # noqa: E402

PAGE = EXAMPLES.parent / "docs" / "how-well.md"
BENCH = EXAMPLES / "results" / "bench.json"
SEARCHES = EXAMPLES / "trust" / "results"
#: A place is reported from this score on.
NEEDED = 3.5
WORN = {
    "mild": "mild: 5 to 10 % of the roads gone, 2 to 5 % false",
    "noisy": "noisy: 15 to 25 % gone, 5 to 12 % false",
    "few": "few: mild, 8 to 18 intersections",
    "torn": "torn: 30 to 50 % gone, 10 to 40 % false",
    "outdated": "outdated: mild, 20 to 40 % of the streets unknown to the map",
}
#: Seeds of `examples/company` on which rules were settled: no measure of how often they fail.
SETTLED_ON = ("72", "953")
COMPANY = ("shards", "told", "twice", "soft")
NAMES = {
    "base": "usual: 10 % gone, 4 % false, ragged edges",
    "clean": "clean: level, nothing gone or false, smooth edges",
    "frame512": "frames of 512 m",
    "frame512gone20": "frames of 512 m, 20 % gone, 5 % false",
    "frame800": "frames of 800 m",
    "few8_12": "8 to 12 intersections",
    "gone50": "half gone",
    "gone40false40": "40 % gone, 40 % false",
    "false60": "60 % false",
    "tilt50_60": "tilt 50 to 60°",
    "warp6": "bent by 6 pixels",
    "lens": "lens, k1 -0.08",
    "stale40": "40 % of the streets unknown to the map",
    "void_half": "half of the frame black",
    "all": "all of them",
    "turned over": "mirrored: no place",
    "elsewhere": "of another city: no place",
}


def bench_table(runs: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table of kinds."""
    kinds = next(iter(runs.values()))
    yield "| | located right | wrong | corners, median / 90 % | error / claimed, median, rms | seconds, median |"
    yield "|---|---|---|---|---|---|"
    for kind in (name for name in NAMES if name in kinds):
        item = kinds[kind]
        corners = ratios = right = ""
        if item["right"]:
            right = f"{item['right']:,} of {item['masks']:,}"
            corners = " / ".join(f"{value:.2g} m" for value in item["corners_m"])
            ratios = ", ".join(f"{value:.2f}" for value in item["error_over_claim"])
        wrong = f"{item['wrong']}" if right else f"{item['wrong']} of {item['masks']:,}"
        yield f"| {NAMES[kind]} | {right} | {wrong} | {corners} | {ratios} | {item['cpu_s'][0]:.2g} |"


def worn_table() -> Iterator[str]:
    """Yield the lines of the table of worn masks, from the searches of `examples/trust`."""
    yield "| | full effort: located right | seconds, median / 95 % | quick effort: located right | seconds | wrong |"
    yield "|---|---|---|---|---|---|"
    for kind, name in WORN.items():
        cells, wrong = [], 0
        for effort in ("full", "quick"):
            (path,) = SEARCHES.glob(f"{effort}_*.csv")
            with path.open(encoding="utf-8", newline="") as file:
                rows = [row for row in csv.DictReader(file) if (row["kind"], row["worn"]) == ("there", kind)]
            reported = [row for row in rows if float(row["score"]) >= NEEDED]
            right = [float(row["seconds"]) for row in reported if row["right"] == "1"]
            wrong += len(reported) - len(right)
            cells += [f"{len(right)} of {len(rows)}", "{:.2f} / {:.1f}".format(*np.nanpercentile(right, (50, 95)))]
        yield f"| {name} | {' | '.join(cells)} | {wrong} |"


def trust_table() -> Iterator[str]:
    """Yield the lines of the table of scores: of each kind of query, how many places were reported, how many wrong."""
    yield "| query | score | reported | wrong |"
    yield "|---|---|---|---|"
    for kind in ERROR_RATES:
        rates = counted(kind)
        for rate, above in zip(rates, [*rates[1:], None], strict=True):
            band = f"{rate.score:g} and more" if above is None else f"{rate.score:g} to {above.score:g}"
            yield f"| {kind} | {band} | {rate.reported:,} | {rate.wrong} (at most {100 * rate.at_most:.3g} %) |"


def counted(kind: Kind) -> list[ErrorRate]:
    """Count `ERROR_RATES` of a kind anew, in its bands."""
    searches, edges = reported(kind), [*(rate.score for rate in ERROR_RATES[kind]), math.inf]
    rights = [[right for score, right in searches if low <= score < high] for low, high in pairwise(edges)]
    return [
        ErrorRate(score, len(band), band.count(False), results.interval(band.count(False), len(band))[1])
        for score, band in zip(edges, rights, strict=False)
    ]


def reported(kind: Kind) -> list[tuple[float, bool]]:
    """Return the score of each place of that kind that was reported, and whether it was right."""
    if kind == "mask":
        rows = [row for path in sorted(SEARCHES.glob("*.csv")) for row in results.read(path)]
        return [(float(row["score"]), row["right"] == "1") for row in rows if float(row["score"]) >= NEEDED]
    if kind == "photograph":
        kept = results.read(EXAMPLES / "photographs" / "results" / "photographs.csv")
        rows = [row for row in kept if row["mode"] in ("blind", "told", "elsewhere")]
    else:
        kept = results.read(EXAMPLES / "company" / "results" / f"{'soft' if kind == 'soft mask' else 'told'}.csv")
        rows = [row for row in kept if row["seed"] not in SETTLED_ON]
    return [(float(row["score"]), row["right"] == "1") for row in rows if row["status"] == "located"]


def photographs_table() -> Iterator[str]:
    """Yield the lines of the table of photographs."""
    yield from photographs.count(EXAMPLES / "photographs" / "results" / "photographs.csv").splitlines()


def company_table() -> Iterator[str]:
    """Make the table of masks in company: each set, each kind."""
    for name in COMPANY:
        head, rule, *rows = company.count(EXAMPLES / "company" / "results" / f"{name}.csv").splitlines()
        yield from (head, rule) if name == COMPANY[0] else ()
        for row in rows:
            kind, rest = row.removeprefix("| ").split(" | ", 1)
            frame, mirrored, _ = kind.partition(", mirrored")
            yield f"| {name}: {NAMES.get(frame, frame).partition(':')[0]}{mirrored} | {rest}"


def peers_table() -> Iterator[str]:
    """Yield the lines of the table of the authors' programs, on maps of 10 x 10 km."""
    rows = results.read(join.FOLDER / "joined.csv")
    yield from results.table(join.HEAD, join.table(rows, "10")).splitlines()


def put(page: str, name: str, lines: Iterator[str]) -> str:
    """Return the page with another table between the comments of that name."""
    table = "\n".join(lines)
    found = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
    if not found.search(page):
        raise SystemExit(f"Error: {PAGE} has no table {name}; expected <!-- {name} --> and <!-- end --> around it")
    return found.sub(lambda match: match[1] + table + match[2], page)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args(arguments)
    before = page = PAGE.read_text(encoding="utf-8")
    page = put(page, "bench", bench_table(json.loads(BENCH.read_text(encoding="utf-8"))))
    tables = {"worn": worn_table, "photographs": photographs_table, "company": company_table}
    tables |= {"peers": peers_table, "trust": trust_table}
    for name, table in tables.items():
        page = put(page, name, table())
    if options.check and page != before:
        raise SystemExit(f"Error: the tables of {PAGE.name} are out of date; run python examples/tables.py")
    if not options.check:
        PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
