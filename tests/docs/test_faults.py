"""Each row of docs/faults.md, and each threat in SECURITY.md, names tests that exist."""

import ast
import re

from support.documents import ROOT

ROWS = [line for line in (ROOT / "docs/faults.md").read_text("utf-8").splitlines() if line.startswith("| ")][1:]
ROWS += [line for line in (ROOT / "SECURITY.md").read_text("utf-8").splitlines() if re.match(r"\|.*`tests/.*::", line)]


def test_every_fault_has_a_test() -> None:
    named = {row: re.findall(r"`(tests/[^`:]+)::(\w+)`", row) for row in ROWS}
    assert not [row for row, tests in named.items() if not tests]
    tests = {test for row in named.values() for test in row}
    trees = {path: ast.parse((ROOT / path).read_text("utf-8")) for path, _ in tests}
    known = {path: {getattr(node, "name", None) for node in tree.body} for path, tree in trees.items()}
    assert not [f"{path}::{name}" for path, name in tests if name not in known[path]]
