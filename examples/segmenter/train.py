"""Train the road segmenter on photographs and painted scenes: on all, or without a fold that is held out.

    python train.py DATA --streets streets.npz --out runs --only all     # the network that ships: runs/all.pt
    python train.py DATA --streets streets.npz --out runs --only 0       # without every third photograph; their maps
    python train.py DATA --out runs --quick --only 0                     # in a minute, to see that it runs

DATA holds `images/NAME.jpg` and `masks/NAME.png` of the same size; streets.npz comes from `cut_streets.py`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from network import RoadNet
from numpy.typing import NDArray
from painting import Streets
from tiles import Tile, fold_of, read_tiles
from training import TrainingOptions, probabilities, train

SCALES = (1.0, 0.5, 2.0)  # metres per pixel of the held-out photographs that are predicted
RUN_AT = 1.0  # metres per pixel at which the network sees them


def main(arguments: list[str] | None = None) -> None:
    options = _parse(arguments)
    cv2.setNumThreads(1)  # before anything is read: processes that paint are forked, and would wait for its threads
    torch.set_num_threads(options.threads)
    tiles = read_tiles(options.data, limit=4 if options.quick else None)
    streets = Streets.read(options.streets) if options.streets else None
    training = TrainingOptions(
        minutes=options.minutes,
        batch=options.batch,
        rate=options.rate,
        seed=options.seed,
        device=options.device,
        workers=options.workers,
        marks=tuple(options.marks),
    )
    if options.quick:
        training = replace(training, steps=8, batch=2, size=128, scenes=4)
    for run in options.only.split(","):
        fold = None if run == "all" else int(run)
        learnt = [tile for i, tile in enumerate(tiles) if fold_of(i, options.folds) != fold]
        network = train(learnt, streets, options.out / ("all.pt" if fold is None else f"fold{fold}.pt"), training)
        held_out = [tile for i, tile in enumerate(tiles) if fold_of(i, options.folds) == fold]
        for tile in held_out if options.maps else ():
            for scale in SCALES:
                _write_map(network, tile, scale, options.out / f"maps_{scale:g}m")


def _write_map(network: RoadNet, tile: Tile, scale: float, folder: Path) -> None:
    """Write TILE.png: the probability of road as grey (0 to 255) and the observed pixels as alpha."""
    folder.mkdir(parents=True, exist_ok=True)
    photo, observed = resample(tile.photo, scale), resample(tile.truth[..., 1], scale)
    road = (predict(network, photo, scale) * 255).round().astype(np.uint8)
    cv2.imwrite(str(folder / f"{tile.name}.png"), np.dstack([road, road, road, (observed > 127) * np.uint8(255)]))


def predict(network: RoadNet, photo: NDArray[np.uint8], scale: float) -> NDArray[np.float32]:
    """Return the probability of road in a photograph of `scale` metres per pixel: (H, W), as the photograph."""
    h, w = photo.shape[:2]
    kind = cv2.INTER_AREA if scale < RUN_AT else cv2.INTER_CUBIC
    seen = cv2.resize(photo, (round(w * scale / RUN_AT), round(h * scale / RUN_AT)), interpolation=kind)
    return cv2.resize(probabilities(network, seen), (w, h), interpolation=cv2.INTER_LINEAR)


def resample(image: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    """Return an image of 1 m pixels in pixels of `scale` metres."""
    kind = cv2.INTER_AREA if scale > 1 else cv2.INTER_CUBIC
    return cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=kind) if scale != 1 else image


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with images/ and masks/")
    parser.add_argument("--streets", type=Path, help="streets of painted scenes; default: none are painted whole")
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoints and maps")
    parser.add_argument("--only", default="0,1,2,all", help="runs: numbers of folds that are held out, and all")
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=9.0, help="of each run")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rate", type=float, default=2e-3, help="largest learning rate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0, help="processes that paint")
    parser.add_argument("--marks", type=float, nargs="+", default=[1.0], help="shares of the time to keep weights at")
    parser.add_argument("--no-maps", dest="maps", action="store_false", help="no maps of the held-out photographs")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--quick", action="store_true", help="a minute, on four photographs, to see that it runs")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
