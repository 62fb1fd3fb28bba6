"""Many georeferenced images: whether each is where it claims to be, for `roadgeo verify`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._version import __version__
from roadgeo.errors import CrsError, RoadgeoError
from roadgeo.geometry.displacement import Displacement
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.georeference import Georeference
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.projection import LocalPlane, grid_north, to_lonlat
from roadgeo.geometry.transformation import exactness
from roadgeo.location import Location, Spent
from roadgeo.matching.checking import Checked, CheckOptions, check_place
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import read_query
from roadgeo.reference.reference import Reference
from roadgeo.running.options import ReadOptions
from roadgeo.running.pool import Lost
from roadgeo.running.queries import locate_query
from roadgeo.running.tasks import Task
from roadgeo.running.variants import Variant
from roadgeo.sources.georeference import read_georeference
from roadgeo.storage.crs import known_crs

if TYPE_CHECKING:
    from roadgeo.reference.opening import AnyReference

__all__ = ["SCHEMA", "Verified", "VerifyRun", "verify_image"]

SCHEMA = "roadgeo.verification/1"

_TODAYS_M = 6378137.0  # half of the long axis of GRS 80 and WGS 84


@dataclass(frozen=True)
class Verified:
    """The result of one image: its JSON object, and the corrected georeference where it is off."""

    document: dict[str, Any]
    corrected: Georeference | None = None

    @property
    def verdict(self) -> str:
        """One of "agrees", "off", "unknown" and "error"."""
        return str(self.document["verdict"])


@dataclass(frozen=True)
class VerifyRun:
    """How images are read and judged; `crs` belongs to world files, or replaces the images' own."""

    references: tuple[str, ...] = ()
    options: CheckOptions = field(default_factory=CheckOptions)
    reading: ReadOptions = field(default_factory=ReadOptions)
    crs: str | None = None

    def prepare(self) -> Callable[[Task], Verified]:
        """Open the references."""
        from roadgeo.kernels.warmup import warm_up
        from roadgeo.reference.opening import open_references

        references = open_references(self.references)
        warm_up()
        return lambda task: verify_image(task.mask, references, self)

    def give_up(self, task: Task, lost: Lost) -> Verified:
        """Make the outcome of an image that could not be worked on."""
        return _failed(task.mask, lost.said)


def verify_image(image: str, references: Sequence[AnyReference], settings: VerifyRun | None = None) -> Verified:
    """Judge whether an image lies at its georeference; errors are results, not raised."""
    settings = settings or VerifyRun()
    started = perf_counter()
    try:
        place = read_georeference(image, settings.crs)
        if place is None:
            return Verified(_document(image, Checked("unknown", "it has no georeference: use `roadgeo locate`")))
        pieces = [Reference(index) for reference in references for index in reference.indexes_at([place.middle()])]
        verified = _best(_Image(image, place, settings), pieces)
        return replace(verified, document={**verified.document, "seconds": round(perf_counter() - started, 3)})
    except RoadgeoError as error:
        return _failed(image, str(error))


@dataclass(frozen=True)
class _Image:
    name: str
    place: Georeference
    settings: VerifyRun


def _best(image: _Image, references: Sequence[Reference]) -> Verified:
    """Judge an image on the reference whose map shows most intersections in its frame."""
    counted = [(_count_inside(image.place, reference), k) for k, reference in enumerate(references)]
    most, k = max(counted, key=lambda pair: (pair[0], -pair[1]))
    reference = references[k]
    if most == 0:
        names = ", ".join(dict.fromkeys(reference.name for reference in references))
        return Verified(
            _document(image.name, Checked("unknown", f"it lies on none of the maps ({names})"), image.place)
        )
    start = image.place.on_plane(reference.index.plane)
    checked = _allow_for_crs(_look(image, reference, start), image, reference)
    offset = checked.displacement
    if offset is None or checked.verdict != "off":
        return Verified(_document(image.name, checked, image.place, reference))
    corrected = image.place.moved(offset.matrix @ start, reference.index.plane)
    return Verified(_document(image.name, checked, image.place, reference, corrected), corrected)


def _inexact(place: Georeference, reference: Reference) -> float:
    """Return how exactly PROJ takes an image's CRS to a map's, metres; infinity where a datum has no name and no shift.

    0 where it does not know otherwise: the shift is the file's own, or all datums of today share its ellipsoid.
    """
    stated_m = exactness(place.crs, reference.index.plane.crs, place.middle()).sigma_m
    own = known_crs(place.crs)
    is_todays = own.ellipsoid is not None and own.ellipsoid.semi_major_metre == _TODAYS_M
    return stated_m if math.isfinite(stated_m) else 0.0 if own.is_bound or is_todays else math.inf


def _allow_for_crs(checked: Checked, image: _Image, reference: Reference) -> Checked:
    """Judge nothing to be off that may be due to the transformation from an image's CRS to the map's."""
    inexact, offset = _inexact(image.place, reference), checked.displacement
    if checked.verdict != "off" or offset is None or inexact == 0.0:
        return checked
    corners = _frame_of(image.place, reference)
    if offset.over(corners) - math.hypot(offset.sigma_over(corners), inexact) > image.settings.options.tolerance_m:
        return checked
    crs = image.place.crs if len(image.place.crs) < 20 else "the image's CRS"
    known = f"knows to {inexact:g} m only" if math.isfinite(inexact) else "does not know"
    reason = f"{checked.reason}: that may be the way from {crs} to the map's, which PROJ {known}"
    return replace(checked, verdict="unknown", reason=reason)


def _count_inside(place: Georeference, reference: Reference) -> int:
    """Count the map's intersections within the bounds of an image."""
    plane = reference.index.plane
    try:
        corners = Homography(place.on_plane(plane)).facing(Frame(*place.size).center)(Frame(*place.size).corners)
    except CrsError:
        return 0
    inside = (reference.index.xy >= corners.min(axis=0)) & (reference.index.xy <= corners.max(axis=0))
    return int(inside.all(axis=1).sum())


def _look(image: _Image, reference: Reference, start: FloatArray) -> Checked:
    """Read the roads of a mask or a photograph, at several thresholds if need be, and check the place with each."""
    results: list[Checked] = []
    aspect, is_mirrored = image.place.pixel_shape()

    def check(variant: Variant, shape: tuple[int, int]) -> Location:
        coarser = np.diag([image.place.size[0] / shape[1], image.place.size[1] / shape[0], 1.0])
        there = start @ coarser @ np.linalg.inv(variant.matrix) @ PIXEL_TO_PLANE
        query = read_query(variant.mask)
        checked = check_place(there, query, reference.index, image.settings.options)
        results.append(checked)
        is_decided = checked.verdict != "unknown"
        return Location(
            variant.mask.name, "located" if is_decided else "not_located", checked.reason, spent=Spent(query.seconds)
        )

    gsd = math.sqrt(abs(np.linalg.det(Homography(start).jacobian(Frame(*image.place.size).center))))
    options = LocateOptions()
    match = replace(options.match, camera=replace(options.match.camera, gsd_m=(gsd / 1.1, gsd * 1.1)))
    search = replace(options.search, time_limit_s=60.0)
    reading = replace(image.settings.reading, mirror=is_mirrored, aspect=aspect or 1.0)
    locate_query(image.name, [reference], replace(options, match=match, search=search), reading, judge=check)
    if not results:
        return Checked("unknown", "hardly a road is seen in it")
    return next((checked for checked in results if checked.verdict != "unknown"), results[0])


# --- telling ----------------------------------------------------------------------------------------------------------


def _failed(image: str, reason: str) -> Verified:
    return Verified({"schema": SCHEMA, "image": image, "verdict": "error", "reason": reason})


def _document(
    image: str,
    checked: Checked,
    place: Georeference | None = None,
    reference: Reference | None = None,
    corrected: Georeference | None = None,
) -> dict[str, Any]:
    """Put the result into plain values, ready for `json.dumps`."""
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "image": image,
        "verdict": checked.verdict,
        "reason": checked.reason,
        "log10_lead": checked.log10_lead,
        "agreeing": checked.agreeing,
        "agreeing_as_given": checked.agreeing_as_given,
    }
    # Its place by its own georeference.
    if place is not None:
        middle = Homography(place.matrix).facing(Frame(*place.size).center)(Frame(*place.size).center)
        lon, lat = to_lonlat(place.crs, middle[None])[0].tolist()
        document |= {
            "crs": place.crs,
            "size": list(place.size),
            "georeference": place.source,
            "as_given": place.matrix.tolist(),
            "corrected": None if corrected is None else corrected.matrix.tolist(),
            "center": {"lon": lon, "lat": lat},
        }
    # Its place by the roads, against that, and against the best other place.
    if reference is not None and place is not None:
        document["reference"] = reference.name
        document["attribution"] = str(reference.index.meta.get("attribution") or "")
        plane = reference.index.plane
        offset, rival = checked.displacement, checked.rival
        frame = None if offset is None else _frame_of(place, reference)
        document["displacement"] = (
            None if offset is None else _to_dict(offset, plane, frame, _inexact(place, reference))
        )
        document["rival"] = None if rival is None else _to_dict(rival, plane, None)
    return document


def _frame_of(place: Georeference, reference: Reference) -> FloatArray:
    frame = Frame(*place.size)
    return Homography(place.on_plane(reference.index.plane)).facing(frame.center)(frame.corners)


def _to_dict(
    displacement: Displacement, plane: LocalPlane, corners: FloatArray | None, inexact: float = 0.0
) -> dict[str, float]:
    """Give a displacement as plain values, east and north as they are on Earth, not on the plane's grid.

    `inexact`: metres to which the image's CRS is taken to the plane's, as far as that is known.
    """
    inexact = inexact if math.isfinite(inexact) else 0.0
    turn = math.radians(grid_north(plane, plane.to_crs(displacement.about)))
    east = displacement.east_m * math.cos(turn) + displacement.north_m * math.sin(turn)
    north = displacement.north_m * math.cos(turn) - displacement.east_m * math.sin(turn)
    values = {"east_m": east, "north_m": north, "turn_deg": displacement.turn_deg, "scale": displacement.scale}
    if corners is None:
        return values
    sigma = np.sqrt(np.diag(displacement.covariance))
    return {
        **values,
        "sigma_east_m": math.hypot(float(sigma[0]), inexact / math.sqrt(2.0)),
        "sigma_north_m": math.hypot(float(sigma[1]), inexact / math.sqrt(2.0)),
        "sigma_turn_deg": math.degrees(float(sigma[2])),
        "sigma_scale": float(sigma[3]),
        "off_m": displacement.over(corners),
        "sigma_m": math.hypot(displacement.sigma_over(corners), inexact),
        "residual_m": displacement.residual_m,
    }
