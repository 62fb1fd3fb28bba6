"""Every public kernel has a slow twin that a test compares it with, or there is a reason why not."""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import naive

from roadgeo import kernels
from roadgeo.kernels.compilation import Kernel

#: Twins of other names: of one item where the kernel does all, or of what the kernel's result is made of.
TWINS = {
    "count_inliers": "evaluate_pairs",
    "find_cuts": "cut_edge",
    "describe_intersections": "merge_lines",
    "find_sides": "sides_of",
    "fit_branches": "fit_branch",
    "find_twins": "are_twins",
    "orient": "shape_of",
    "paint_roads": "bits_at",
    "passes": "word_at",
    "point_row": "see_rows",
    "smooth_chains": "smooth_chain",
    "tie_runs": "runs",
    "vertex_probes": "alike",
    "vote": "beyond_chance",
    "improve_votes": "hits",
    "draw_rings": "rings_around",
    "mark_rings": "marks_of",
    "passing": "word_at",
}

#: What a test calls instead of a kernel that it compares.
CALLS = {
    "count_inliers": "evaluate_pairs",
    "describe_intersections": "find_intersections",
    "find_cuts": "cut_edges",
    "fit_branches": "find_intersections",
    "grow": "grow_each",
}

#: Why a kernel has none.
REASONS = {
    "add_row": "compared with A^T W A, one line of numpy",
    "spread": "compared with the inverse of the normal matrix, one line of numpy",
    "begin_system": "a test states its case",
    "carry": "compared with the twins of `point_row` and of the Jacobian",
    "cholesky": "compared with numpy.linalg",
    "count_bits": "compared with Python's count of bits",
    "count_neighbours": "part of `fill_table`, whose twin lists the neighbours",
    "count_alike": "compared with the decoded table, counted in the test",
    "grow_each": "calls `grow`, which has a twin, for each proposal",
    "has_both": "a test states its two cases",
    "mark_tiles": "`paint_roads` on what it marks is compared with a twin that knows no tiles",
    "measure_edges": "compared with the lengths that the graph computes",
    "measure_tiles": "compared with numpy's count of bits",
    "neighbour_pair": "`orient`, which has a twin, and two columns exchanged by it; part of `fill_table`",
    "neighbour_steps": "part of thinning and tracing, whose twins use rows and columns",
    "neighbours": "part of thinning and tracing, whose twins use rows and columns",
    "pair_id": "compared with the numbers it counts through, all of them",
    "sample_edges": "compared with shapely's interpolation along lines",
    "solve_cholesky": "compared with numpy.linalg",
    "solve_system": "a test states its two cases",
    "sort_few": "part of `describe_intersections`; rays are tested to ascend",
    "straighten": "compared with `geometry.lens`",
    "touches_solid": "part of thinning and tracing, whose twins use rows and columns",
    "triple_codes": "three calls of `vertex_codes`, which has a twin",
    "turn_bits": "a test follows every bit",
    "turned": "part of `vertex_codes`, which has a twin",
}


def public_kernels() -> list[str]:
    modules = [
        importlib.import_module(f"roadgeo.kernels.{module.name}") for module in pkgutil.iter_modules(kernels.__path__)
    ]
    found = {
        name
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, Kernel) and name[0] != "_"
    }
    return sorted(found)


def twins() -> dict[str, object]:
    modules = [importlib.import_module(f"naive.{module.name}") for module in pkgutil.iter_modules(naive.__path__)]
    return {name: value for module in modules for name, value in inspect.getmembers(module, inspect.isfunction)}


USES = "\n".join(path.read_text() for path in Path(__file__).parents[1].rglob("test_*.py") if path != Path(__file__))
WORDS, OF_TWINS = set(re.findall(r"\w+", USES)), set(re.findall(r"\bnaive\.(\w+)", USES))


def test_every_kernel_has_a_twin_or_a_reason() -> None:
    kernels_and_twins = {kernel: TWINS.get(kernel, kernel) for kernel in public_kernels()}
    with_twins = {kernel for kernel, twin in kernels_and_twins.items() if twin in twins()}
    assert with_twins ^ set(REASONS) == set(kernels_and_twins), (
        "a slow twin in tests/naive, or a reason why there is none"
    )
    assert {TWINS.get(kernel, kernel) for kernel in with_twins} <= OF_TWINS
    assert {CALLS.get(kernel, kernel) for kernel in with_twins} <= WORDS


def test_reasons_are_of_kernels() -> None:
    assert set(REASONS) | set(TWINS) <= set(public_kernels())
