"""The photographs and their road masks, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.morphology import skeletonize

__all__ = ["Bytes", "Floats", "Tile", "fold_of", "read_tiles", "truth_of", "unobserved"]

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Tile:
    """A photograph and its labels. Dimensions: H rows, W columns."""

    name: str
    photo: Bytes  # (H, W, 3) RGB
    truth: Bytes  # (H, W, 5), 0 to 255: see `truth_of`

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(H, W): whether there is a photograph."""
        return self.truth[..., 1] > 127

    @property
    def road(self) -> NDArray[np.bool_]:
        """(H, W): whether the map shows a road."""
        return self.truth[..., 0] > 127


def read_tiles(folder: Path, limit: int | None = None) -> list[Tile]:
    """Read `images/NAME.jpg` (or .tif, .png) with `masks/NAME.png`, in order of name."""
    photos = sorted(p for p in (folder / "images").iterdir() if p.suffix.lower() in {".jpg", ".jpeg", ".png", ".tif"})
    if not photos:
        raise SystemExit(f"{folder}/images: holds no photographs; expected NAME.jpg, .png or .tif")
    return [_read(path, folder / "masks" / f"{path.stem}.png") for path in photos[:limit]]


def fold_of(index: int, folds: int) -> int:
    """Return the fold that holds out the tile of this index: tiles are dealt out in order of their names."""
    return index % folds


def truth_of(road: NDArray[np.bool_], observed: NDArray[np.bool_], known: NDArray[np.bool_]) -> Bytes:
    """Return (H, W, 5), 0 or 255: road, observed, centre lines, nearness to an intersection (0 to 255), and known.

    Where it is not known whether there is a road, nothing is learnt.
    """
    centre = skeletonize(road)
    thick = cv2.dilate(centre.astype(np.uint8), np.ones((3, 3), np.uint8))
    layers = [road * 255, observed * 255, thick * 255, _near_intersections(centre), known * 255]
    return np.dstack(layers).astype(np.uint8)


def unobserved(photo: Bytes, least_area: int = 20_000) -> NDArray[np.bool_]:
    """Return (H, W) where the photograph is a large plain white or black area, where no ground is shown."""
    void = np.zeros(photo.shape[:2], bool)
    for plain in (photo.min(axis=2) >= 250, photo.max(axis=2) <= 3):
        opened = cv2.morphologyEx(plain.astype(np.uint8), cv2.MORPH_OPEN, np.ones((15, 15), np.uint8))
        n, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
        void |= np.isin(labels, [i for i in range(1, n) if stats[i, cv2.CC_STAT_AREA] >= least_area])
    return void


def _read(photo_path: Path, mask_path: Path) -> Tile:
    photo, mask = cv2.imread(str(photo_path), cv2.IMREAD_COLOR), cv2.imread(str(mask_path), cv2.IMREAD_GRAYSCALE)
    if photo is None or mask is None or photo.shape[:2] != mask.shape:
        raise SystemExit(f"{photo_path}: needs a mask of the same size, {mask_path}")
    photo = cv2.cvtColor(photo, cv2.COLOR_BGR2RGB)
    # JPEG smears the edge of the void over a few pixels.
    observed = ~cv2.dilate(unobserved(photo).astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    return Tile(photo_path.stem, photo, truth_of(mask > 127, observed, np.ones_like(observed)))


def _near_intersections(centre: NDArray[np.bool_], sigma: float = 5.0) -> NDArray[np.float32]:
    """Return 255 at intersections of the centre lines, falling off as a Gaussian of `sigma` px."""
    neighbours = cv2.filter2D(centre.astype(np.uint8), -1, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT)
    forks = (centre & (neighbours >= 4)).astype(np.uint8)
    _, _, _, centroids = cv2.connectedComponentsWithStats(cv2.dilate(forks, np.ones((7, 7), np.uint8)))
    elsewhere = np.full(centre.shape, 255, np.uint8)
    for x, y in np.rint(centroids[1:]).astype(int):
        elsewhere[y, x] = 0
    distance = np.minimum(cv2.distanceTransform(elsewhere, cv2.DIST_L2, 5), 10 * sigma)  # far where there is no road
    return 255 * np.exp(-0.5 * (distance / sigma) ** 2)
