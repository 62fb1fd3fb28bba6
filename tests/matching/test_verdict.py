"""What follows from a fit: a view straight down is levelled, others are not, however unsure their corners are."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, sight_of

from roadgeo.geometry.placement import Placement
from roadgeo.matching.evidence import Agreement
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import Refined
from roadgeo.matching.verdict import georeference


def placed(town, tilt: float, sigma_m: float, shaken_m: float = 0.0) -> tuple[Placement, np.ndarray]:
    """The place of a view whose corners are said to be so unsure, and the true corners in the CRS."""
    network, index = town
    truth, scene = sight_of(network, 5, tilt=tilt, sight=Sight(0.6))
    bent = truth + shaken_m * 1e-5 * np.array([[1.0, -2.0, 0.0], [1.5, 1.0, 0.0], [0.0, 0.0, 0.0]])
    place = Place(scene, index, bent, refined=Refined(bent, 1.0, sigma_m**2 * np.eye(8), 0.0, 0.0, 1.0), score=20.0)
    vars(place)["agreement"] = Agreement(0.9, 0.9)
    corners = np.c_[scene.corners, np.ones(4)] @ truth.T
    return georeference(place), index.plane.to_crs(corners[:, :2] / corners[:, 2:])


def test_a_view_straight_down_is_levelled_and_its_corners_are_surer(town):
    location, corners = placed(town, 0.0, 2.0, shaken_m=50.0)
    assert location.fitted == "similarity"
    assert location.corner_sigma_m == pytest.approx(np.full(4, 2.0))  # half of eight parameters
    assert location.tilt_deg == pytest.approx(0.0, abs=1e-3)
    assert np.hypot(*(location.footprint - corners).T).max() < 2.0
    assert np.isfinite(location.camera.covariance).all()


def test_on_another_datum_degrees_are_less_sure_than_metres(town):
    network, index = town
    meta = {**index.meta, "crs": "EPSG:27700", "origin": [624_000.0, 308_000.0]}
    location, _ = placed((network, replace(index, meta=meta)), 15.0, 1.0)
    assert location.center.lon == pytest.approx(1.3, abs=0.1)
    assert location.lonlat_accuracy_m >= 1.0
    assert location.lonlat_sigma_m == pytest.approx(np.hypot(np.sqrt(2), location.lonlat_accuracy_m))
    assert placed(town, 15.0, 1.0)[0].lonlat_accuracy_m == 0.0


@pytest.mark.parametrize("sigma_m", [1.0, 3000.0])
def test_a_tilted_view_is_not_however_unsure_its_corners_are(town, sigma_m):
    location, corners = placed(town, 15.0, sigma_m)
    assert location.fitted == "homography"
    assert location.footprint == pytest.approx(corners, abs=1e-3)
    assert location.corner_sigma_m == pytest.approx(np.full(4, np.sqrt(2) * sigma_m))
