"""Real masks: those of the Massachusetts Roads Dataset (Mnih 2013), as they are and seen by a tilted camera, on Boston.

Run `pytest -s tests/workflows/test_massachusetts.py` with ROADGEO_DATA set to see the figures.
"""

import cv2
import geopandas as gpd
import numpy as np
import pyproj
import pytest

import roadgeo
from roadgeo.evaluation.truth import Truth, read_truth
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.pinhole import warp_mask
from roadgeo.reference.reference import Reference
from roadgeo.sources.masks import read_mask
from roadgeo.workflows import locate


@pytest.fixture(scope="module")
def boston(data_dir) -> Reference:
    return roadgeo.index(gpd.read_file(data_dir / "boston" / "boston_osm_roads.gpkg"), "boston")


def views(truth: Truth, mask: np.ndarray):
    """The mask as it is, and tilted by up to 30 degrees, turned, its missing corners black."""
    yield mask, truth.homography
    rng = np.random.default_rng(int(truth.file.split("/")[-1].removesuffix(".png")))
    warped, matrix = warp_mask(mask, rng.uniform(0, 30), rng.uniform(0, 360), rng.uniform(0, 360))
    yield warped, truth.homography @ matrix


def center_error(found: np.ndarray, true: np.ndarray, size: tuple[int, int], to_found: pyproj.Transformer) -> float:
    middle = np.array([size]) / 2.0
    x, y = to_found.transform(*Homography(true)(middle).T)
    return float(np.hypot(*(Homography(found)(middle) - np.column_stack([x, y])).T).item())


def test_masks_are_located_where_they_lie_and_nowhere_else(data_dir, boston):
    folder = data_dir / "massachusetts"
    to_found = pyproj.Transformer.from_crs("EPSG:26986", boston.index.plane.crs, always_xy=True)
    errors, refused, astray, n_present = [], [], [], 0
    for number, truth in enumerate(read_truth(folder / "tiles.csv")):
        mask = np.where(cv2.imread(str(folder / truth.file), cv2.IMREAD_GRAYSCALE) > 127, 255, 0).astype(np.uint8)
        for k, (view, homography) in enumerate(views(truth, mask)):
            if not truth.on_map and k != number % 2:  # one of the two
                continue
            name = f"{truth.file}, view {k}"
            location = locate(read_mask(view, name=name), boston)
            n_present += truth.on_map
            if not location.located:
                refused += [f"{name}: {location.reason}"] if truth.on_map else []
                continue
            error = center_error(location.homography, homography, truth.size, to_found)
            errors.append(error)
            if not truth.on_map or error > 20.0:
                astray.append(f"{name}: {error:.0f} m")
    spread = " / ".join(f"{np.quantile(errors, q):.2f}" for q in (0.5, 0.95, 1.0))
    print(f"\n{len(errors)} of {n_present} located, centre errors {spread} m (50 / 95 / 100 %)", *refused, sep="\n")
    assert astray == []
    assert np.median(errors) <= 1.5
    assert max(errors) < 10.0
    assert not any("view 0" in name for name in refused)
    assert len(refused) <= 0.09 * n_present
