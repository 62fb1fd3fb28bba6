"""Thinning: from road pixels to lines one pixel wide.

Distance-ordered homotopic thinning: pixels are deleted from the border inwards, each at most once, and only where
deleting it changes no connection (a *simple* pixel, foreground 8-connected, background 4-connected). It touches
road pixels only, so its cost grows with the roads, not with the image.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["GROUND", "ROAD", "SIMPLE", "SOLID", "neighbour_steps", "rethin", "thin"]

GROUND = 0  # observed, no road
ROAD = 1
SOLID = 2  # beyond the frame or unobserved: road for all we know, never deleted

LEVELS_PER_PIXEL = 8  # distances are told apart to 1/8 px


def _simple_table() -> NDArray[np.bool_]:
    """Return (256,): whether a pixel with these neighbours (bit k: number k, counterclockwise from east) is simple."""
    table = np.zeros(256, np.bool_)
    for code in range(256):
        n = [(code >> k) & 1 for k in range(8)]
        # Hilditch's crossing number for an 8-connected foreground; 0 means interior or isolated
        crossings = sum((1 - n[k]) & (n[k + 1] | n[(k + 2) % 8]) for k in (0, 2, 4, 6))
        table[code] = crossings == 1
    return table


SIMPLE = _simple_table()


@njit(cache=True)
def neighbour_steps(stride: int) -> NDArray[np.int64]:
    """Flat offsets of the 8 neighbours, counterclockwise from east."""
    return np.array([1, 1 - stride, -stride, -1 - stride, -1, stride - 1, stride, stride + 1], np.int64)


@njit(cache=True)
def _delete_from(
    flat: NDArray[np.uint8], p: int, steps: NDArray[np.int64], table: NDArray[np.bool_], ends_at: NDArray[np.bool_]
) -> bool:
    """Delete pixel `p` where that is allowed, then walk on while a free end of the line can be deleted too."""
    deleted = False
    while True:
        code = 0
        n_road = 0
        n_solid = 0
        last = p
        for k in range(8):
            q = p + steps[k]
            state = flat[q]
            if state != GROUND:
                code |= 1 << k
                if state == ROAD:
                    n_road += 1
                    last = q
                else:
                    n_solid += 1
        if not table[code] or (n_road == 1 and n_solid == 0 and ends_at[p]):
            return deleted
        flat[p] = GROUND
        deleted = True
        if n_road != 1 or n_solid > 0:
            return deleted
        p = last


@njit(cache=True)
def rethin(
    states: NDArray[np.uint8], pixels: NDArray[np.int64], is_end: NDArray[np.bool_], table: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Delete what is simple among `pixels` until nothing is, in place; return the pixels left.

    Parameters
    ----------
    states : (H, W) uint8, C-contiguous
        GROUND, ROAD or SOLID; its outermost rows and columns are not ROAD. Changed in place.
    pixels : (P,) int64
        Flat indices of all ROAD pixels, in the order in which to try them.
    is_end : (H, W) bool
        Where a free end of a line is kept.
    table : (256,) bool
        `SIMPLE`.

    Returns
    -------
    (Q,) int64
    """
    flat = states.ravel()
    ends_at = is_end.ravel()
    steps = neighbour_steps(states.shape[1])
    left = pixels.copy()
    n = len(left)
    changed = True
    while changed:
        changed = False
        kept = 0
        for i in range(n):
            p = left[i]
            if flat[p] == ROAD and _delete_from(flat, p, steps, table, ends_at):
                changed = True
            if flat[p] == ROAD:
                left[kept] = p
                kept += 1
        n = kept
    return left[:n]


@njit(cache=True)
def thin(
    states: NDArray[np.uint8], distance: NDArray[np.float32], min_end_distance: float, table: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Thin the ROAD pixels to lines, in place; return the pixels left.

    Parameters
    ----------
    states : (H, W) uint8, C-contiguous
        As in `rethin`.
    distance : (H, W) float32
        Distance to the nearest GROUND pixel.
    min_end_distance : float
        A free end is kept where the road is at least this deep: bumps on its edge leave no hairs.
    table : (256,) bool
        `SIMPLE`.

    Returns
    -------
    (Q,) int64
        Flat indices of the pixels still ROAD.
    """
    flat = states.ravel()
    depth = distance.ravel()
    deepest = np.float32(0.0)
    for p in range(len(flat)):
        if flat[p] == ROAD and depth[p] > deepest:
            deepest = depth[p]
    start = np.zeros(int(deepest * LEVELS_PER_PIXEL) + 2, np.int64)
    for p in range(len(flat)):
        if flat[p] == ROAD:
            start[int(depth[p] * LEVELS_PER_PIXEL) + 1] += 1
    start = np.cumsum(start)
    order = np.empty(start[-1], np.int64)
    for p in range(len(flat)):
        if flat[p] == ROAD:
            level = int(depth[p] * LEVELS_PER_PIXEL)
            order[start[level]] = p
            start[level] += 1
    return rethin(states, order, distance >= min_end_distance, table)
