"""The answer: where a mask lies on the map, how sure that is, or why it has no place (schema `roadgeo.location/1`)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from roadgeo import __version__
from roadgeo._arrays import FloatArray
from roadgeo.errors import NotLocatedError, Reason, name_package
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.uncertainty import CenterError
from roadgeo.roads.graph import RoadGraph

if TYPE_CHECKING:
    import geopandas as gpd

__all__ = [
    "ERROR_RATES",
    "SCHEMA",
    "Camera",
    "ErrorRate",
    "Evidence",
    "Location",
    "Place",
    "Reason",
    "Seconds",
    "Seen",
    "Stats",
    "Status",
]

SCHEMA = "roadgeo.location/1"

Status = Literal["located", "ambiguous", "not_located", "chosen", "error"]


class ErrorRate(NamedTuple):
    """How many places were wrong of those with scores like this one: counted, four in five masks without a place.

    Attributes
    ----------
    score : float
        `log10_odds` from here to the next band's.
    reported, wrong : int
        Places of such scores that `examples/trust` saw reported, and how many of them were wrong.
    at_most : float
        The share that is wrong, with 95 % confidence (Clopper and Pearson, Biometrika 26, 1934; its upper end).
    """

    score: float
    reported: int
    wrong: int
    at_most: float


#: By bands of the score, from the threshold on; a test counts them again in `examples/trust/results`.
ERROR_RATES = (
    ErrorRate(3.5, 19, 2, 0.331),
    ErrorRate(5.0, 43, 3, 0.191),
    ErrorRate(8.0, 165, 1, 0.0333),
    ErrorRate(15.0, 1941, 0, 0.0019),
)


@dataclass(frozen=True)
class Place:
    """A point on the map with its odds: the centre of a footprint.

    Attributes
    ----------
    footprint_lonlat : tuple of 4 (lon, lat), or None
        Corners TL, TR, BR, BL of the frame; None where they are not known.
    frame : Location or None
        All that follows from this place, where it may be taken (see `LocateOptions.take`).
    """

    x: float
    y: float
    lon: float
    lat: float
    log10_odds: float
    footprint_lonlat: tuple[tuple[float, float], ...] | None = field(default=None, repr=False)
    frame: Location | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class Camera:
    """Where the camera was, and how it pointed (see `geometry.pose`).

    Attributes
    ----------
    x, y : float
        In the location's CRS.
    height_m : float
        Above the ground in the frame, taken for level.
    heading_deg, pitch_deg, roll_deg : float
        Angles of an aircraft that looks straight down from its belly, its nose at the image's top: heading clockwise
        from true north, pitch positive with the nose up, roll with the right wing down.
    focal_px, focal_sigma_px : float
        Focal length in pixels of the mask, and its standard deviation: 0 where it was given.
    source : str
        Origin of the focal length, as in `Location.tilt_source`.
    covariance : (6, 6) float64
        Covariance of x, y and height, metres, and of the three angles, degrees.
    rotation : (3, 3) float64
        Axes of the camera (x right, y to the image's top, z backwards) to east, north and up.
    ground_m, ground_spread_m : float or None
        Mean height of the ground in the frame by a terrain model, and its standard deviation; None: none was given.
    """

    x: float
    y: float
    lon: float
    lat: float
    height_m: float
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    focal_px: float
    focal_sigma_px: float
    source: str
    covariance: FloatArray = field(repr=False)
    rotation: FloatArray = field(repr=False)
    ground_m: float | None = None
    ground_spread_m: float | None = None

    @property
    def tilt_deg(self) -> float:
        """Angle of the optical axis from the vertical."""
        return float(np.degrees(np.arccos(min(1.0, float(self.rotation[2, 2])))))

    @property
    def altitude_m(self) -> float | None:
        """Height in the terrain model's system; None without one."""
        return None if self.ground_m is None else self.ground_m + self.height_m

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        sigma = np.sqrt(np.diag(self.covariance)).tolist()
        names = ("x_m", "y_m", "height_m", "heading_deg", "pitch_deg", "roll_deg")
        plain = ("x", "y", "lon", "lat", *names[2:], "ground_m", "ground_spread_m", "altitude_m", "focal_px", "source")
        return {
            **{name: getattr(self, name) for name in plain},
            "sigma": {**dict(zip(names, sigma, strict=True)), "focal_px": self.focal_sigma_px},
            "covariance": self.covariance.tolist(),
            "rotation": self.rotation.tolist(),
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
class Seen:
    """Contents of the mask in the query plane, pixels (see `geometry.mask`): roads, and (N, 2) intersections."""

    graph: RoadGraph
    xy: FloatArray


@dataclass(frozen=True)
class Evidence:
    """The matches behind the answer, for drawing it. Dimensions: M matched intersections.

    Attributes
    ----------
    query_graph : RoadGraph
        The mask's roads in the query plane, pixels (see `geometry.mask`).
    query_xy : (M, 2) float64
        Matched intersections, query plane.
    reference_xy : (M, 2) float64
        Their counterparts on the map, in the location's CRS.
    residual_m : (M,) float64
        Distances between the mapped query intersections and their counterparts.
    """

    query_graph: RoadGraph
    query_xy: FloatArray
    reference_xy: FloatArray
    residual_m: FloatArray


@dataclass(frozen=True, repr=False)
class Location:
    """Result of locating one mask.

    Everything that needs a place, but the odds, is None unless `status` is "located", "ambiguous" or "chosen".

    Attributes
    ----------
    attribution : str
        Whom the licence of the reference asks to name.
    homography : (3, 3) float64
        Query pixel (column, row; GDAL corner convention) to CRS.
    footprint, footprint_lonlat : (4, 2) float64
        Corners TL, TR, BR, BL of the frame in the CRS, and as longitude, latitude.
    fitted : str or None
        "similarity" where the roads are consistent with a camera that looked straight down, else "homography".
    corner_sigma_m : (4,) float64
        Standard deviations of those corners' positions: root mean squares of their distances from the truth.
    lonlat_accuracy_m : float
        How exactly PROJ takes the CRS to longitude and latitude here (see `geometry.transformation`): 0 where both have
        one datum, NaN where it does not know.
    lens_k1 : float
        Radial distortion by the lens (see `geometry.lens`), estimated where the mask shows one, else 0. The
        homography, footprint and corners describe the frame as a pinhole would have seen it.
    rotation_deg : float
        Direction of the image's up at its centre, clockwise from true north.
    tilt_deg : float or None
        Angle of the camera's axis from the vertical.
    tilt_source : str or None
        Origin of the focal length: the given "camera", the "homography" where that determines it, or a usual lens
        that is "assumed".
    log10_odds : float or None
        By how many powers of ten the best place explains more than any other; also where it is not enough to report
        it. None where no place was verified, or the method knows no odds.
    reason_code : Reason
        The reason for programs.
    corner_covariance_m2 : (8, 8) float64 or None
        Covariance of the corners' x and y in the CRS: x, y of TL, then of TR, BR, BL.
    camera : Camera or None
        Where the camera was; None where no camera above the ground would see the frame so.
    alternatives : tuple of Place
        The best other places on any of the references, best first, in the CRS of the best one. Where nothing is
        located, the best place that there was comes first.
    stopped : str
        Why the search ended: "accepted", "exhausted" (nothing was left to try), or at a limit, "work" or "time". Only
        with "time" may the answer depend on the machine and its load. "" where no search was needed.
    options : dict or None
        Options that differ from the defaults, in plain values; None: not recorded.
    query_to_pixel : (3, 3) float64 or None
        For roads that came as lines: their coordinates to pixels of the mask that was drawn from them.
    mirrored : bool
        What was given is mirrored, by the user's or its file's word: the homography mirrors.
    part_read : str
        What was read of a file that holds more: "band 2 (road) of 3", "page 1 of 2"; "" where that is all.
    stated_offset_m : float or None
        How far the middle lies from where the mask's own georeference puts it; None where it has none.
    command : str
        The command line that makes this result again; "" where another program asked.
    reference_digest : str
        Digest of the roads of the reference; "" where it has no file.
    """

    query: str
    status: Status
    reason: str
    reference: str = ""
    attribution: str = ""
    crs: str | None = None
    size: tuple[int, int] | None = None  # (width, height) of the mask in pixels
    homography: FloatArray | None = None
    footprint: FloatArray | None = None
    footprint_lonlat: FloatArray | None = None
    center: Place | None = None
    gsd_m: float | None = None
    rotation_deg: float | None = None
    tilt_deg: float | None = None
    tilt_source: str | None = None
    fitted: str | None = None
    lens_k1: float = 0.0
    corner_sigma_m: FloatArray | None = None
    lonlat_accuracy_m: float = 0.0
    n_intersections: int = 0
    n_matched: int = 0
    inlier_ratio: float = 0.0
    log10_odds: float | None = None
    runner_up: Place | None = None
    seconds: Seconds = field(default_factory=Seconds)
    stats: Stats = field(default_factory=Stats)
    stopped: str = ""
    options: dict[str, Any] | None = field(default=None, repr=False)
    reference_digest: str = ""
    command: str = field(default="", repr=False)
    part_read: str = ""
    stated_offset_m: float | None = None
    evidence: Evidence | None = None
    seen: Seen | None = field(default=None, repr=False)
    reason_code: Reason = Reason.NOTHING_STANDS_OUT
    corner_covariance_m2: FloatArray | None = field(default=None, repr=False)
    alternatives: tuple[Place, ...] = ()
    camera: Camera | None = field(default=None, repr=False)
    mirrored: bool = False
    query_to_pixel: FloatArray | None = field(default=None, repr=False)

    @property
    def center_error(self) -> CenterError | None:
        """How far the middle may be off; None where that is not known."""
        return None if self.corner_covariance_m2 is None else CenterError.of(self.corner_covariance_m2)

    @property
    def located(self) -> bool:
        """Whether one place was found."""
        return self.status == "located"

    @property
    def on_map(self) -> bool:
        """Whether it is drawn on the map: one place was found, or the user chose one."""
        return self.status in ("located", "chosen")

    @property
    def places(self) -> tuple[Place, ...]:
        """All places that are known, the best first."""
        if self.center is None:
            return self.alternatives
        ring = (
            None if self.footprint_lonlat is None else tuple((lon, lat) for lon, lat in self.footprint_lonlat.tolist())
        )
        return (replace(self.center, footprint_lonlat=ring, frame=self), *self.alternatives)

    @property
    def lonlat_sigma_m(self) -> FloatArray | None:
        """Standard deviations (4,) of the corners' longitude and latitude, in metres; None where they are not known."""
        if self.corner_sigma_m is None or np.isnan(self.lonlat_accuracy_m):
            return None
        return np.hypot(self.corner_sigma_m, self.lonlat_accuracy_m)

    @property
    def error_rate(self) -> ErrorRate | None:
        """How often places of such scores were wrong; None where none is reported, or with a lower score than usual."""
        score = self.log10_odds if self.located else None
        return None if score is None else next((rate for rate in reversed(ERROR_RATES) if score >= rate.score), None)

    def pixel_to_map(self, pixels: FloatArray) -> FloatArray:
        """Take (..., 2) pixel positions (column, row; the top-left corner is 0, 0) to the location's CRS.

        Raises
        ------
        NotLocatedError
            There is no place: `status` is "not_located".
        """
        place = self._placed()
        return place(self._lens.straighten(pixels) if self.lens_k1 else pixels)

    def map_to_pixel(self, xy: FloatArray) -> FloatArray:
        """Take (..., 2) coordinates of the location's CRS to pixel positions (column, row).

        Raises
        ------
        NotLocatedError
            There is no place: `status` is "not_located".
        """
        pixels = self._placed().inverse()(xy)
        return self._lens.bend(pixels) if self.lens_k1 else pixels

    @property
    def _lens(self) -> Lens:
        return Lens.of(self.lens_k1, self.size or (1, 1))

    def _placed(self) -> Homography:
        if self.homography is None or self.size is None:
            raise NotLocatedError(f"{self.query or 'the mask'} has no place: {self.reason}")
        return Homography(self.homography).facing(Frame(*self.size).center)

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
        score = "" if self.log10_odds is None else f", log10 odds {self.log10_odds:.1f}"
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

    def rmse(self) -> tuple[float, float] | None:
        """Root mean square distance of the matched intersections from where the map has them: metres, pixels."""
        if self.evidence is None or self.homography is None or not len(self.evidence.query_xy):
            return None
        pixels, to_crs = plane_to_pixel(self.evidence.query_xy), Homography(self.homography)
        pixels = self._lens.straighten(pixels) if self.lens_k1 else pixels
        errors = (to_crs(pixels) - self.evidence.reference_xy, pixels - to_crs.inverse()(self.evidence.reference_xy))
        metres, px = (float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) for error in errors)
        return (metres, px) if np.isfinite([metres, px]).all() else None

    def to_dict(self) -> dict[str, Any]:
        """Plain values in the order of the schema, ready for `json.dumps`; without evidence and the mask's contents."""

        def place(other: Place) -> dict[str, Any]:
            middle = {"x": other.x, "y": other.y, "lon": other.lon, "lat": other.lat}
            return {"center": middle, "log10_odds": other.log10_odds}

        def framed(other: Place) -> dict[str, Any]:
            ring = other.footprint_lonlat
            return {**place(other), "footprint_lonlat": None if ring is None else [list(corner) for corner in ring]}

        center, exact = self.center, not np.isnan(self.lonlat_accuracy_m)
        made = {
            "schema": SCHEMA,
            "version": __version__,
            "reason_code": self.reason_code.value,
            "reference_digest": self.reference_digest or None,
            "command": self.command or None,
            "center": None if center is None else place(center)["center"],
            "lens_k1": None if center is None else self.lens_k1,
            "lonlat_accuracy_m": self.lonlat_accuracy_m if center is not None and exact else None,
            **dict(zip(("rmse_m", "rmse_px"), self.rmse() or (None, None), strict=True)),
            "runner_up": None if self.runner_up is None else place(self.runner_up),
            "alternatives": [framed(alternative) for alternative in self.alternatives],
            "seconds": {**asdict(self.seconds), "total": self.seconds.total},
            "stats": asdict(self.stats),
        }
        return {name: made[name] if name in made else _plain(getattr(self, name)) for name in _ORDER}


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
    if isinstance(value, CenterError | ErrorRate):
        return value._asdict()
    return list(value) if isinstance(value, tuple) else value
