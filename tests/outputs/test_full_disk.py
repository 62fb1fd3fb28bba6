"""A full disk is named in one line, whatever is being written, and nothing half-written is left."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import resource, sys
from pathlib import Path
import cv2, numpy as np
from roadgeo.errors import OutputError
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Content, Location
from roadgeo.geometry.mask import RoadMask
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.registry import REGISTRY
from roadgeo.outputs.subject import Subject
from roadgeo.sources.segmentation.probability import ProbabilityMap
from roadgeo.storage.files import replacing

folder = Path(sys.argv[1])
rng = np.random.default_rng(0)
photo = folder.parent / "photo.tif"
cv2.imwrite(str(photo), rng.integers(0, 255, (300, 400, 3), np.uint8))
matrix = np.array([[1.0, 0, 500000], [0, -1.0, 4500000], [0, 0, 1]])
place = Placement((400, 300), LocalPlane("EPSG:32629", (0.0, 0.0)), matrix, reference="r")
location = Location("q", "located", "why", "r", places=(place,), content=Content((400, 300)))
mask = RoadMask(np.eye(300, 400, dtype=bool))
subject = Subject(location, mask, output_paths(folder, "x"), ImageOptions(), photo, [], None)
resource.setrlimit(resource.RLIMIT_FSIZE, (50, 50))
for name in ("footprint", "gcps", "vrt", "points", "json", "map of probability"):
    path = folder / f"{name}.tif"
    try:
        if name in REGISTRY:
            with replacing(path) as staged:
                REGISTRY[name].write(staged, subject)
        else:
            ProbabilityMap(rng.integers(0, 255, (600, 600), np.uint8), 0.5, "q", "m").write(path)
        print(f"{name} was written")
    except OutputError as error:
        print(error)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs resource limits")
def test_a_full_disk_is_named_by_every_output(tmp_path: Path) -> None:
    """What was written while a picture was open was told as "not a raster that can be read"."""
    folder = tmp_path / "out"
    folder.mkdir()
    # A module that was compiled under the limit would be cut off, too, and stay so: -B keeps none.
    done = subprocess.run([sys.executable, "-B", "-c", CODE, str(folder)], check=True, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 6, done.stdout
    assert all(line.startswith("cannot write ") for line in lines)
    assert sum(str(folder) in line for line in lines) == 6
    assert not list(folder.iterdir())
