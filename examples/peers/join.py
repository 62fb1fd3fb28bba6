"""Join the authors' programs, the paper's matcher and roadgeo on the same queries: python examples/peers/join.py.

Each row of `results/programs.csv`, and of `--method pair` in `results/ours.csv`, whose query roadgeo and correlation
were given too becomes a row of `results/joined.csv`: how far off the place is that each reported, in metres. The table
that is printed counts, for each program and kind of mask, the same queries for all; a place is right within 50 m.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import results

FOLDER = Path(__file__).parent / "results"
QUERY = ("city", "area_km", "kind", "query")
OURS = ("roadgeo", "correlation")
RIGHT_M = 50.0
NAMES = {
    ("v1", "def"): "version 1",
    ("v1", "paper"): "version 1, the paper's thresholds",
    ("v2", "def"): "version 2",
    ("v2", "paper"): "version 2, the paper's thresholds",
    ("plbg", "def"): "geometric hashing",
    ("pair", "def"): "`--method pair`",
}
KINDS = ("clean", "homography", "mild", "noisy")

Row = dict[str, str]


def joined(programs: Sequence[Row], ours: Sequence[Row]) -> Iterator[Row]:
    """Yield the rows of the programs and the pair with our errors on the same query and map; "" where refused."""
    errors = {(row["peer"], *(row[name] for name in QUERY)): error_of(row) for row in ours}
    pairs = [{**row, "params": "def"} for row in ours if row["peer"] == "pair"]
    for row in [*programs, *pairs]:
        keys = {method: (method, *(row[name] for name in QUERY)) for method in OURS}
        if keys["roadgeo"] in errors:
            named = {name: row[name] for name in ("peer", "params", *QUERY)}
            yield {**named, "program": error_of(row), **{name: errors.get(key, "-") for name, key in keys.items()}}


def error_of(row: Row) -> str:
    """Return how far off the reported place is, metres; "" where none is reported."""
    return row["centre_err_m"] if row["found"] == "1" else ""


def counted(rows: Sequence[Row], name: str) -> str:
    """Return "8, 1 wrong" for a column of errors; "-" where a query was not searched for."""
    errors = [row[name] for row in rows]
    if "-" in errors:
        return "-"
    right = sum(error != "" and float(error) <= RIGHT_M for error in errors)
    wrong = sum(error != "" for error in errors) - right
    return f"{right}, {wrong} wrong" if wrong else str(right)


def table(rows: Sequence[Row], area: str) -> Iterator[list[str]]:
    """Yield a line for each program and kind of mask on maps of a size."""
    for (peer, params), name in NAMES.items():
        for kind in KINDS:
            wanted = {"peer": peer, "params": params, "kind": kind, "area_km": area}
            mine = [row for row in rows if all(row[key] == value for key, value in wanted.items())]
            if mine:
                cells = [counted(mine, column) for column in ("program", *OURS)]
                yield [name, kind, str(len(mine)), *cells]


HEAD = ("program", "masks", "number", "right", "roadgeo", "correlation, told heading and scale")


def main() -> None:
    rows = list(joined(results.read(FOLDER / "programs.csv"), results.read(FOLDER / "ours.csv")))
    (FOLDER / "joined.csv").unlink(missing_ok=True)
    for row in rows:
        results.append(FOLDER / "joined.csv", row)
    for area in ("10", "20"):
        print(f"\n{area} x {area} km\n\n{results.table(HEAD, table(rows, area))}")


if __name__ == "__main__":
    main()
