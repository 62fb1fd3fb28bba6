"""A mask of a street grid, bent so that no two streets end alike, or straight as in a lattice."""

import cv2
import numpy as np


def street_grid(size: int, first: int, spacing: int, width: int, seed: int = 0, straight: bool = False) -> np.ndarray:
    """Streets (255) across and along a square of `size` pixels, the first of them at `first`."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size), np.uint8)
    for offset in range(first, size, spacing):
        for turn in (False, True):
            across = np.linspace(-50, size + 50, 8)
            along = offset + (0.0 if straight else 1.0) * rng.uniform(-15, 15, 8)
            line = np.stack((along, across) if turn else (across, along), axis=1)
            cv2.polylines(image, [np.rint(line).astype(np.int32)], False, 255, width)
    return image
