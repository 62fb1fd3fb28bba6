"""Consequences of a fit: where the frame lies on Earth, and how it was seen."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.camera import pose, sampling
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.pose import PoseOptions, find_pose, turned
from roadgeo.geometry.projection import LocalPlane, grid_north, to_lonlat
from roadgeo.geometry.similarity import find_similarity
from roadgeo.geometry.transformation import LONLAT, exactness
from roadgeo.location import Camera, Evidence, Location, Place
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.evidence import agreement
from roadgeo.matching.methods import Fit
from roadgeo.matching.refinement import corner_sigmas
from roadgeo.matching.scene import Query, Scene

__all__ = ["center_of", "place_frame"]

#: A similarity agrees with as many of the query's roads as the homography but for this share, or it is none.
_LEAST_LOST = 0.02


def place_frame(location: Location, query: Query, fit: Fit, options: MatchOptions) -> Location:
    """Fill in everything that follows from a fit's homography and its matches."""
    # Where the corners and the middle lie, in the map's CRS.
    plane, scene = fit.index.plane, query.scene
    frame = Frame(*scene.size)
    level = _level(fit, query)
    homography = plane.to_crs_matrix() @ level.matrix @ PIXEL_TO_PLANE
    ground = Homography(homography).everywhere(np.vstack([frame.corners, frame.center]))
    lonlat = to_lonlat(plane.crs, ground)
    # The view of the camera, and the intersections that support it.
    focal_px = options.camera.focal_px
    camera = pose(level.matrix, scene.size, focal_px)
    north = grid_north(plane, ground[4])
    chosen = fit.matched >= 0
    reference_xy = plane.to_crs(fit.index.xy[fit.matched[chosen]])
    # That of the camera is the covariance of all eight parameters: the pose of one that looks straight down has six.
    seat = _find_camera(fit, level.matrix, scene.size, focal_px, north)
    odds = 0.0 if math.isnan(fit.log10_odds) else fit.log10_odds
    return replace(
        location,
        crs=plane.crs,
        homography=homography / homography[2, 2],
        footprint=ground[:4],
        footprint_lonlat=lonlat[:4],
        center=_place(ground[4], lonlat[4], odds),
        fitted="homography" if level is fit else "similarity",
        lens_k1=fit.lens_k1,
        corner_sigma_m=level.corner_sigma_m,
        corner_covariance_m2=level.corner_covariance_m2,
        lonlat_accuracy_m=exactness(plane.crs, LONLAT, lonlat[4].tolist()).sigma_m,
        gsd_m=camera.gsd_m,
        rotation_deg=(camera.rotation_deg + north + 180.0) % 360.0 - 180.0,
        tilt_deg=camera.tilt_deg if seat is None else seat.tilt_deg,
        tilt_source=camera.source if seat is None else seat.source,
        n_matched=int(chosen.sum()),
        inlier_ratio=float(chosen.mean()),
        log10_odds=None if math.isnan(fit.log10_odds) else fit.log10_odds,
        camera=seat,
        evidence=Evidence(query.graph, scene.intersections.xy[chosen], reference_xy, fit.distance[chosen]),
    )


def _level(fit: Fit, query: Query) -> Fit:
    """Return a fit restricted to a camera that looks straight down, unless the roads are inconsistent with it."""
    if fit.corner_covariance_m2 is None or fit.lens_k1:
        return fit
    scene = query.scene
    found = find_similarity(fit.matrix, scene.corners, fit.corner_covariance_m2)
    if found is None:
        return fit
    matrix, covariance = found.matrix, found.corner_covariance + found.doubt
    # The covariance may be too cautious. Roads that agreed must go on to agree.
    gsd = sampling(matrix, scene.size)
    agreeing, _, _ = agreement(matrix, scene, fit.index, gsd)
    if not agreeing.forward >= fit.agreeing - _LEAST_LOST:
        return fit
    return replace(fit, matrix=matrix, corner_covariance_m2=covariance, corner_sigma_m=corner_sigmas(covariance))


def _find_camera(
    fit: Fit, matrix: FloatArray, size: tuple[int, int], focal_px: float | None, north: float
) -> Camera | None:
    """Return where the camera was, given the `matrix` of a fit, levelled or not.

    `north` is the direction of the plane's y axis from true north.
    """
    if fit.corner_covariance_m2 is None:
        return None
    found = find_pose(matrix @ PIXEL_TO_PLANE, size, fit.corner_covariance_m2, PoseOptions(focal_px))
    if found is None:
        return None
    plane, rotation = fit.index.plane, turned(found.rotation, -north)
    x, y = plane.to_crs(found.position[:2]).tolist()
    lon, lat = to_lonlat(plane.crs, np.array([[x, y]]))[0].tolist()
    heading, pitch, roll = replace(found, rotation=rotation).angles_deg.tolist()
    height = float(found.position[2])
    lens = (found.focal_px, found.focal_sigma_px, found.source)
    return Camera(x, y, lon, lat, height, heading, pitch, roll, *lens, found.covariance, rotation)


def center_of(matrix: FloatArray, scene: Scene, plane: LocalPlane, log10_odds: float) -> Place:
    """Return where the middle of the frame lies."""
    ground = plane.to_crs(Homography(matrix).everywhere(scene.center)[None])
    lonlat = to_lonlat(plane.crs, ground)
    return _place(ground[0], lonlat[0], log10_odds)


def _place(xy: FloatArray, lonlat: FloatArray, log10_odds: float) -> Place:
    return Place(float(xy[0]), float(xy[1]), float(lonlat[0]), float(lonlat[1]), log10_odds)
