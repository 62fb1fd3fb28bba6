"""Train the default segmenter: cross-validation on held-out photographs, then the model on all, as ONNX.

    python train.py DATA --out runs              # all of it
    python train.py DATA --out runs --quick      # the same in a minute, to see that it runs
    python train.py DATA --out runs --only 0     # one fold; --only all: the model on all photographs

DATA holds `images/NAME.jpg` and `masks/NAME.png` of the same size. A run that was cut
short goes on from its checkpoint.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from export import export
from network import AnyRoadNet
from numpy.typing import NDArray
from tiles import Tile, fold_of, read_tiles
from training import RECIPES, TrainingOptions, probabilities, train

SCALES = (1.0, 0.5, 2.0)  # metres per pixel of the held-out photographs that are predicted
RUN_AT = 1.0  # metres per pixel at which the network sees them


def main(arguments: list[str] | None = None) -> None:
    options = _parse(arguments)
    torch.set_num_threads(options.threads)
    tiles = read_tiles(options.data, limit=4 if options.quick else None)
    training = TrainingOptions(
        steps=options.steps,
        batch=options.batch,
        rate=options.rate,
        seed=options.seed,
        device=options.device,
        start=options.start,
        network=options.network,
    )
    if options.quick:
        training = replace(training, steps=8, batch=2, size=128)
    runs = [str(fold) for fold in range(options.folds)] + ["all"]
    for run in [options.only] if options.only else runs:
        if run == "all":
            network = train(
                tiles,
                options.out / "all.pt",
                replace(training, steps=training.steps * (1 if options.quick else options.longer)),
            )
            print("wrote", export(network.cpu(), tiles, options.out / "roads.onnx"))
        else:
            _cross_validate(tiles, int(run), options, training)


def _cross_validate(tiles: list[Tile], fold: int, options: argparse.Namespace, training: TrainingOptions) -> None:
    """Train without a fold's tiles, then write their probability maps: score.py measures them."""
    held_out = [tile for i, tile in enumerate(tiles) if fold_of(i, options.folds) == fold]
    others = [tile for i, tile in enumerate(tiles) if fold_of(i, options.folds) != fold]
    network = train(others, options.out / f"fold{fold}.pt", training)
    for tile in held_out:
        for scale in SCALES:
            _write_map(network, tile, scale, options.out / f"maps_{scale:g}m")


def _write_map(network: AnyRoadNet, tile: Tile, scale: float, folder: Path) -> None:
    """Write TILE.png: the probability of road as grey (0 to 255) and what was observed as alpha."""
    folder.mkdir(parents=True, exist_ok=True)
    photo, observed = resample(tile.photo, scale), resample(tile.truth[..., 1], scale)
    road = (predict(network, photo, scale) * 255).round().astype(np.uint8)
    cv2.imwrite(str(folder / f"{tile.name}.png"), np.dstack([road, road, road, (observed > 127) * np.uint8(255)]))


def predict(network: AnyRoadNet, photo: NDArray[np.uint8], scale: float) -> NDArray[np.float32]:
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
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoints, maps and the model")
    parser.add_argument("--only", help="one run: the number of a fold, or all")
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--network", choices=sorted(RECIPES), default="pretrained", help="what is trained")
    parser.add_argument("--steps", type=int, default=3800, help="of each fold")
    parser.add_argument(
        "--longer", type=int, default=1, help="how many times longer the model on all photographs trains"
    )
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--rate", type=float, default=2e-3, help="largest learning rate")
    parser.add_argument("--start", type=Path, help="checkpoint of another run to begin with, instead of chance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--quick", action="store_true", help="a minute, on four photographs, to see that it runs")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
