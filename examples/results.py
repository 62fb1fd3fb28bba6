"""Results as a CSV file with a row for each case, and their counts, for several examples."""

from __future__ import annotations

import csv
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

Row = Mapping[str, Any]


def commit() -> str:
    """Name the commit of this checkout, with a + where files differ from it; "" where there is no git."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=7", "--dirty=+"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def read(path: Path) -> list[dict[str, str]]:
    """Read the rows of a file; none where there is no such file."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def append(path: Path, row: Row) -> None:
    """Add a row to a file, below its header."""
    is_new = not path.is_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def holds(path: Path, key: Row) -> bool:
    """Whether a file has a row with these values, from a run that was stopped."""
    return any(all(row[name] == str(value) for name, value in key.items()) for row in read(path))


def share(hits: int, of: int) -> str:
    """Return "15 of 18 (59 to 96 %)": the 95 % interval of Clopper and Pearson (Biometrika 26, 1934)."""
    if of == 0:
        return "-"
    low, high = interval(hits, of)
    return f"{hits} of {of} ({100 * low:.0f} to {100 * high:.0f} %)"


def interval(hits: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of Clopper and Pearson for a share."""
    bounds = binomtest(hits, of).proportion_ci(method="exact") if of else (0.0, 1.0)
    return bounds[0], bounds[1]


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
