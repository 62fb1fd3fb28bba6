"""Measure the whole line, photograph to place, on held-out photographs.

    python locate.py DATA --roads roads_from_labels.parquet --work measured [--model runs/fold0.onnx]

Each held-out photograph is shown whole at 1, 0.5 and 2 m per pixel, as its better half, and as a tilted and turned
camera would see it; the size of the pixels is unknown. Its true mask, cut and turned alike, shows how much could be
located at all. With --elsewhere REFERENCE the photographs are looked for on a map that they do not lie on, too.
Results are kept in --work: a run that was cut short goes on.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from score import ROADGEO, read_places
from tiles import Tile, fold_of, read_tiles

VIEWS = ("1 m", "0.5 m", "2 m", "half", "perspective")
RIGHT_M, WRONG_M = 5.0, 50.0  # of the middle of the frame, which may lie where nothing was seen
SIDE = 1200  # pixels of a view in perspective
Matrix = NDArray[np.float64]


def main() -> None:
    options = _parse()
    tiles = [tile for i, tile in enumerate(read_tiles(options.data)) if fold_of(i, options.folds) == options.fold]
    reference = options.work / "roads.gpkg"
    if not reference.exists():
        options.work.mkdir(parents=True, exist_ok=True)
        _roadgeo("index", "--roads", options.roads, "--out", reference, "-q")
    places = read_places(options.data, reference)
    print("| view | true masks within 5 m | photographs within 5 m | of those | 5 to 50 m | wrong | elsewhere |")
    print("|---|---|---|---|---|---|---|")
    for view in VIEWS:
        print(_measure(view, tiles, reference, places, options), flush=True)


def _measure(
    view: str, tiles: list[Tile], reference: Path, places: dict[str, tuple[float, float]], options: argparse.Namespace
) -> str:
    """Return a row of the table."""
    folder = options.work / view.replace(" ", "_")
    views = {tile.name: view_of(tile, view) for tile in tiles}
    for tile in tiles:
        _write(tile, *views[tile.name], folder)
    segmenter = ["--segmenter", options.model] if options.model else []
    true = _locate(folder / "masks", folder / "true", reference, [])
    seen = _locate(folder / "photos", folder / "seen", reference, segmenter)
    right = {kind: _judge(found, views, places) for kind, found in (("true", true), ("seen", seen))}
    elsewhere = 0
    for other in options.elsewhere:
        found = _locate(folder / "photos", folder / f"on_{other.stem}", other, segmenter)
        elsewhere += sum(result["status"] == "located" for result in found.values())
    both = [name for name, off in right["true"].items() if max(off, right["seen"].get(name, np.inf)) <= RIGHT_M]
    n_true, n_seen = (sum(off <= RIGHT_M for off in result.values()) for result in right.values())
    coarse = sum(RIGHT_M < off <= WRONG_M for off in right["seen"].values())
    wrong = sum(off > WRONG_M for off in right["seen"].values())
    counts = f"{n_seen} | {len(both)} of {n_true} | {coarse} | {wrong} | {elsewhere}"
    return f"| {view} | {n_true} of {len(tiles)} | {counts} |"


def view_of(tile: Tile, view: str) -> tuple[Matrix, tuple[int, int]]:
    """Return a homography (3, 3) from the tile's pixels to a view's, and the view's width and height."""
    height, width = tile.observed.shape
    if view.endswith("m"):
        scale = 1 / float(view.split()[0])
        return np.diag([scale, scale, 1.0]), (round(width * scale), round(height * scale))
    if view == "half":
        halves = [
            (0, 0, width // 2, height),
            (width - width // 2, 0, width // 2, height),
            (0, 0, width, height // 2),
            (0, height - height // 2, width, height // 2),
        ]
        left, top, w, h = max(halves, key=lambda box: _count(tile, *box))
        return _shift(-left, -top), (w, h)
    rng = np.random.default_rng(int(tile.name))
    turn, axis = rng.uniform(0, 2 * np.pi, 2)
    tilt, scale, focal = np.radians(rng.uniform(10, 35)), rng.uniform(0.75, 1.3), 1.2 * max(width, height)
    rows, columns = np.nonzero(tile.observed)
    tilted = np.array([[1, 0, 0], [0, np.cos(tilt), 0], [0, np.sin(tilt) / focal, 1]])
    scaled = np.diag([scale, scale, 1.0])
    matrix = _shift(SIDE / 2, SIDE / 2) @ scaled @ _turn(turn) @ tilted @ _turn(axis)
    return matrix @ _shift(-columns.mean(), -rows.mean()), (SIDE, SIDE)


def _write(tile: Tile, matrix: Matrix, size: tuple[int, int], folder: Path) -> None:
    """Write a view of a photograph, and of its true mask with alpha 0 where nothing was observed."""
    photo, mask = folder / "photos" / f"{tile.name}.jpg", folder / "masks" / f"{tile.name}.png"
    if mask.exists():
        return
    photo.parent.mkdir(parents=True, exist_ok=True)
    mask.parent.mkdir(parents=True, exist_ok=True)
    # Averaged first where the view is coarser, as a camera does.
    scale = float(np.sqrt(abs(np.linalg.det(matrix[:2, :2]))))
    blurred = cv2.GaussianBlur(tile.photo, (0, 0), 0.4 / scale) if scale < 0.9 else tile.photo
    shown = cv2.warpPerspective(blurred, matrix, size, flags=cv2.INTER_CUBIC)
    truth = cv2.warpPerspective(tile.truth, matrix, size, flags=cv2.INTER_LINEAR)
    road, observed = np.uint8(255) * (truth[..., 0] > 127), np.uint8(255) * (truth[..., 1] > 127)
    cv2.imwrite(str(photo), cv2.cvtColor(shown, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 95])
    cv2.imwrite(str(mask), np.dstack([road & observed] * 3 + [observed]))


def _locate(queries: Path, out: Path, reference: Path, more: list[str]) -> dict[str, dict]:
    """Locate a folder of queries, but for those located already, and return the results by name."""
    _roadgeo("locate", queries, "-r", reference, "-o", out, "--time-limit", 60, "--skip-existing", "-q", *more)
    found = [json.loads(path.read_text()) for path in sorted(out.glob("*_location.json"))]
    return {Path(result["query"]).stem: result for result in found}


def _judge(
    found: dict[str, dict], views: dict[str, tuple[Matrix, tuple[int, int]]], places: dict[str, tuple[float, float]]
) -> dict[str, float]:
    """Return of each that is located how many metres the middle of its frame is off."""
    judged = {}
    for name, result in found.items():
        if result["status"] != "located":
            continue
        matrix, (width, height) = views[name]
        column, row = _apply(np.linalg.inv(matrix), width / 2, height / 2)
        x, y = places[name]
        right = np.array([x + column - 750, y - (row - 750)])  # photographs of 1500 px of 1 m
        columns, rows = result["size"]
        judged[name] = float(np.linalg.norm(_apply(np.array(result["homography"]), columns / 2, rows / 2) - right))
    return judged


def _roadgeo(*arguments: object) -> None:
    done = subprocess.run([*ROADGEO, *map(str, arguments)], check=False, capture_output=True, text=True)
    if done.returncode not in (0, 3):
        print(done.stderr[-2000:], file=sys.stderr)


def _count(tile: Tile, left: int, top: int, width: int, height: int) -> int:
    return int(np.count_nonzero(tile.observed[top : top + height, left : left + width]))


def _shift(x: float, y: float) -> Matrix:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1]], float)


def _turn(angle: float) -> Matrix:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _apply(matrix: Matrix, x: float, y: float) -> Matrix:
    u, v, w = matrix @ (x, y, 1)
    return np.array([u / w, v / w])


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with images/, masks/ and tiles.csv")
    parser.add_argument("--roads", type=Path, required=True, help="roads of the photographs' region")
    parser.add_argument("--work", type=Path, required=True, help="folder to keep views and results in")
    parser.add_argument("--model", help="a model that has not seen the photographs; default: the one that ships")
    parser.add_argument("--elsewhere", type=Path, action="append", default=[], help="a reference of another place")
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--fold", type=int, default=0, help="the fold that the model was not trained on")
    return parser.parse_args()


if __name__ == "__main__":
    main()
