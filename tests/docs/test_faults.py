"""Each row of docs/faults.md, and each threat in SECURITY.md, names tests that exist."""

import ast
import re

import pytest
from support.documents import ROOT

ROWS = [line for line in (ROOT / "docs/faults.md").read_text("utf-8").splitlines() if line.startswith("| ")][1:]


ROWS += [line for line in (ROOT / "SECURITY.md").read_text("utf-8").splitlines() if re.match(r"\|.*`tests/.*::", line)]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip()[:40])
def test_every_fault_has_a_test(row: str) -> None:
    named = re.findall(r"`(tests/[^`:]+)::(\w+)`", row)
    assert named
    for path, name in named:
        tree = ast.parse((ROOT / path).read_text("utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}, path
