"""What grew, and no camera sees so: the homography of one that sees the same ground around its seeds.

From three crossings, or one, a steep view grows part of the way: there it fits, and beyond it is bent at will. Around
the seeds it is right, and of a usual lens that tells the rest but for the way in which the camera leaned.
"""

from __future__ import annotations

from roadgeo.geometry.camera import CameraFault, CameraOptions, judge, pinholes_around, sampling
from roadgeo.matching.hypothesis import MINIMAL, Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import VerifyOptions, agreement

__all__ = ["lean_as_a_camera"]


def lean_as_a_camera(
    model: Hypothesis, scene: Scene, index: ReferenceIndex, camera: CameraOptions, verify: VerifyOptions
) -> None:
    """Give a skewed hypothesis the homography of a pinhole: of the two that may lean so the one that fits better.

    It stays what it is where neither is plausible.
    """
    if judge(model.matrix, scene.size, camera) is not CameraFault.SKEW:
        return
    middle, best = scene.intersections.xy[model.seeds].mean(axis=0), -1.0
    for matrix in pinholes_around(model.matrix, scene.size, middle, camera.focal_px):
        if judge(matrix, scene.size, camera) is None:
            gsd, seeds = sampling(matrix, scene.size), model.seeds[-MINIMAL:]
            found, matched, _ = agreement(matrix, scene, index, gsd, seeds, verify)
            if found.forward > best:
                best, model.matrix, model.matched = found.forward, matrix, matched
                model.by_roads = True  # its matches are of the whole frame; it is held where it was put
