"""Nothing that is wrong with one mask stops the others of a batch."""

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from worlds.pngs import png
from worlds.rasters import write_raster

from roadgeo.cli import main
from roadgeo.evaluation.demo import demo_masks


def write_hostile(folder: Path) -> int:
    """Write masks that have each ended a run, and return how many."""
    (folder / "a_header.png").write_bytes(png(100_000, 100_000, 1)[:33] + bytes(23))
    (folder / "b_bitmap.bmp").write_bytes(
        b"BM" + bytes(12) + struct.pack("<iiiHH", 40, 20_000, 20_000, 1, 24) + bytes(9)
    )
    source = '<VRTDataset rasterXSize="64" rasterYSize="64"><SRS>nonsense</SRS></VRTDataset>'
    (folder / "c_virtual.tif").write_text(source)
    write_raster(folder / "d_complex.tif", np.ones((600, 600), np.complex64), crs="EPSG:3857")
    values = np.random.default_rng(0).integers(0, 2, (600, 600), np.uint8) * 255
    write_raster(folder / "e_damaged.tif", values, crs="EPSG:3857", compress="deflate")
    content = bytearray((folder / "e_damaged.tif").read_bytes())
    content[3000:9000] = bytes(6000)
    (folder / "e_damaged.tif").write_bytes(content)
    os.mkfifo(folder / "f_pipe.png")
    (folder / "g_empty.tif").write_bytes(b"")
    return 7


@pytest.mark.parametrize("jobs", ["1", "2"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_the_others_go_on(porto: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], jobs: str) -> None:
    folder = tmp_path / "masks"
    folder.mkdir()
    n_hostile = write_hostile(folder)
    (folder / "z_drone.png").write_bytes(demo_masks()[0].path.read_bytes())
    assert main(["locate", str(folder), "-r", str(porto), "--json", "--jobs", jobs, "-o", str(tmp_path)]) == 1
    out, err = capfd.readouterr()
    documents = [json.loads(line) for line in out.splitlines()]
    assert [document["status"] for document in documents] == ["error"] * n_hostile + ["located"]
    reasons = [document["reason"] for document in documents[:-1]]
    assert not [reason for reason in reasons if "\n" in reason or "fault of roadgeo" in reason]
    assert f"1 located, 0 not located, {n_hostile} failed" in err
