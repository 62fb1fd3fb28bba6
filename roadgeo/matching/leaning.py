"""What grew, and no camera sees so: the homography of one that sees the same ground around its seeds.

From three crossings, or one, a steep view grows part of the way: there it fits, and beyond it is bent at will. Around
the seeds it is right, and of a usual lens that tells the rest but for the way in which the camera leaned.
"""

from __future__ import annotations

import math

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.camera import CameraFault, CameraOptions, judge, pinholes_around, sampling
from roadgeo.kernels.roads import forward_distances
from roadgeo.matching.hypothesis import MINIMAL, Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import VerifyOptions, agreement, tolerance_m

__all__ = ["lean_as_a_camera"]

#: Where fewer of so many road points lie on roads of the map a lens is no help: at right places of masks that a camera
#: saw at 40 to 60 degrees it was 0.35 and more, at nine of ten wrong ones 0.3 at most.
_LEAST_SHARE, _POINTS = 0.3, 150


def lean_as_a_camera(
    model: Hypothesis, scene: Scene, index: ReferenceIndex, camera: CameraOptions, verify: VerifyOptions
) -> bool:
    """Give a skewed hypothesis the homography of a pinhole: of the two that may lean so the one that fits better.

    False, and the fault is noted, where neither is plausible or fits.
    """
    if judge(model.matrix, scene.size, camera) is not CameraFault.SKEW:
        return True
    middle = scene.intersections.xy[model.seeds].mean(axis=0)
    seen = pinholes_around(model.matrix, scene.size, middle, camera.focal_px)
    shares = [_share(one, scene, index, verify) if judge(one, scene.size, camera) is None else 0.0 for one in seen]
    if max(shares, default=0.0) < _LEAST_SHARE:
        model.fault = CameraFault.SKEW
        return False
    model.matrix = seen[int(np.argmax(shares))]
    gsd, seeds = sampling(model.matrix, scene.size), model.seeds[-MINIMAL:]
    _, model.matched, _ = agreement(model.matrix, scene, index, gsd, seeds, verify)
    model.by_roads = True  # it is held where it was put
    return True


def _share(matrix: FloatArray, scene: Scene, index: ReferenceIndex, verify: VerifyOptions) -> float:
    """Return which share of some road points lie on roads of the map."""
    thin = max(1, len(scene.points) // _POINTS)
    points, directions = (np.ascontiguousarray(array[::thin]) for array in (scene.points, scene.directions))
    away, tolerance = np.empty(len(points)), tolerance_m(sampling(matrix, scene.size), verify)
    min_cos = math.cos(math.radians(verify.max_turn_deg))
    forward_distances(matrix, points, directions, tolerance, min_cos, 0.0, 0.0, index.road_buckets, away)
    return float(np.isfinite(away).mean()) if len(away) else 0.0
