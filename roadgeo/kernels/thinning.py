"""Thinning: from road pixels to lines one pixel wide.

Distance-ordered homotopic thinning: pixels are deleted from the border inwards, each at most once, and only where
deleting it changes no connection (a *simple* pixel, foreground 8-connected, background 4-connected). It touches
road pixels only, so its cost grows with the roads, not with the image.
"""

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Bytes2, Int32s1, Singles2
from roadgeo.kernels.compilation import kernel

__all__ = ["GROUND", "ROAD", "SOLID", "neighbour_steps", "neighbours", "shallow_first", "thin", "touches_solid"]

GROUND = 0  # observed, no road
ROAD = 1
SOLID = 2  # beyond the frame or unobserved: road for all we know, never deleted

#: Roles of a pixel by its neighbours: not simple; simple; a free end of a line; simple with two neighbours that touch.
KEEP, DELETE, TIP, CORNER = 0, 1, 2, 3

LEVELS_PER_PIXEL = 8  # distances differ from 1/8 px on
DEEPEST = np.float32(4096.0)  # and not beyond this: without any GROUND they are infinite


def _roles() -> NDArray[np.uint8]:
    """Return (256,): the role of a pixel with these neighbours.

    Bit k of the index is neighbour k, counterclockwise from east. A pixel is simple where its neighbours form one
    8-connected piece and one of the four next to it is ground (crossing number 1, Yokoi et al. 1975).
    """
    roles = np.full(256, KEEP, np.uint8)
    for code in range(256):
        n = [code >> k & 1 for k in range(8)]
        if sum((1 - n[k]) & (n[k + 1] | n[(k + 2) % 8]) for k in (0, 2, 4, 6)) == 1:
            roles[code] = {1: TIP, 2: CORNER}.get(sum(n), DELETE)
    return roles


ROLES = _roles()


@kernel()
def neighbours(flat: NDArray[np.uint8], p: np.uint64, stride: np.uint64) -> np.uint8:
    """Return one bit for each neighbour that is not GROUND, counterclockwise from east."""
    return np.uint8(
        (flat[p + np.uint64(1)] != GROUND)
        | (flat[p - stride + np.uint64(1)] != GROUND) << 1
        | (flat[p - stride] != GROUND) << 2
        | (flat[p - stride - np.uint64(1)] != GROUND) << 3
        | (flat[p - np.uint64(1)] != GROUND) << 4
        | (flat[p + stride - np.uint64(1)] != GROUND) << 5
        | (flat[p + stride] != GROUND) << 6
        | (flat[p + stride + np.uint64(1)] != GROUND) << 7
    )


@kernel()
def touches_solid(flat: NDArray[np.uint8], p: np.uint64, stride: np.uint64) -> bool:
    """Return whether a neighbour of pixel `p` is SOLID."""
    above = flat[p - stride] | flat[p - stride - np.uint64(1)] | flat[p - stride + np.uint64(1)]
    below = flat[p + stride] | flat[p + stride - np.uint64(1)] | flat[p + stride + np.uint64(1)]
    return bool((above | below | flat[p - np.uint64(1)] | flat[p + np.uint64(1)]) & SOLID)


@kernel()
def neighbour_steps(stride: int) -> NDArray[np.uint64]:
    """Return the (8,) steps in flat indices from a pixel's north-western neighbour to all, counterclockwise from east.

    Neighbour k of pixel p is `p - stride - 1 + steps[k]`. None is negative: indices here are unsigned, so that numba
    leaves out the check for negative ones.
    """
    below = 2 * stride
    return np.array([stride + 2, 2, 1, 0, stride, below, below + 1, below + 2]).astype(np.uint64)


@kernel()
def _is_ridge(
    flat: NDArray[np.uint8], depth: NDArray[np.float32], p: np.uint64, back: np.uint64, steps: NDArray[np.uint64]
) -> bool:
    """Return whether no neighbour that is left lies deeper than pixel `p`; `back` leads to the north-west one."""
    for k in range(8):
        q = p - back + steps[k]
        if flat[q] != GROUND and depth[q] > depth[p]:
            return False
    return True


def shallow_first(states: NDArray[np.uint8], distance: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return the flat indices of all ROAD pixels in the order of `distance` (see `thin`), in eighths of a pixel."""
    pixels = np.flatnonzero(states == ROAD).astype(np.int32)
    level = (np.minimum(distance.ravel()[pixels], DEEPEST) * LEVELS_PER_PIXEL).astype(np.uint16)
    return pixels[np.argsort(level, kind="stable")]


@kernel(writes=("states",))
def thin(states: Bytes2, distance: Singles2, pixels: Int32s1, min_end_depth: float, keep_pairs: bool) -> Int32s1:
    """Delete simple pixels among `pixels` until none is left, in place; return the pixels left.

    Parameters
    ----------
    states : (H, W) uint8
        GROUND, ROAD or SOLID; its outermost rows and columns are not ROAD. Changed in place.
    distance : (H, W) float32
        Distance to the nearest GROUND pixel, before thinning.
    pixels : (P,) int32
        Flat indices that hold all ROAD pixels, in the order in which to try them; others are left out.
    min_end_depth : float
        A free end of a line is kept where the road is at least this deep: bumps on its edge leave no hairs.
    keep_pairs : bool
        Keep free ends of lines two pixels wide in the first round, too: else such lines would vanish from their ends.
    """
    flat = states.ravel()
    depth = distance.ravel()
    stride = np.uint64(states.shape[1])
    back, steps = stride + np.uint64(1), neighbour_steps(states.shape[1])
    left = pixels.copy()
    n = len(left)
    changed = True
    while changed:
        changed = keep_pairs
        kept = 0
        for i in range(n):
            p = np.uint64(left[i])
            if flat[p] != ROAD:
                continue
            role = ROLES[neighbours(flat, p, stride)]
            if (
                role == KEEP
                or (role == TIP and depth[p] >= min_end_depth)
                or (
                    keep_pairs
                    and role == CORNER
                    and depth[p] >= min_end_depth
                    and _is_ridge(flat, depth, p, back, steps)
                )
            ):
                left[kept] = left[i]
                kept += 1
                continue
            changed = True
            flat[p] = GROUND
            while role == TIP:  # follow a line that is eaten from its end
                for k in range(8):
                    if flat[p - back + steps[k]] != GROUND:
                        p = p - back + steps[k]
                        break
                role = ROLES[neighbours(flat, p, stride)]
                if flat[p] != ROAD or role != TIP or depth[p] >= min_end_depth:
                    break
                flat[p] = GROUND
        keep_pairs = False
        n = kept
    return left[:n].copy()
