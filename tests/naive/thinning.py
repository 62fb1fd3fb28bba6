"""Slow, obvious twins of `roadgeo.kernels.thinning`."""

import numpy as np
from scipy import ndimage

GROUND, ROAD, SOLID = 0, 1, 2
EIGHT = np.ones((3, 3), bool)


def is_simple(states, row, column):
    """Whether a pixel may become ground without joining or parting anything, by counting pieces around it."""
    around = states[row - 1 : row + 2, column - 1 : column + 2] != GROUND
    around[1, 1] = False
    pieces = ndimage.label(around, EIGHT)[1]
    ground = ~around
    ground[1, 1] = False
    labels = ndimage.label(ground)[0]  # 4-connected
    beside = {labels[r, c] for r, c in ((0, 1), (1, 0), (1, 2), (2, 1))} - {0}
    return pieces == 1 and len(beside) == 1


def n_neighbours(states, row, column):
    return np.count_nonzero(states[row - 1 : row + 2, column - 1 : column + 2]) - 1


def thin(states, distance, min_end_depth):
    """Thin in place, the shallow pixels first, over and over until nothing changes; return the flat indices left."""
    rows, columns = np.nonzero(states == ROAD)
    order = np.argsort((np.minimum(distance[rows, columns], 4096) * 8).astype(int), kind="stable")
    pixels = [(int(rows[i]), int(columns[i])) for i in order]
    first = changed = True
    while changed:
        changed = first
        for row, column in pixels:
            while states[row, column] == ROAD and is_simple(states, row, column):
                n = n_neighbours(states, row, column)
                near = (slice(row - 1, row + 2), slice(column - 1, column + 2))
                is_pair = first and n == 2 and distance[row, column] == distance[near][states[near] != GROUND].max()
                if distance[row, column] >= min_end_depth and (n == 1 or is_pair):
                    break
                states[row, column] = GROUND
                changed = True
                if n > 1:
                    break
                step = np.argwhere(states[near] != GROUND)[0] - 1
                row, column = row + int(step[0]), column + int(step[1])
                if n_neighbours(states, row, column) > 1:
                    break
        first = False
    return [r * states.shape[1] + c for r, c in pixels if states[r, c] == ROAD]
