"""The roads around a place as rings of bits: a turn rotates words, and a step of scale moves them to the next ring.

Around a place lie rings whose radii grow in equal ratio, each divided into 64 bearings. Each ring has two words: bits
of the first mark bearings at which a road runs along the bearing, bits of the second mark roads across it. The roads
around two intersections are compared in a few instructions for each ring. (Log-polar bins, as in shape contexts:
Belongie, Malik and Puzicha, PAMI 2002.)
"""

import math

import numpy as np

from roadgeo.kernels.arrays import Floats1, Floats2, Ints1, UInt64s2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.road_raster import DIRECTIONS, Raster, passing

__all__ = ["BEARINGS", "RINGS", "WORDS", "count_bits", "draw_rings", "mark_rings", "turn_bits"]

BEARINGS = 64
RINGS = 32  # loops over a multiple of 8 words are quicker than over fewer
#: Words of a place: first the roads along the bearing, from the innermost ring outwards, then the roads across it.
WORDS = 2 * RINGS


@kernel(writes=("words",))
def draw_rings(cells: Floats2, places: Ints1, radii: Floats1, raster: Raster, words: UInt64s2) -> None:
    """Mark where roads pass around places.

    Parameters
    ----------
    cells : (N, 2) float64
        Places, in cells from the raster's corner; their rings lie inside the raster.
    places : (M,) int64
        Which of them.
    radii : (RINGS,) float64
        Radii of the rings' middles, cells.
    words : (N, WORDS) uint64
        Filled for these. Bit b stands for the bearing (b + 1/2) / 64 of a whole turn, counterclockwise from east.
    """
    east, north = np.empty(BEARINGS), np.empty(BEARINGS)
    along = np.empty(BEARINGS, np.uint32)
    for b in range(BEARINGS):
        bearing = (b + 0.5) * 2.0 * math.pi / BEARINGS
        east[b], north[b] = math.cos(bearing), math.sin(bearing)
        along[b] = 0
        for d in range(DIRECTIONS):
            away = ((d + 0.5) * math.pi / DIRECTIONS - bearing) % math.pi
            if min(away, math.pi - away) < math.pi / 4.0:
                along[b] |= np.uint32(1 << d)
    for j in places:
        x, y = cells[j, 0], cells[j, 1]
        for r in range(RINGS):
            first, second = np.uint64(0), np.uint64(0)
            for b in range(BEARINGS):
                directions = passing(x + radii[r] * east[b], y + radii[r] * north[b], raster)
                first |= np.uint64((directions & along[b]) != 0) << np.uint64(b)
                second |= np.uint64((directions & ~along[b]) != 0) << np.uint64(b)
            words[j, r], words[j, RINGS + r] = first, second


@kernel(writes=("words",))
def mark_rings(rings: Ints1, bearings: Floats1, along: Ints1, own: Ints1, first_own: int, words: UInt64s2) -> None:
    """Mark where road points of the query lie around one of its intersections, at each of S scales.

    Parameters
    ----------
    rings : (P,) int64
        The ring that a point lies in at the smallest scale; each further scale moves it out by a ring.
    bearings : (P,) float64
        Radians.
    along : (P,) int64
        1 where the road runs along the bearing, within 45 degrees, 0 where it runs across.
    own : (P,) int64
        1 for points on possible branches of the intersection itself, which count from ring `first_own` on only.
    words : (S, WORDS) uint64
        Zeros; filled.
    """
    for i in range(rings.shape[0]):
        bit = np.uint64(1) << np.uint64(int(bearings[i] * BEARINGS / (2.0 * math.pi) + BEARINGS) & (BEARINGS - 1))
        start = 0 if along[i] == 1 else RINGS
        for s in range(words.shape[0]):
            r = rings[i] + s
            if 0 <= r < RINGS and (own[i] == 0 or r >= first_own):
                words[s, start + r] |= bit


@kernel(forceinline=True)
def count_bits(word: np.uint64) -> np.uint64:
    """Count the bits that are set; compilers know this form, and make one instruction of it."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel(forceinline=True)
def turn_bits(word: np.uint64, n: int) -> np.uint64:
    """Turn a ring counterclockwise by n bearings."""
    left = np.uint64(n & (BEARINGS - 1))
    return (word << left) | (word >> ((np.uint64(BEARINGS) - left) & np.uint64(BEARINGS - 1)))
