"""Compare two folders of `roadgeo locate --json` lines: the same results, times aside?

    python examples/compare_results.py before after
    python examples/compare_results.py before after --tolerance 1e-6 --ignore stats

Files are paired by name, lines by their query. Prints what differs, the first few of each key, and ends with status 1
if anything does. A tolerance is absolute, for numbers; 0, the default, asks for the same bits.
"""

import argparse
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

#: Values of a key that are shown; the others are counted.
SHOWN = 3


def read_lines(path: Path) -> dict[str, dict[str, Any]]:
    """Return the documents of a file by their query."""
    documents = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("{")]
    return {Path(document["query"]).name: document for document in documents}


def differences(a: Any, b: Any, tolerance: float, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the key and both values of everything that differs in two JSON values."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in [*a, *(name for name in b if name not in a)]:
            yield from differences(a.get(name), b.get(name), tolerance, f"{key}.{name}" if key else name)
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for one, other in zip(a, b, strict=True):
            yield from differences(one, other, tolerance, key)
    elif not _equal(a, b, tolerance):
        yield key, a, b


def _equal(a: Any, b: Any, tolerance: float) -> bool:
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (a, b))
    return a == b or (numbers and (abs(a - b) <= tolerance or (math.isnan(a) and math.isnan(b))))


def compare_files(before: Path, after: Path, tolerance: float, ignored: set[str]) -> int:
    """Print what differs between two files of JSON lines; return how many documents do."""
    old, new = read_lines(before), read_lines(after)
    found: dict[str, list[str]] = {}
    differing = set(old) ^ set(new)
    for query in sorted(set(old) & set(new)):
        one, other = ({k: v for k, v in doc.items() if k not in ignored} for doc in (old[query], new[query]))
        for key, a, b in differences(one, other, tolerance):
            found.setdefault(key, []).append(f"{query}: {a!r} -> {b!r}")
            differing.add(query)
    print(f"{before.name}: {len(set(old) & set(new))} in both, {len(differing)} differ or stand in one only")
    for key, entries in found.items():
        print(f"  {key}: {len(entries)}")
        for entry in entries[:SHOWN]:
            print(f"    {entry[:200]}")
    return len(differing)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--tolerance", type=float, default=0.0)
    parser.add_argument("--ignore", nargs="*", default=[], help="keys left out besides seconds")
    given = parser.parse_args(arguments)
    pairs = [(path, given.after / path.name) for path in sorted(given.before.glob("*.jsonl"))]
    missing = [path.name for path, other in pairs if not other.is_file()]
    for name in missing:
        print(f"{name}: only in {given.before}")
    ignored = {"seconds", *given.ignore}
    differing = sum(compare_files(a, b, given.tolerance, ignored) for a, b in pairs if b.is_file())
    return 1 if differing or missing or not pairs else 0


if __name__ == "__main__":
    raise SystemExit(main())
