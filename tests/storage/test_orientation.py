"""Pictures are upright, as PIL's exif_transpose and cv2.imread show them, whatever way they are stored."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from worlds.turned import save_turned

from roadgeo.storage.orientation import read_orientation, stored_from_upright

ALL = range(1, 9)


@pytest.fixture
def upright() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (40, 70, 3)).astype(np.uint8)


@pytest.mark.parametrize("orientation", ALL)
def test_the_matrix_leads_to_the_stored_pixel(tmp_path: Path, upright: np.ndarray, orientation: int) -> None:
    stored = np.asarray(Image.open(save_turned(tmp_path / "photo.png", upright, orientation)))
    matrix = stored_from_upright(orientation, (70, 40))
    for row, column in ((0, 0), (3, 50), (39, 69)):
        x, y, _ = matrix @ (column + 0.5, row + 0.5, 1.0)
        np.testing.assert_array_equal(stored[int(y), int(x)], upright[row, column])


def test_a_tag_in_a_big_tiff_of_either_order(tmp_path: Path) -> None:
    for order, mark in (("<", b"II"), (">", b"MM")):
        entry = struct.pack(order + "HHQH", 274, 3, 1, 8) + bytes(6)
        head = mark + struct.pack(order + "HHHQ", 43, 8, 0, 16)
        (tmp_path / "big.tif").write_bytes(head + struct.pack(order + "Q", 1) + entry + bytes(8))
        assert read_orientation(tmp_path / "big.tif") == 8


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp"])
def test_damage_is_no_orientation(tmp_path: Path, upright: np.ndarray, kind: str) -> None:
    whole = save_turned(tmp_path / f"photo.{kind}", upright, 6).read_bytes()
    rng = np.random.default_rng(1)
    path = tmp_path / f"hurt.{kind}"
    for k in range(200):
        hurt = bytearray(whole[: rng.integers(len(whole))] if k % 2 else whole)
        for at in rng.integers(0, max(len(hurt), 1), 4) if hurt else ():
            hurt[at] = rng.integers(256)
        path.write_bytes(hurt)
        assert read_orientation(path) in ALL
    assert read_orientation(tmp_path / "none.jpg") == 1
