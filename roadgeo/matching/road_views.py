"""The searches by roads for one scene on one map: as the mask shows it, and as it may look from above."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.matching.foreground import before
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.road_search import RoadSearch
from roadgeo.matching.scene import Scene
from roadgeo.matching.shared_sweeps import SharedSweeps
from roadgeo.matching.tilted import rectify

if TYPE_CHECKING:
    from roadgeo.matching.estimator import MatchOptions

__all__ = ["RoadViews"]


class RoadViews:
    """The views of a scene by numbers: 0 is the scene itself, 1 and so on those of `tilted.likely_views`.

    In each, roads vote in a stage of its own, which is made when it is needed.
    """

    def __init__(
        self,
        scene: Scene,
        index: ReferenceIndex,
        options: MatchOptions,
        near: tuple[float, float, float] | None,
        sweeps: SharedSweeps[Any],
    ) -> None:
        self.scene, self.index, self.options, self.near, self.sweeps = scene, index, options, near, sweeps
        self._searches: dict[int, RoadSearch] = {}

    def stage_of(self, view: int) -> int:
        """Return the number of the stage in which the roads of a view vote."""
        return len(self.options.sweeps) + view

    def view_of(self, stage: int) -> int | None:
        """Return the view whose roads vote in a stage; None where triples propose."""
        if self.options.roads is None:
            return None
        views = 1 + (0 if self.options.tilted is None else self.options.tilted.n_tried)
        return next((view for view in range(views) if self.stage_of(view) == stage), None)

    def tilted(self) -> range:
        """Return the numbers of the views from above; none where so steep a tilt is not allowed."""
        options, tilted = self.options, self.options.tilted
        if options.roads is None or tilted is None or options.camera.max_tilt_deg < tilted.tilt_deg:
            return range(0)
        return range(1, len(self.sweeps.views(tilted)) + 1)

    def seen_by(self, view: int) -> FloatArray:
        """Return the homography (3, 3) from the scene to a view of it."""
        tilted = self.options.tilted
        return np.eye(3) if view == 0 or tilted is None else self.sweeps.views(tilted)[view - 1]

    def search(self, view: int) -> RoadSearch:
        """Return the search by roads for a view."""
        if view not in self._searches:
            options, tilted, scene = self.options, self.options.tilted, self.scene
            if options.roads is None:
                raise ValueError("roads propose nothing here: expected `MatchOptions.roads`")
            on_map = options.roads.on(self.index.coarseness)
            voters = np.arange(len(scene.intersections))
            if view > 0 and tilted is not None:
                on_map, seen_by = replace(on_map, max_anchors=tilted.max_anchors), self.seen_by(view)
                voters = np.flatnonzero(before(scene.intersections.xy, seen_by, scene, tilted.coarser))
                scene = rectify(scene, seen_by, tilted.coarser)
            turnout = self.sweeps.turnout(view, self.index.coarseness, on_map)
            self._searches[view] = RoadSearch(
                scene, self.index, options.camera, on_map, self.near, self.sweeps.ahead, voters, turnout
            )
        return self._searches[view]
