"""Move the roads of masks drawn from maps to where photographs show them, for training.

    python align.py DATA runs/maps_1m aligned      # the maps that train.py wrote of held-out photographs
    python train.py DATA --masks aligned --out runs2

Maps are some metres off their photographs, each tile in its own way, a few by ten. A network that has learnt from many
such tiles sees the roads in the middle of where they are drawn, and so tells how far each tile is off. Moved masks are
for training alone: what is held out is measured on the masks as they are.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tiles import read_tiles

FAR = 12  # px that a mask may be off, either way
STEP, REACH = 250, 150.0  # px between the places at which it is asked how far, and how far around them roads count
WHOLE = 4000.0  # px of road that the tile as a whole counts at each of these places
PULL = 30.0  # px more of road that must be seen for each px of the way: where little is known nothing is moved
EACH = 4  # of so many pixels of road one is asked for

Floats = NDArray[np.float64]


def main() -> None:
    options = _parse()
    options.out.mkdir(parents=True, exist_ok=True)
    for tile in read_tiles(options.data):
        seen = cv2.imread(str(options.maps / f"{tile.name}.png"), cv2.IMREAD_UNCHANGED)
        if seen is None or seen.shape[:2] != tile.road.shape:
            raise SystemExit(f"{options.maps}: no map of {tile.name} at 1 m; expected one of every photograph")
        probability = (seen[..., 0] if seen.ndim == 3 else seen) / 255.0
        shifts = find_shifts(tile.road & tile.observed, probability * tile.observed)
        cv2.imwrite(str(options.out / f"{tile.name}.png"), move(tile.truth[..., 0], shifts))
        off = np.linalg.norm(shifts, axis=-1)
        print(f"{tile.name}: moved by {off.mean():.1f} px in the mean, {off.max():.1f} at most")


def find_shifts(road: NDArray[np.bool_], probability: Floats) -> Floats:
    """Return how far roads have to be moved, (rows, columns, 2) in pixels of x and y, at places `STEP` px apart.

    Where most road is seen under the moved roads; few roads nearby follow the tile as a whole.
    """
    (h, w), y_x = road.shape, np.argwhere(road)
    # Drawn at random: every fourth would lie on the same side of a road that is 8 px wide.
    y_x = np.random.default_rng(0).permutation(y_x)[: -(-len(y_x) // EACH)]
    ys, xs = (np.linspace(0, n - 1, max(round(n / STEP), 1) + 1) for n in (h, w))
    near = [np.exp(-((y_x[:, k, None] - at) ** 2) / (2 * REACH**2)) for k, at in enumerate((ys, xs))]
    # Each pixel of road counts at each place, and a little at all of them.
    weights = (near[0][:, :, None] * near[1][:, None]).reshape(len(y_x), -1) + WHOLE / EACH / max(len(y_x), 1)
    padded = np.pad(probability, FAR)
    sums = np.empty((weights.shape[1], 2 * FAR + 1, 2 * FAR + 1))
    for i in range(2 * FAR + 1):
        seen = padded[y_x[:, :1] + i, y_x[:, 1:] + np.arange(2 * FAR + 1)]
        sums[:, i] = weights.T @ seen
    steps = np.arange(-FAR, FAR + 1)
    sums -= PULL / EACH * np.hypot(steps[:, None], steps)
    return np.array([_peak(one) for one in sums]).reshape(len(ys), len(xs), 2)


def move(mask: NDArray[np.uint8], shifts: Floats) -> NDArray[np.uint8]:
    """Return the mask (H, W) with its roads moved."""
    h, w = mask.shape
    n_rows, n_columns, _ = shifts.shape
    # Shifts are given at the corners of cells, not in the middle of pixels, as `cv2.resize` would have it.
    column, row = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    at = (column * (n_columns - 1) / (w - 1), row * (n_rows - 1) / (h - 1))
    dx, dy = (cv2.remap(np.float32(shifts[..., k]), *np.float32(at), cv2.INTER_LINEAR) for k in (0, 1))
    return np.asarray(cv2.remap(mask, column - dx, row - dy, cv2.INTER_LINEAR), np.uint8)


def _peak(sums: Floats) -> Floats:
    """Return the shift (x, y) at which sums are largest, between pixels by a parabola."""
    y, x = np.unravel_index(int(sums.argmax()), sums.shape)
    shift = np.array([x, y], float) - FAR
    if 0 < x < 2 * FAR and 0 < y < 2 * FAR:
        for k, (below, above) in enumerate(((sums[y, x - 1], sums[y, x + 1]), (sums[y - 1, x], sums[y + 1, x]))):
            bend = below + above - 2 * sums[y, x]
            shift[k] += 0.5 * (below - above) / bend if bend < 0 else 0.0
    return shift


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with images/ and masks/")
    parser.add_argument("maps", type=Path, help="a folder of maps at 1 m that train.py wrote, of every photograph")
    parser.add_argument("out", type=Path, help="folder for the moved masks")
    return parser.parse_args()


if __name__ == "__main__":
    main()
