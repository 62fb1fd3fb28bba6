"""A place of a query on a map: a homography, and all that follows from it. Everything that searches returns it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.camera import CameraFault, CameraPose, pose, sampling
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import metres_apart, to_lonlat
from roadgeo.matching.evidence import Agreement, Evidence, match_intersections, statement_px
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import Refined
from roadgeo.matching.scene import Scene

__all__ = ["Place", "Weight"]


class Weight(NamedTuple):
    """The log10 likelihood of a place, and the pixels of road that counted as one independent statement."""

    log10_likelihood: float
    statement_px: float


@dataclass(frozen=True, eq=False)
class Place:
    """A scene placed on a map by a homography; equal to itself only. Dimension: N intersections of the scene.

    Attributes
    ----------
    scene : Scene
        The query, as a pinhole would have seen it: without the distortion `lens_k1`.
    index : ReferenceIndex
        The map, or the part of one that was searched.
    matrix : (3, 3) float64
        Query plane to reference plane.
    support : float
        How well it is supported by what it grew from; compares within one kind of proposal. NaN: it did not grow.
    by_roads : bool
        It did not grow from intersection to intersection, but by roads over the whole frame.
    grown : (N,) int or None
        The map's intersection matched to each of the query's, or -1, as it grew; None: those that match there.
    refined : Refined or None
        Its last adjustment; None before the first.
    fault : CameraFault or None
        Why no camera, or none within the limits, sees it so.
    score : float
        Its lead (log10) over all other places that it was compared with; -inf before it was compared.
    rival : Place or None
        The best of these.
    by : Weight or None
        Its likelihood by the yardstick by which it was compared; None: by its own roads (see `evidence`).
    """

    scene: Scene
    index: ReferenceIndex
    matrix: FloatArray
    support: float = math.nan
    by_roads: bool = True
    grown: IntArray | None = None
    refined: Refined | None = None
    fault: CameraFault | None = None
    score: float = -math.inf
    rival: Place | None = None
    by: Weight | None = None

    # --- variants of it -----------------------------------------------------------------------------------------------

    def at(self, refined: Refined, scene: Scene | None = None) -> Place:
        """Return the place by a new adjustment, on the scene without its distortion."""
        scene = self.scene if scene is None else scene
        return replace(self, matrix=refined.matrix, refined=refined, scene=scene, grown=None, by=None)

    def but(self, **changes: Any) -> Place:
        """Return the place with other results; values that follow from its homography are not computed anew."""
        other = replace(self, **changes)
        vars(other).update({name: value for name, value in vars(self).items() if name not in _FIELDS})
        return other

    # --- where it lies ------------------------------------------------------------------------------------------------

    @cached_property
    def gsd_m(self) -> float:
        """Ground sampling at the middle of the frame, metres per pixel."""
        return sampling(self.matrix, self.scene.size)

    @cached_property
    def view(self) -> CameraPose:
        """The camera that sees it so."""
        return pose(self.matrix, self.scene.size)

    @cached_property
    def center(self) -> FloatArray:
        """Where the middle of the frame lies, (2,) plane metres."""
        return Homography(self.matrix).everywhere(self.scene.center)

    @cached_property
    def corners(self) -> FloatArray:
        """Where its corners TL, TR, BR, BL lie, (4, 2) plane metres."""
        return Homography(self.matrix).everywhere(self.scene.corners)

    @cached_property
    def lonlat(self) -> FloatArray:
        """Longitude and latitude of the middle, (2,)."""
        plane = self.index.plane
        return np.asarray(to_lonlat(plane.crs, plane.to_crs(self.center[None]))[0])

    @property
    def lens_k1(self) -> float:
        """Radial distortion of the scene (see `geometry.lens`)."""
        return 0.0 if self.refined is None else self.refined.lens_k1

    @property
    def covariance(self) -> FloatArray | None:
        """Covariance (8, 8) of the corners' x and y (see `Refined`), square metres; None before a fit."""
        return None if self.refined is None else self.refined.corner_covariance_m2

    def apart_m(self, other: Place) -> float:
        """Return how far its middle lies from another place's, metres."""
        return metres_apart(self.lonlat, other.lonlat)

    def same(self, other: Place) -> bool:
        """Return whether another place is the same: their middles lie within 50 m, or a twentieth of the frame.

        Maps differ a little: on different maps places within half a frame are the same.
        """
        if self.index.is_of_map(other.index):
            (x, y, reach_m), (other_x, other_y, _) = self._spot, other._spot
            return math.hypot(x - other_x, y - other_y) < reach_m
        reach_m = 0.5 * self.gsd_m * max(self.scene.size)
        if self.index.is_shard_beside(other.index):
            reach_m = self._spot[2]
        return self.apart_m(other) <= reach_m

    @cached_property
    def _spot(self) -> tuple[float, float, float]:
        """X and y of the middle, and the reach of one place, metres: in a lattice they are asked again and again."""
        x, y = self.center.tolist()
        return x, y, Frame(*self.scene.size).one_place_m(self.gsd_m)

    # --- how well it explains the query -------------------------------------------------------------------------------

    @cached_property
    def evidence(self) -> Evidence:
        """The yardstick that weighs places of its scene on its map, by its own scale."""
        return Evidence(self.scene, self.index, self.gsd_m)

    @cached_property
    def agreement(self) -> Agreement:
        """How the query's and the map's roads agree there."""
        return self.evidence.agreement(self.matrix)

    @cached_property
    def matches(self) -> tuple[IntArray, FloatArray]:
        """The map's intersection matched to each of the query's (N,), or -1, and their distance (N,), metres."""
        return match_intersections(self.matrix, self.scene, self.index, self.gsd_m)

    @cached_property
    def on_roads(self) -> BoolArray:
        """Which of the scene's road points lie on roads of the map that run their way, (S,)."""
        return self.evidence.on_roads(self.matrix)

    @property
    def matched(self) -> IntArray:
        """The map's intersection matched to each of the query's (N,), or -1."""
        return self.matches[0] if self.grown is None else self.grown

    @property
    def rate(self) -> float:
        """Share of the query's intersections that match one of the map's."""
        return int((self.matches[0] >= 0).sum()) / max(len(self.matches[0]), 1)

    @cached_property
    def agreeing(self) -> float:
        """Mean of the shares of intersections, of the query's roads and of the map's roads that agree."""
        return (self.rate + self.agreement.forward + self.agreement.backward) / 3

    @property
    def log10_likelihood(self) -> float:
        """Its likelihood."""
        return self.agreement.log10_likelihood if self.by is None else self.by.log10_likelihood

    @property
    def statement_px(self) -> float:
        """Pixels of road that its likelihood counts as one statement."""
        return statement_px(self.gsd_m) if self.by is None else self.by.statement_px

    @property
    def explained(self) -> float:
        """Likelihood, scaled so that places of different scale compare (see `evidence.statement_px`)."""
        return self.log10_likelihood * self.statement_px

    @cached_property
    def contradicted(self) -> float:
        """Share of roads in regions of the frame where it explains little (see `Evidence.contradicted`)."""
        return self.evidence.contradicted(self.matrix)


_FIELDS = frozenset(field.name for field in fields(Place))
