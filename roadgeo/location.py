"""The answer: where an image lies on the map, how sure that is, or why it has no place (`roadgeo.location/1`)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from html import escape
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._version import __version__
from roadgeo.errors import NotLocatedError, Reason, name_package
from roadgeo.geometry.placement import Camera, Center, Placement
from roadgeo.geometry.uncertainty import CenterError
from roadgeo.roads.graph import RoadGraph

if TYPE_CHECKING:
    import geopandas as gpd

__all__ = [
    "ERROR_RATES",
    "SCHEMA",
    "Content",
    "ErrorRate",
    "Kind",
    "Location",
    "Reason",
    "Seconds",
    "Spent",
    "Stats",
    "Status",
]

SCHEMA = "roadgeo.location/1"

Status = Literal["located", "ambiguous", "not_located", "chosen", "error"]

#: The evidence for a place: a photograph; roads and hints; the probability of road at each pixel; or roads alone.
Kind = Literal["photograph", "hints", "soft mask", "mask"]


class ErrorRate(NamedTuple):
    """How many places were wrong of those with scores like this one: counted among more queries without a place.

    Attributes
    ----------
    score : float
        `log10_odds` from here to the next band's.
    reported, wrong : int
        Places of such scores that were reported in `examples`, and how many of them were wrong.
    at_most : float
        The share that is wrong, with 95 % confidence (Clopper and Pearson, Biometrika 26, 1934; its upper end).
    """

    score: float
    reported: int
    wrong: int
    at_most: float

    def __str__(self) -> str:
        """Say it: "of such places at most 1 in 30 is wrong"."""
        n = 1.0 / self.at_most
        digits = max(math.floor(math.log10(n)) - 1, 0)
        return f"of such places at most 1 in {math.floor(n / 10**digits) * 10**digits:,} is wrong"


#: By kinds of query, and by bands of the score, from the threshold on; a test counts them again in `examples`.
ERROR_RATES: dict[Kind, tuple[ErrorRate, ...]] = {
    "mask": (
        ErrorRate(3.5, 21, 2, 0.304),
        ErrorRate(5.0, 54, 3, 0.154),
        ErrorRate(8.0, 189, 1, 0.0291),
        ErrorRate(15.0, 2359, 0, 0.00156),
    ),
    "soft mask": (ErrorRate(3.5, 21, 0, 0.161), ErrorRate(8.0, 90, 0, 0.0402), ErrorRate(15.0, 313, 0, 0.0117)),
    "hints": (ErrorRate(3.5, 17, 0, 0.195), ErrorRate(15.0, 123, 0, 0.0295)),
    "photograph": (ErrorRate(3.5, 32, 0, 0.109),),
}


@dataclass(frozen=True)
class Seconds:
    """Wall time of each step, seconds; of several places the best is chosen within `match`."""

    open: float = 0.0
    read: float = 0.0
    vectorize: float = 0.0
    match: float = 0.0
    refine: float = 0.0
    write: float = 0.0

    @property
    def total(self) -> float:
        """Sum of all steps."""
        return self.open + self.read + self.vectorize + self.match + self.refine + self.write


@dataclass(frozen=True)
class Stats:
    """Work done by the search: counts, and the time they would take one core of a usual machine, in milliseconds.

    On a larger map more is allowed, and counts as less (see `matching.search.SearchOptions`).
    """

    tuples_sampled: int = 0
    candidates: int = 0
    hypotheses: int = 0
    verified: int = 0
    work_ms: int = 0


@dataclass(frozen=True)
class Spent:
    """The cost of an answer.

    Attributes
    ----------
    stopped : str
        Why the search ended: "accepted", "exhausted" (nothing was left to try), or at a limit, "work" or "time". Only
        with "time" may the answer depend on the machine and its load. "" where no search was needed.
    """

    seconds: Seconds = field(default_factory=Seconds)
    stats: Stats = field(default_factory=Stats)
    stopped: str = ""


@dataclass(frozen=True, eq=False)
class Content:
    """The content of an image. Dimension: N intersections.

    Attributes
    ----------
    size : (width, height)
        Size of the image, pixels.
    graph : RoadGraph or None
        Its roads in the query plane, pixels (see `geometry.mask`); None where they are not at hand.
    xy : (N, 2) float64
        Its intersections, query plane.
    part : str
        What was read of a file that holds more: "band 2 (road) of 3", "page 1 of 2"; "" where that is all.
    lines_to_pixels : (3, 3) float64 or None
        For roads that came as lines: their coordinates to pixels of the mask that was drawn from them.
    stated : (lon, lat) or None
        Its middle by its own georeference.
    kind : Kind
        The evidence for its places.
    """

    size: tuple[int, int]
    graph: RoadGraph | None = None
    xy: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    part: str = ""
    lines_to_pixels: FloatArray | None = None
    stated: tuple[float, float] | None = None
    kind: Kind = "mask"


@dataclass(frozen=True, repr=False)
class Location:
    """Result of locating one image.

    `place`, and all that is read from it, is None unless `status` is "located", "ambiguous" or "chosen".

    Attributes
    ----------
    reason : str
        A sentence; `reason_code` is the same for programs.
    places : tuple of Placement
        The best first: the answer's own place, and others. In a refusal, the places that were refused.
    reference, attribution : str
        The map that it lies on, or all that were searched in vain, and whom their licences ask to name.
    reference_digest : str
        Digest of the roads of the reference; "" where it has no file.
    content : Content or None
        What the image shows; None where it could not be read.
    options : dict or None
        Options that differ from the defaults, in plain values; None: not recorded.
    command : str
        The command line that makes this result again; "" where another program asked.
    """

    query: str
    status: Status
    reason: str
    reference: str = ""
    attribution: str = ""
    places: tuple[Placement, ...] = ()
    reason_code: Reason = Reason.NOTHING_STANDS_OUT
    content: Content | None = field(default=None, repr=False)
    spent: Spent = field(default_factory=Spent)
    options: dict[str, Any] | None = field(default=None, repr=False)
    reference_digest: str = ""
    command: str = field(default="", repr=False)

    @property
    def located(self) -> bool:
        """Whether one place was found."""
        return self.status == "located"

    @property
    def on_map(self) -> bool:
        """Whether it is drawn on the map: one place was found, or the user chose one."""
        return self.status in ("located", "chosen")

    @property
    def place(self) -> Placement | None:
        """Where it lies, be it surely or not; None where it was refused."""
        return self.places[0] if self.places and self.status in ("located", "ambiguous", "chosen") else None

    @property
    def alternatives(self) -> tuple[Placement, ...]:
        """The other places, the best first; of a refusal, all that were refused."""
        return self.places if self.place is None else self.places[1:]

    @property
    def runner_up(self) -> Placement | None:
        """The best other place that was compared."""
        return self.places[0].rival if self.places else None

    def saying(self, more: str) -> Location:
        """Return it with another clause at the end of its reason."""
        return replace(self, reason=f"{self.reason}; {more}")

    def spending(self, **seconds: float) -> Location:
        """Return it with other seconds of some steps."""
        return replace(self, spent=replace(self.spent, seconds=replace(self.spent.seconds, **seconds)))

    # --- what follows from its place ----------------------------------------------------------------------------------

    @property
    def crs(self) -> str | None:
        """See `Placement`, as for all down to `camera`."""
        return None if self.place is None else self.place.crs

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the image in pixels."""
        return None if self.content is None else self.content.size

    @property
    def homography(self) -> FloatArray | None:
        """Pixel (column, row; GDAL corner convention) to CRS, (3, 3)."""
        return None if self.place is None else self.place.homography

    @property
    def footprint(self) -> FloatArray | None:
        """Corners TL, TR, BR, BL of the frame in the CRS, (4, 2)."""
        return None if self.place is None else self.place.footprint

    @property
    def footprint_lonlat(self) -> FloatArray | None:
        """The same as longitude and latitude."""
        return None if self.place is None else self.place.footprint_lonlat

    @property
    def center(self) -> Center | None:
        """The middle of the frame."""
        return None if self.place is None else self.place.center

    @property
    def gsd_m(self) -> float | None:
        """Metres per pixel at the middle."""
        return None if self.place is None else self.place.gsd_m

    @property
    def rotation_deg(self) -> float | None:
        """Direction of the image's up at its centre, clockwise from true north."""
        return None if self.place is None else self.place.rotation_deg

    @property
    def tilt_deg(self) -> float | None:
        """Angle of the camera's axis from the vertical."""
        return None if self.place is None else self.place.tilt_deg

    @property
    def tilt_source(self) -> str | None:
        """Origin of the focal length."""
        return None if self.place is None else self.place.tilt_source

    @property
    def fitted(self) -> str | None:
        """The mapping that the roads are consistent with: "similarity" or "homography"."""
        return None if self.place is None else self.place.fitted

    @property
    def lens_k1(self) -> float:
        """Radial distortion by the lens."""
        return 0.0 if self.place is None else self.place.lens_k1

    @property
    def corner_sigma_m(self) -> FloatArray | None:
        """Standard deviations of the corners' positions, (4,)."""
        return None if self.place is None else self.place.corner_sigma_m

    @property
    def corner_covariance_m2(self) -> FloatArray | None:
        """Covariance of the corners' x and y in the CRS, (8, 8)."""
        return None if self.place is None else self.place.corner_covariance_m2

    @property
    def center_error(self) -> CenterError | None:
        """How far the middle may be off; None where that is not known."""
        return None if self.place is None else self.place.center_error

    @property
    def lonlat_sigma_m(self) -> FloatArray | None:
        """Standard deviations (4,) of the corners' longitude and latitude, in metres; None where they are not known."""
        return None if self.place is None else self.place.lonlat_sigma_m

    @property
    def lonlat_accuracy_m(self) -> float | None:
        """How exactly PROJ takes the CRS to longitude and latitude; NaN where it does not know."""
        return None if self.place is None else self.place.lonlat_accuracy_m

    @property
    def camera(self) -> Camera | None:
        """Where the camera was; None where no camera above the ground would see the frame so."""
        return None if self.place is None else self.place.camera

    @property
    def mirrored(self) -> bool:
        """Whether the image is mirrored, left to right."""
        return self.place is not None and self.place.mirrored

    @property
    def log10_odds(self) -> float | None:
        """The score: by how many powers of ten the best place explains more than any other, reported or not.

        None where no place was verified, or the method knows no scores.
        """
        return self.places[0].score if self.places and not np.isnan(self.places[0].score) else None

    @property
    def error_rate(self) -> ErrorRate | None:
        """How often such places were wrong; None where none is reported, or with a lower score than usual."""
        if not self.located or self.content is None or self.log10_odds is None:
            return None
        score, rates = self.log10_odds, ERROR_RATES[self.content.kind]
        return next((rate for rate in reversed(rates) if score >= rate.score), None)

    @cached_property
    def stated_offset_m(self) -> float | None:
        """How far the middle lies from where the image's own georeference, or EXIF, puts it; None where it has none."""
        if self.center is None or self.content is None or self.content.stated is None:
            return None
        from pyproj import Geod

        return float(Geod(ellps="WGS84").inv(*self.content.stated, self.center.lon, self.center.lat)[2])

    # --- what supports it ---------------------------------------------------------------------------------------------

    @property
    def seconds(self) -> Seconds:
        """Wall time of each step."""
        return self.spent.seconds

    @property
    def stats(self) -> Stats:
        """Work done by the search."""
        return self.spent.stats

    @property
    def stopped(self) -> str:
        """Why the search ended (see `Spent`)."""
        return self.spent.stopped

    @property
    def n_intersections(self) -> int:
        """Intersections that the image shows."""
        return 0 if self.content is None else len(self.content.xy)

    @property
    def n_matched(self) -> int:
        """Those that the map has there."""
        return 0 if self.place is None or self.place.matches is None else len(self.place.matches)

    @property
    def inlier_ratio(self) -> float:
        """Share of the image's intersections that the map has there."""
        return self.n_matched / max(self.n_intersections, 1)

    # --- pixels and ground --------------------------------------------------------------------------------------------

    def pixel_to_map(self, pixels: FloatArray) -> FloatArray:
        """Take (..., 2) pixel positions (column, row; the top-left corner is 0, 0) to the location's CRS.

        Raises
        ------
        NotLocatedError
            There is no place: `status` is "not_located".
        """
        return self._placed().to_crs(pixels)

    def map_to_pixel(self, xy: FloatArray) -> FloatArray:
        """Take (..., 2) coordinates of the location's CRS to pixel positions (column, row).

        Raises
        ------
        NotLocatedError
            There is no place: `status` is "not_located".
        """
        return self._placed().to_pixels(xy)

    def _placed(self) -> Placement:
        if self.place is None:
            raise NotLocatedError(f"{self.query or 'the mask'} has no place: {self.reason}")
        return self.place

    # --- for other programs -------------------------------------------------------------------------------------------

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The footprint as a GeoJSON Feature in longitude and latitude; no geometry where there is no place."""
        ring = [] if self.footprint_lonlat is None else self.footprint_lonlat.tolist()
        closed = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]} if ring else None
        document = {key: value for key, value in self.to_dict().items() if not isinstance(value, dict | list)}
        return {"type": "Feature", "geometry": closed, "properties": document}

    def to_geodataframe(self) -> gpd.GeoDataFrame:
        """Return the footprint and its attributes as a table of one row, in the location's CRS (WGS 84 without one).

        Raises
        ------
        MissingPackageError
            geopandas is not installed.
        """
        try:
            import geopandas as gpd
        except ModuleNotFoundError as error:
            raise name_package(error) or error from error

        frame = gpd.GeoDataFrame.from_features([self.__geo_interface__], crs="EPSG:4326")
        return frame if self.crs is None else frame.to_crs(self.crs)

    def __repr__(self) -> str:
        """Describe the answer in one line."""
        if self.center is None:
            return f"<Location {self.query!r}: {self.status}, {self.reason}>"
        place = f"{self.center.lat:.6f}, {self.center.lon:.6f}" + (f" on {self.reference}" if self.reference else "")
        score = "" if self.log10_odds is None else f", score {self.log10_odds:.1f}"
        return f"<Location {self.query!r}: {self.status} at {place}{score}>"

    def _repr_html_(self) -> str:
        """Show the answer as a small table, for notebooks."""
        rows = {"status": self.status, "reason": self.reason, "reference": self.reference, "crs": self.crs}
        if self.center is not None:
            rows["latitude, longitude"] = f"{self.center.lat:.6f}, {self.center.lon:.6f}"
        if self.corner_sigma_m is not None:
            rows["corners, standard deviation"] = f"{self.corner_sigma_m.max():.1f} m at most"
        for label, value, unit in (
            ("ground sampling", self.gsd_m, "m"),
            ("rotation", self.rotation_deg, "°"),
            ("tilt", self.tilt_deg, "°"),
        ):
            if value is not None:
                rows[label] = f"{value:.3g} {unit}"
        cells = "".join(
            f"<tr><th>{escape(label)}</th><td>{escape(str(value))}</td></tr>" for label, value in rows.items() if value
        )
        return f"<table><caption>{escape(self.query)}</caption>{cells}</table>"

    def to_dict(self) -> dict[str, Any]:
        """Plain values in the order of the schema, ready for `json.dumps`; without matches and the image's content."""
        content, place, crs = self.content, self.place, self.places[0].crs if self.places else ""

        def of_place(other: Placement) -> dict[str, Any]:
            score = 0.0 if np.isnan(other.score) else other.score
            return {"center": other.center_in(crs)._asdict(), "log10_odds": score}

        rate = self.error_rate
        exact = place is not None and not np.isnan(place.lonlat_accuracy_m)
        made = {
            "schema": SCHEMA,
            "version": __version__,
            "reason_code": self.reason_code.value,
            "reference_digest": self.reference_digest or None,
            "command": self.command or None,
            "center": self.center and self.center._asdict(),
            "lens_k1": None if place is None else place.lens_k1,
            "lonlat_accuracy_m": self.lonlat_accuracy_m if exact else None,
            "query_to_pixel": None if content is None else _plain(content.lines_to_pixels),
            "part_read": "" if content is None else content.part,
            **dict(zip(("rmse_m", "rmse_px"), (place and place.rmse()) or (None, None), strict=True)),
            "error_rate": rate and {"kind": content and content.kind, **rate._asdict(), "said": str(rate)},
            "runner_up": None if self.runner_up is None else of_place(self.runner_up),
            "alternatives": [{**of_place(other), **_to_take(other)} for other in self.alternatives],
            "seconds": {**asdict(self.seconds), "total": self.seconds.total},
            "stats": asdict(self.stats),
        }
        return {name: made[name] if name in made else _plain(getattr(self, name)) for name in _ORDER}


def _to_take(place: Placement) -> dict[str, Any]:
    """Return what it takes to put the image there (see `running.choosing`), as plain values."""
    names = ("footprint_lonlat", "reference", "attribution", "crs", "homography", "lens_k1", "fitted", "focal_px")
    return {name: _plain(getattr(place, name)) for name in (*names, "corner_covariance_m2")}


#: The keys of `Location.to_dict` in the order in which people read them: the query, the place, its certainty, the cost.
_ORDER = (
    *("schema", "version", "query", "status", "reason", "reason_code", "reference", "reference_digest", "attribution"),
    *("options", "command", "crs", "size", "homography", "footprint", "footprint_lonlat", "center", "gsd_m"),
    *("rotation_deg", "tilt_deg", "tilt_source", "fitted", "lens_k1", "corner_sigma_m", "corner_covariance_m2"),
    *("center_error", "lonlat_sigma_m", "lonlat_accuracy_m", "camera", "mirrored", "query_to_pixel"),
    *("part_read", "stated_offset_m", "rmse_m", "rmse_px", "n_intersections", "n_matched", "inlier_ratio"),
    *("log10_odds", "error_rate", "runner_up", "alternatives", "seconds", "stats", "stopped"),
)


def _plain(value: Any) -> Any:
    """Return a field as plain values."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Camera):
        return value.to_dict()
    if isinstance(value, CenterError):
        return value._asdict()
    return list(value) if isinstance(value, tuple) else value
