"""A location on another grid of pixels over the same frame, as it is on the query's own."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.roads.graph import RoadGraph

__all__ = ["of_own_pixels", "on_grid"]


def on_grid(mask: RoadMask, shape: tuple[int, int]) -> RoadMask:
    """Return a mask on a grid of (H, W) pixels over the same frame."""
    size = shape[::-1]

    def resize(values: AnyArray) -> AnyArray:
        return np.asarray(cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5)

    observed, probability = None if mask.observed is None else resize(mask.observed), mask.probability
    if probability is not None:
        probability = cv2.resize(probability, size, interpolation=cv2.INTER_NEAREST)
    return replace(mask, roads=resize(mask.roads), observed=observed, probability=probability)


def of_own_pixels(location: Location, size: tuple[int, int]) -> Location:
    """Return a location of a frame whose own pixels are `size` (width, height), not those that it was located by."""
    if location.size is None or location.size == size:
        return location
    own = np.array(size) / location.size  # own pixels for each of the others
    camera, homography, seen, evidence = location.camera, location.homography, location.seen, location.evidence
    side = math.sqrt(own[0] * own[1])
    if homography is not None:
        homography = homography @ np.diag([*(1.0 / own), 1.0])
        homography = homography / homography[2, 2]
    if camera is not None:
        camera = replace(camera, focal_px=side * camera.focal_px, focal_sigma_px=side * camera.focal_sigma_px)
    if seen is not None:
        seen = replace(seen, graph=_scaled(seen.graph, own), xy=seen.xy * own)
    if evidence is not None:
        evidence = replace(evidence, query_graph=_scaled(evidence.query_graph, own), query_xy=evidence.query_xy * own)
    return replace(
        location,
        size=size,
        homography=homography,
        gsd_m=None if location.gsd_m is None else location.gsd_m / side,
        camera=camera,
        seen=seen,
        evidence=evidence,
    )


def _scaled(graph: RoadGraph, factors: FloatArray) -> RoadGraph:
    return replace(graph, xy=graph.xy * factors, coords=graph.coords * factors)
