"""Change one thing at a time in the geometry core; its tests must notice.

    python tests/support/mutate.py [MODULE ...] [--sample 100]

Operators, comparisons, numbers, conditions and returned values inside functions of `roadgeo.geometry` (homography,
frame, camera, pinhole) are changed one after another, and the tests of these modules run on each mutant until one
fails. Tests are collected once; each mutant lives in a fork. Prints each mutant, and one JSON object.
"""

import argparse
import ast
import contextlib
import copy
import importlib
import io
import json
import os
import random
import signal
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
MODULES = ("homography", "frame", "camera", "pinhole")
SECONDS = 120

SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.USub: ast.UAdd,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.MatMult: ast.Mult,
}


def changes(node: ast.AST) -> Iterator[tuple[str, Any]]:
    """Yield what to call each change of a node, and the value of its field `op`, `ops`, `value` or `test`."""
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.UnaryOp | ast.AugAssign) and type(node.op) in SWAPS:
        yield "op", SWAPS[type(node.op)]()
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        yield "ops", [SWAPS[type(node.ops[0])](), *node.ops[1:]]
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield "value", not node.value if isinstance(node.value, bool) else node.value + 1
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield "test", ast.UnaryOp(ast.Not(), node.test)
    if isinstance(node, ast.Return) and node.value is not None and not isinstance(node.value, ast.Constant):
        yield "value", ast.Constant(None)


def inside_functions(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes of function bodies, without annotations, decorators, defaults and docstrings."""
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        for statement in function.body:
            for node in ast.walk(statement):
                if not isinstance(node, ast.FunctionDef):
                    yield node


def mutants(source: str) -> Iterator[tuple[str, ast.Module]]:
    """Yield every mutant of a module, with where and what was changed."""
    tree = ast.parse(source)
    nodes = list(dict.fromkeys(inside_functions(tree)))
    for node in nodes:
        for field, value in changes(node):
            kept = getattr(node, field)
            before = ast.unparse(node)
            setattr(node, field, value)
            ast.fix_missing_locations(tree)
            yield f"{node.lineno}: {before[:60]} -> {ast.unparse(node)[:60]}", copy.deepcopy(tree)
            setattr(node, field, kept)


def codes(code: types.CodeType) -> Iterator[tuple[str, types.CodeType]]:
    """Yield the code of functions by their qualified names."""
    for co_const in code.co_consts:
        if isinstance(co_const, types.CodeType):
            yield co_const.co_qualname, co_const
            yield from codes(co_const)


def install(module: types.ModuleType, tree: ast.Module) -> None:
    """Give a module's functions, wherever they were imported to, the code of a mutant."""
    mutated = dict(codes(compile(tree, str(module.__file__), "exec")))
    owners = [module, *(value for value in vars(module).values() if isinstance(value, type))]
    for owner in owners:
        for value in list(vars(owner).values()):
            wrapped = [getattr(value, name, None) for name in ("fget", "__func__", "func")]
            for function in (value, *wrapped):
                inner = getattr(function, "__wrapped__", function)
                if isinstance(inner, types.FunctionType) and inner.__module__ == module.__name__:
                    inner.__code__ = mutated.get(inner.__qualname__, inner.__code__)


class Loop:
    """A plugin of pytest: runs the collected tests on each mutant in place of once."""

    def __init__(self, names: list[str], sample: int, seed: int) -> None:
        self.found: list[tuple[str, bool]] = []
        self.jobs = [
            (importlib.import_module(f"roadgeo.geometry.{name}"), where, tree)
            for name in names
            for where, tree in mutants((ROOT / f"roadgeo/geometry/{name}.py").read_text("utf-8"))
        ]
        self.total = len(self.jobs)
        if sample and sample < self.total:
            self.jobs = random.Random(seed).sample(self.jobs, sample)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        from hypothesis import Phase, settings  # pytest wants to be the first to import it

        settings.register_profile("first failure", settings(phases=[Phase.explicit, Phase.generate]))
        settings.load_profile("first failure")  # what fails need not be made small
        assert self.passes(session, None, None), "the tests must pass before anything is changed"
        for module, where, tree in self.jobs:
            survived = self.passes(session, module, tree)
            self.found.append((f"{module.__name__}:{where}", survived))
            reported = f"{len(self.found)} {'survived' if survived else 'killed'} {module.__name__}:{where}\n"
            os.write(2, reported.encode())
        return True

    def passes(self, session: pytest.Session, module: types.ModuleType | None, tree: ast.Module | None) -> bool:
        """Run the tests in a fork until one fails; what takes too long has failed."""
        child = os.fork()
        if child:
            return os.waitpid(child, 0)[1] == 0
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        status = 1
        items = session.items
        if module is not None:  # the tests of what was changed come first
            items = sorted(items, key=lambda item: not item.path.stem.endswith(module.__name__.rpartition(".")[2]))
        with contextlib.suppress(BaseException):
            if module is not None and tree is not None:
                install(module, tree)
            for n, item in enumerate(items):
                following = items[n + 1] if n + 1 < len(items) else None
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if session.testsfailed:
                    break
            else:
                status = 0
        os._exit(status)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(MODULES))
    parser.add_argument("--sample", type=int, default=0, help="Of all mutants only so many, drawn at random.")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    loop = Loop(options.modules, options.sample, options.seed)
    with contextlib.redirect_stdout(io.StringIO()):
        tests = [str(ROOT / f"tests/geometry/test_{name}.py") for name in MODULES]
        pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests], plugins=[loop])
    killed = sum(not survived for _, survived in loop.found)
    share = round(killed / max(len(loop.found), 1), 3)
    print(json.dumps({"mutants": loop.total, "tried": len(loop.found), "killed": killed, "share": share}))


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    main()
