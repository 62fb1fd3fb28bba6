"""A short run of `support/endurance.py`: what must not grow does not. At full length see docs/faults.md."""

import gc
import json
import subprocess
import sys
import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.endurance import draw_masks
from worlds.scenes import random_network

from roadgeo.matching.index import build_index
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.workflows import locate

_SCRIPT = Path(__file__).parent / "support" / "endurance.py"


def test_neither_memory_nor_files_nor_time_grow() -> None:
    # In a process of its own: in this one other tests' files may be closed, and their connections open, meanwhile.
    run = subprocess.run([sys.executable, str(_SCRIPT), "--count", "80"], capture_output=True, text=True, check=True)
    output = json.loads(run.stdout)
    assert set(output["became"]) == {"located", "not_located", "damaged"}
    assert output["open_files"][-1] == output["open_files"][1]
    assert output["resident_mb"][-1] <= 1.02 * output["resident_mb"][1]
    assert min(output["median_ms"][-5:]) <= 1.5 * max(output["median_ms"][:5])


@pytest.mark.parametrize("n_references", [1, 2])
def test_a_map_is_let_go_with_its_reference(tmp_path: Path, n_references: int) -> None:
    network = random_network(1, 1000.0, 60.0)
    Reference(build_index(network), network).save(tmp_path / "town.gpkg")
    mask = cv2.imread(str(draw_masks(tmp_path, 1)[0]), cv2.IMREAD_GRAYSCALE).astype(bool)
    kept = []
    gc.disable()  # nobody has to wait for it
    try:
        for _ in range(6):
            references = [open_reference(tmp_path / "town.gpkg") for _ in range(n_references)]
            kept += [weakref.ref(part.open()) for reference in references for part in reference.parts]
            locate(np.where(mask, np.uint8(255), np.uint8(0)), references)
        del references
    finally:
        gc.enable()
    # Of several, the last are remembered for the next mask.
    assert sum(entry() is not None for entry in kept) == (0 if n_references == 1 else n_references)
