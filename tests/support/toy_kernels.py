"""Kernels that take and return every kind of value, for tests of how kernels are compiled and called."""

from typing import NamedTuple

import numpy as np

from roadgeo.kernels.arrays import Floats1, Floats2, Ints1
from roadgeo.kernels.compilation import kernel


class Line(NamedTuple):
    """Values along a line."""

    start: float
    steps: Ints1


@kernel()
def weigh(values: Floats2, factor: float, double: bool, power: int) -> float:
    """Sum up values."""
    total = 0.0
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            total += values[i, k] ** power
    return total * factor * (2.0 if double else 1.0)


@kernel(writes=("out",))
def walk(line: Line, out: Floats1) -> None:
    """Fill in where steps lead."""
    at = line.start
    for i in range(line.steps.shape[0]):
        at += line.steps[i]
        out[i] = at


@kernel()
def spread(values: Floats1) -> tuple[int, bool, Floats2, tuple[float, Ints1]]:
    """Return everything at once."""
    grid = np.empty((values.shape[0], 2))
    order = np.zeros(values.shape[0], np.int64)
    for i in range(values.shape[0]):
        grid[i, 0], grid[i, 1], order[i] = values[i], -values[i], i
    return values.shape[0], values.shape[0] > 2, grid, (values.sum(), order)


@kernel()
def share(values: Floats1, parts: int) -> int:
    """Divide, by zero too."""
    return values.shape[0] // parts
