"""The way of a flight: frames are stitched until the map knows them, then each is followed from the one before.

While nothing is known, each frame is stitched to those before, and the mosaic is located like any mask: the evidence is
the engine's, and each further look takes its share off. From there on a frame is predicted by its motion, fitted to
the roads nearby, and compared with places nearby, and with how the frames before agreed. A frame that agrees less is
searched for a frame's width around. Frames that do not agree are taken for predicted; where several in a row do not,
the flight is lost, and the search begins anew with them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._text import counted
from roadgeo.errors import MaskError
from roadgeo.flights.candidates import Candidates, MosaicQuery
from roadgeo.flights.mosaic import Mosaic, road_px, stitch
from roadgeo.flights.pose import FilterOptions, FramePose, correct, loosened, predict, start
from roadgeo.geometry.camera import CameraOptions, sampling
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask
from roadgeo.kernels.warmup import warm_up
from roadgeo.location import Location
from roadgeo.matching.checking import CheckOptions, check_place
from roadgeo.matching.evidence import Evidence
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import Query, Scene, read_query, trace_query
from roadgeo.reference.reference import Reference

__all__ = [
    "AROUND",
    "Fix",
    "FlightFrame",
    "FrameStatus",
    "TrackOptions",
    "Tracked",
    "Tracker",
    "follow",
    "latest",
    "why_refused",
]

#: Number of places nearby that a tracked frame is compared with.
_N_SHIFTS = 25
#: The latest of the frames that wait for a place are stitched, up to this number.
_MOST_FRAMES = 32
#: A mosaic is located once it shows the first number of intersections, and again after the second number of more
#: intersections, or the third of more frames.
_FEWEST, _MORE, _MORE_FRAMES = 6, 2, 3
#: A frame agrees less than those before, of which the latest count, if its odds fall below this part of theirs, and the
#: share of its roads that agree by this: medians. At right places of 60 frames the part was .75 and more, and the share
#: fell by up to .07; a frame's width beside, the part was at most .08, and the share fell by .45 and more.
_N_BEFORE, _FALLEN, _SHARE_FALLEN = 5, 0.5, 0.15
#: A block beside explains more than a frame's place if its log10 likelihood is greater by this. At 12 right places in a
#: lattice none was greater at all; a block beside them, the true place's was greater by .4 to 6.
_EXPLAINS_MORE = 0.5
#: Length of road, pixels, that frame and map must each show for the map to tell anything of a frame.
_LEAST_ROADS_PX = 100.0
#: A frame is where the roads around put it, if they put it there to this, metres.
AROUND = CheckOptions(tolerance_m=20.0, max_sigma_m=10.0)
#: Number of frames in a row without agreement after which the flight is lost; it is, too, when it may be off by this
#: share of a frame.
_PATIENCE, _LOST_FRAMES = 3, 0.3

_AGREES = "its roads agree with the map"
_HARDLY_A_ROAD = "it shows hardly a road of the map; placed by its motion"
_CONTRADICTS = "its roads contradict the map where its motion puts it: it may be a frame's width away"

FrameStatus = Literal["located", "tracked", "predicted", "lost"]


@dataclass(frozen=True)
class TrackOptions:
    """How a flight is followed.

    Attributes
    ----------
    locate : LocateOptions
        How mosaics are located; the hints are of the frames.
    start_sigma_m : float
        Standard deviation of a located mosaic.
    least_odds : float
        Log10 odds against places nearby by which a tracked frame agrees with the map.
    """

    locate: LocateOptions = field(default_factory=LocateOptions)
    start_sigma_m: float = 4.0
    least_odds: float = 0.5


@dataclass(frozen=True)
class FlightFrame:
    """A frame as it comes in.

    Attributes
    ----------
    time_s : float
        Since the flight began.
    mask : RoadMask
    motion : (3, 3) float64 or None
        Pixel of this frame to pixel of the one before; None: not known.
    motion_px : float
        Standard deviation of where it puts a corner.
    stretch : (2,) tuple of float
        Columns and rows for each of the frame's file, whose pixels may not be square.
    """

    number: int
    name: str
    time_s: float
    mask: RoadMask
    motion: FloatArray | None = None
    motion_px: float = 1.5
    stretch: tuple[float, float] = (1.0, 1.0)

    @property
    def frame(self) -> Frame:
        """Its size."""
        height, width = self.mask.shape
        return Frame(width, height)


@dataclass(frozen=True)
class Tracked:
    """The state of a frame.

    Attributes
    ----------
    status : str
        "located": placed by the search, alone or in a mosaic. "tracked": followed from the frame before, and the map
        agrees. "predicted": by its motion alone, hardly a road agrees. "lost": not known.
    pose : FramePose or None
        None where it is lost.
    reference : Reference or None
    log10_odds, agreeing : float
        Odds against places nearby, of this frame alone, and the share of its roads that lie on the map's; NaN where it
        was not compared.
    known_at : int
        Number of the frame at which this was known: a frame that waited in a mosaic was placed later.
    reason : str
    """

    frame: FlightFrame
    status: FrameStatus
    reason: str
    known_at: int
    pose: FramePose | None = None
    reference: Reference | None = None
    log10_odds: float = math.nan
    agreeing: float = math.nan


@dataclass(frozen=True)
class Fix:
    """A mosaic that was located: of the frames `first` to `last`."""

    first: int
    last: int
    location: Location


@dataclass(frozen=True)
class _Waiting:
    """A frame that waits for a place, traced; None where it shows no roads."""

    frame: FlightFrame
    scene: Scene | None


class Tracker:
    """Follows one flight, frame by frame.

    Attributes
    ----------
    fixes : list of Fix
        Each time the flight was located.
    """

    def __init__(self, references: Sequence[Reference], options: TrackOptions | None = None) -> None:
        warm_up()
        self.references, self.options = list(references), options or TrackOptions()
        self.fixes: list[Fix] = []
        self._pose: FramePose | None = None
        self._reference: Reference | None = None
        self._agreed: list[Tracked] = []  # the latest frames that agreed
        self._doubtful: list[_Waiting] = []  # frames in a row that do not agree
        self._window: list[_Waiting] = []
        self._forget()

    @property
    def is_lost(self) -> bool:
        """Whether the next frame has to be searched for."""
        return self._pose is None

    def feed(self, frame: FlightFrame) -> list[Tracked]:
        """Take the next frame; return its state, after later knowledge of earlier ones."""
        waiting = _Waiting(frame, _trace(frame.mask))
        if self._pose is not None:
            return self._follow(waiting)
        return self._search(waiting)

    # --- tracking -----------------------------------------------------------------------------------------------------

    def _follow(self, waiting: _Waiting) -> list[Tracked]:
        """Take the next frame of a flight whose place is known."""
        frame = waiting.frame
        tracked = self._step(waiting, frame.number, "tracked", self._agreed)
        if tracked.status in ("located", "tracked"):
            self._agreed = [*self._agreed, tracked][-_N_BEFORE:]
        if tracked.status == "predicted" and waiting.scene is not None:
            self._doubtful.append(waiting)
        else:
            self._doubtful = []
        if tracked.status == "lost" or len(self._doubtful) >= _PATIENCE:
            return self._lose(waiting, tracked.reason)
        return [tracked]

    def _step(self, waiting: _Waiting, known_at: int, status: FrameStatus, agreed: Sequence[Tracked] = ()) -> Tracked:
        """Predict a frame from the one before, lay it on the roads, and check that they agree."""
        frame = waiting.frame
        predicted = (
            None if self._pose is None or frame.motion is None else predict(self._pose, frame.motion, frame.motion_px)
        )
        if predicted is None:
            why = "its motion is not known" if frame.motion is None else "no camera moves like this"
            return Tracked(frame, "lost", why, known_at)
        return self._judge(waiting, predicted, known_at, status, agreed)

    def _judge(
        self,
        waiting: _Waiting,
        predicted: FramePose,
        known_at: int,
        status: FrameStatus,
        agreed: Sequence[Tracked] = (),
    ) -> Tracked:
        """Lay a frame on the roads; where it agrees less than the frames that `agreed` before, also search around."""
        frame, scene, reference = waiting.frame, waiting.scene, self._reference
        if scene is None or reference is None or not _shows_roads(predicted, scene, reference):
            return self._by_motion(Tracked(frame, "predicted", _HARDLY_A_ROAD, known_at, predicted, reference))
        corrected = correct(predicted, scene, reference.index.road_buckets, FilterOptions())
        odds, agreeing, beside = _compare(corrected or predicted, scene, reference)
        tracked = Tracked(frame, status, _AGREES, known_at, corrected, reference, odds, agreeing)
        is_doubtful = bool(agreed) and (beside > _EXPLAINS_MORE or _falls(tracked, agreed))
        if corrected is not None and odds >= self.options.least_odds and not is_doubtful:
            self._pose = corrected
            return tracked
        around = self._search_around(waiting, predicted, known_at, agreed) if agreed else None
        return around or self._by_motion(replace(tracked, status="predicted", reason=_CONTRADICTS, pose=predicted))

    def _by_motion(self, tracked: Tracked) -> Tracked:
        """Return a frame where its motion puts it; it may be anywhere around if its roads contradict that."""
        predicted = tracked.pose
        assert predicted is not None  # noqa: S101 - its motion is known
        frame_m = predicted.frame.half_diagonal * 2.0 * predicted.gsd_m
        if predicted.sigma_m > _LOST_FRAMES * frame_m:
            return replace(tracked, status="lost", reason="no road has agreed for too long", pose=None, reference=None)
        self._pose = predicted
        return tracked if math.isnan(tracked.log10_odds) else replace(tracked, pose=loosened(predicted, frame_m))

    def _search_around(
        self, waiting: _Waiting, predicted: FramePose, known_at: int, agreed: Sequence[Tracked]
    ) -> Tracked | None:
        """Search for a frame a frame's width around where its motion puts it; None where nothing stands out there."""
        frame, reference = waiting.frame.frame, self._reference
        assert reference is not None  # noqa: S101 - it was compared with it
        start_at = predicted.homography.matrix @ PIXEL_TO_PLANE
        reach_m = max(frame.width, frame.height) * predicted.gsd_m
        options = replace(AROUND, search=replace(AROUND.search, reach_m=reach_m))
        query = read_query(waiting.frame.mask)
        checked = check_place(start_at / start_at[2, 2], query, reference.index, options, beyond=False)
        if checked.verdict == "unknown" or checked.placement is None:
            return None
        corners = Homography(checked.placement.matrix)(frame.corners)
        tracked = self._judge(waiting, self._started(corners, frame), known_at, "located")
        return tracked if tracked.status == "located" and not _falls(tracked, agreed) else None

    def _started(self, corners: FloatArray, frame: Frame) -> FramePose:
        """Return the pose of a frame whose corners (4, 2) a search has located."""
        return start(corners, frame, np.eye(8) * self.options.start_sigma_m**2 / 2.0)

    def _lose(self, waiting: _Waiting, reason: str) -> list[Tracked]:
        """Declare the flight lost: frames that did not agree wait for a place again."""
        doubtful = self._doubtful if self._doubtful and self._doubtful[-1] is waiting else [*self._doubtful, waiting]
        known_at = waiting.frame.number
        why = f"{len(doubtful)} frames in a row do not agree with the map" if len(doubtful) > 1 else reason
        self._pose, self._reference = None, None
        self._window, self._doubtful = list(doubtful), []
        self._forget()
        return [Tracked(item.frame, "lost", why, known_at) for item in doubtful]

    def _forget(self) -> None:
        """Forget what earlier frames proposed."""
        self._searched_at = self._waited = 0
        self._candidates = Candidates(self.references)

    # --- searching ----------------------------------------------------------------------------------------------------

    def _search(self, waiting: _Waiting) -> list[Tracked]:
        """Stitch the next frame to those that wait, and look for all of them where that may help."""
        frame = waiting.frame
        if frame.motion is None or (self._window and self._window[-1].frame.frame != frame.frame):
            self._window = []
            self._forget()
        self._window = [*self._window, waiting][-_MOST_FRAMES:]
        masks = [member.frame.mask for member in self._window]
        mosaic = stitch(masks, [_motion(member) for member in self._window], road_px(masks))
        if mosaic is None:
            self._window = [waiting]
            self._forget()
            return [Tracked(frame, "lost", "no camera moves like this; begun anew", frame.number)]
        query = _read(mosaic)
        n_shown = 0 if query is None else len(query.scene.intersections)
        least = max(_FEWEST, self._searched_at + _MORE)
        if query is None or (n_shown < least and not self._candidates):
            why = f"waits: in {counted(len(masks), 'frame')} {n_shown} intersections, looked for again with {least}"
            return [Tracked(frame, "lost", why, frame.number)]
        self._waited += 1
        searched = n_shown >= least or self._waited >= _MORE_FRAMES
        if searched:
            self._searched_at, self._waited = n_shown, 0
        frames = MosaicQuery(query, mosaic, [member.frame.number for member in self._window], searched)
        location = self._candidates.decide(frames, self.search_options(mosaic, masks))
        if not location.located:
            return [Tracked(frame, "lost", f"{counted(len(masks), 'frame')}: {why_refused(location)}", frame.number)]
        return self._settle(location, mosaic) or [
            Tracked(frame, "lost", "a place was found, but the frames by themselves do not agree", frame.number)
        ]

    def search_options(self, mosaic: Mosaic, masks: Sequence[RoadMask]) -> LocateOptions:
        """Return options for a mosaic: its pixels are others than the frames', and each look takes its share off."""
        options, camera = self.options.locate, self.options.locate.match.camera
        height, width = masks[0].shape
        shrunk = [sampling(matrix @ PIXEL_TO_PLANE, (width, height)) for matrix in mosaic.to_mosaic]
        if camera.gsd_m != CameraOptions().gsd_m:
            camera = replace(camera, gsd_m=(camera.gsd_m[0] / max(shrunk), camera.gsd_m[1] / min(shrunk)))
        camera = replace(camera, focal_px=None)  # a mosaic is no picture by one camera
        near = options.near
        if near is not None:
            near = (near[0], near[1], near[2] + 0.5 * max(mosaic.mask.shape) * camera.gsd_m[1])
        match = replace(options.match, camera=camera, lens=False)
        return replace(options, match=match, near=near)

    def place(self, location: Location, mosaic: Mosaic, frames: Sequence[FlightFrame]) -> list[Tracked]:
        """Place frames whose mosaic was located, each by itself; nothing where most of them do not agree."""
        self._window = [_Waiting(frame, _trace(frame.mask)) for frame in frames]
        return self._settle(location, mosaic)

    def place_beside(self, beside: Tracked, frame: FlightFrame) -> Tracked:
        """Place a frame from another one, whose place is known and to whose pixels its motion leads."""
        self._pose, self._reference = beside.pose, beside.reference
        return self._step(_Waiting(frame, _trace(frame.mask)), frame.number, "located")

    def _settle(self, location: Location, mosaic: Mosaic) -> list[Tracked]:
        """Place all frames that waited, each by itself; nothing where most of them do not agree."""
        reference = next(candidate for candidate in self.references if candidate.name == location.reference)
        plane = reference.index.plane
        first, last = self._window[0].frame, self._window[-1].frame
        self._reference = reference
        placed: list[Tracked] = []
        for waiting, matrix in zip(self._window, mosaic.to_mosaic, strict=True):
            frame = waiting.frame.frame
            corners = plane.from_crs(location.pixel_to_map(Homography(matrix)(frame.corners)))
            if np.isfinite(corners).all():
                placed.append(self._judge(waiting, self._started(corners, frame), last.number, "located"))
        agreed = sum(tracked.status == "located" for tracked in placed)
        if len(placed) < len(self._window) or agreed < 0.5 * len(placed):
            self._pose, self._reference = None, None
            return []
        self._place_from_surest(placed, last.number)
        self._pose = placed[-1].pose
        self.fixes.append(Fix(first.number, last.number, location))
        self._window, self._doubtful = [], []
        self._agreed = [tracked for tracked in placed if tracked.status == "located"][-_N_BEFORE:]
        self._forget()
        return placed

    def _place_from_surest(self, placed: list[Tracked], known_at: int) -> None:
        """Place frames once more, by motion from the surest one in both directions; keep the place that agrees better.

        A mosaic bends: frames far from the roads that located it may be anywhere. Frames of an archive, which have
        neither motion nor order, stay.
        """
        odds = [tracked.log10_odds if tracked.status == "located" else -math.inf for tracked in placed]
        surest = int(np.argmax(odds))
        for way, there in ((1, len(placed)), (-1, -1)):
            for k in range(surest + way, there, way):
                later = self._window[max(k, k - way)]
                if later.frame.motion is None:
                    break
                motion = _motion(later) if way > 0 else np.asarray(np.linalg.inv(_motion(later)))
                beside, here = placed[k - way].pose, self._window[k]
                moved = None if beside is None else predict(beside, motion, later.frame.motion_px)
                if moved is None:
                    again = Tracked(here.frame, "lost", "too far from frames that agree", known_at)
                else:
                    again = self._judge(here, moved, known_at, "located")
                agrees = again.status == "located" and again.log10_odds > odds[k]
                if agrees or placed[k].status != "located":
                    placed[k] = again


def latest(learnt: Iterable[tuple[FlightFrame, list[Tracked]]]) -> list[Tracked]:
    """Return the final state of each frame, in order."""
    states = {state.frame.number: state for _, news in learnt for state in news}
    return [states[number] for number in sorted(states)]


def follow(
    frames: Iterable[FlightFrame], references: Sequence[Reference], options: TrackOptions | None = None
) -> Iterator[tuple[FlightFrame, list[Tracked]]]:
    """Follow a flight; yield each frame with the states that it changes."""
    tracker = Tracker(references, options)
    for frame in frames:
        yield frame, tracker.feed(frame)


def why_refused(location: Location) -> str:
    """Return why a mosaic was not located, without the hints that decide for images alone: flights lack some."""
    return location.reason.partition("; ")[0]


def _trace(mask: RoadMask) -> Scene | None:
    try:
        return trace_query(mask)[0]
    except MaskError:
        return None  # a frame without roads is no error: it is followed by its motion


def _motion(waiting: _Waiting) -> FloatArray:
    return np.eye(3) if waiting.frame.motion is None else waiting.frame.motion


def _read(mosaic: Mosaic) -> Query | None:
    """Trace a mosaic; None where it shows no roads."""
    try:
        return read_query(mosaic.mask)
    except MaskError:
        return None


def _compare(pose: FramePose, scene: Scene, reference: Reference) -> tuple[float, float, float]:
    """Compare a frame at its place with the map.

    Returns
    -------
    float
        Its log10 odds against places nearby but for whole blocks: where streets are alike a block beside, by which a
        search is judged, is no rival of a frame that was followed to its place.
    float
        The share of its roads that agree.
    float
        How much more the best place beside explains, a block beside or elsewhere nearby, log10.
    """
    matrix = pose.homography.matrix @ PIXEL_TO_PLANE
    evidence = Evidence(scene, reference.index, pose.gsd_m)
    agreement = evidence.agreement(matrix)
    nearby = max(evidence.nearby(matrix, n_shifts=_N_SHIFTS, n_anchors=0), 0.0)
    beside = evidence.nearby(matrix, n_shifts=_N_SHIFTS)
    own = agreement.log10_likelihood
    return own - nearby, agreement.forward, beside - own


def _falls(tracked: Tracked, agreed: Sequence[Tracked]) -> bool:
    """Return whether a frame agrees less than those before, by its odds and by the share of its roads."""
    if not agreed:
        return False
    odds, agreeing = (float(np.median([getattr(one, name) for one in agreed])) for name in ("log10_odds", "agreeing"))
    return tracked.log10_odds < _FALLEN * odds and tracked.agreeing < agreeing - _SHARE_FALLEN


def _shows_roads(pose: FramePose, scene: Scene, reference: Reference) -> bool:
    """Return whether frame and map both show roads where a frame is put."""
    mapped_px = Evidence(scene, reference.index, pose.gsd_m).mapped_px(pose.homography.matrix @ PIXEL_TO_PLANE)
    return min(scene.road_length_px, mapped_px) >= _LEAST_ROADS_PX
