"""Scoring: whether masks were located where they lie, and whether error rates and standard deviations are calibrated.

A mask counts as right when it was reported "located" and the middle of its frame lies within a radius of the truth.
precision = right / located, recall = right / masks that have a place on the map. A mask that has none counts against
precision only. Intervals are Wilson's, at 95 % confidence.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from roadgeo.evaluation.truth import Truth
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography

__all__ = [
    "BREAKDOWNS",
    "Band",
    "Calibration",
    "Evaluation",
    "Score",
    "Share",
    "Spread",
    "Summary",
    "break_down",
    "calibrate_scores",
    "calibrate_sigma",
    "evaluate",
    "score",
    "share",
    "summarize",
]

#: Distance from the truth within which a location is right by default, metres.
RADIUS_M = 20.0

#: Property of a query: lower bounds of the classes that tables are broken down by.
BREAKDOWNS: dict[str, tuple[float, ...]] = {
    "n_intersections": (0, 12, 30, 60, 120, 240),
    "tilt_deg": (0, 10, 20, 30, 40),
    "gsd_m": (0, 0.5, 1, 2),
    "density_km2": (0, 10, 30, 60, 100),
}


@dataclass(frozen=True)
class Score:
    """How one mask fared.

    Attributes
    ----------
    status : str
        "located", "ambiguous", "not_located", or "missing" where there is no answer at all.
    right : bool
        Located within the radius of its place.
    center_m : float
        Distance of the middle of the frame from its place; NaN where no place is reported, or the mask has no place.
    corners_m, sigma_m : tuple of 4 floats
        Errors of the corners TL, TR, BR, BL, and the standard deviations (of each coordinate) reported for them.
    log10_odds : float
        As reported; NaN where none are.
    promise : (str, float, float) or None
        `error_rate` as reported: the kind of query, the least score of its band, and the share that is wrong at most.
    seconds, reason
        As reported.
    """

    file: str
    kind: str
    on_map: bool
    status: str
    right: bool
    center_m: float = math.nan
    corners_m: tuple[float, ...] = (math.nan,) * 4
    sigma_m: tuple[float, ...] = (math.nan,) * 4
    log10_odds: float = math.nan
    promise: tuple[str, float, float] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    properties: dict[str, float] = field(default_factory=dict)
    reason: str = ""

    @property
    def located(self) -> bool:
        """Whether one place was reported."""
        return self.status == "located"

    @property
    def corners_rms_m(self) -> float:
        """Root mean square of the corners' errors."""
        return math.sqrt(sum(error**2 for error in self.corners_m) / len(self.corners_m))

    @property
    def compute_s(self) -> float:
        """Seconds for vectorizing, matching and refining."""
        return sum(self.seconds.get(step, 0.0) for step in ("vectorize", "match", "refine"))


def score(truth: Truth, location: Mapping[str, Any] | None, radius_m: float = RADIUS_M) -> Score:
    """Compare a result (`Location.to_dict`, or its JSON read back) with the truth; None: there is no answer."""
    unanswered = Score(truth.file, truth.kind, truth.on_map, "missing", right=False, properties=truth.properties)
    if location is None:
        return unanswered
    answered = replace(
        unanswered,
        status=str(location["status"]),
        log10_odds=_number(location.get("log10_odds")),
        promise=_promise(location.get("error_rate")),
        seconds={step: _number(value) for step, value in (location.get("seconds") or {}).items()},
        reason=str(location.get("reason") or ""),
    )
    if location.get("homography") is None or not truth.on_map:
        return answered
    frame = Frame(*(location.get("size") or truth.size))
    points = np.vstack((frame.center, frame.corners))
    placed = Homography(np.array(location["homography"], float)).facing(frame.center)(points)
    errors = np.hypot(*(placed - truth.places(points, location.get("crs"))).T)
    return replace(
        answered,
        right=answered.located and bool(errors[0] <= radius_m),
        center_m=float(errors[0]),
        corners_m=tuple(errors[1:].tolist()),
        sigma_m=tuple(_number(value) for value in location.get("corner_sigma_m") or [None] * 4),
    )


def _promise(rate: Mapping[str, Any] | None) -> tuple[str, float, float] | None:
    return (str(rate["kind"]), float(rate["score"]), float(rate["at_most"])) if rate else None


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


# --- shares and spreads -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Share:
    """`hits` of `of` trials, and the interval that holds the true share with 95 % confidence; NaN of no trials."""

    hits: int
    of: int
    value: float
    low: float
    high: float


def share(hits: int, of: int, z: float = 1.959964) -> Share:
    """Estimate a share with Wilson's interval (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    if of == 0:
        return Share(0, 0, math.nan, math.nan, math.nan)
    p = hits / of
    middle = p + z * z / (2 * of)
    reach = z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    scale = 1 + z * z / of
    return Share(hits, of, p, max((middle - reach) / scale, 0.0), min((middle + reach) / scale, 1.0))


@dataclass(frozen=True)
class Spread:
    """Median, 95th percentile and maximum; NaN of nothing."""

    median: float
    p95: float
    max: float


def _spread(values: Iterable[float]) -> Spread:
    finite = np.array([value for value in values if math.isfinite(value)])
    if len(finite) == 0:
        return Spread(math.nan, math.nan, math.nan)
    return Spread(*(float(np.quantile(finite, q)) for q in (0.5, 0.95, 1.0)))


@dataclass(frozen=True)
class Summary:
    """How a group of masks fared. Errors are of the right ones, seconds of all.

    Attributes
    ----------
    refused : Share
        Share not located among the masks that have no place on the map.
    """

    name: str
    queries: int
    located: int
    ambiguous: int
    missing: int
    precision: Share
    recall: Share
    refused: Share
    center_m: Spread
    corners_rms_m: Spread
    compute_s: Spread


def summarize(name: str, scores: Sequence[Score]) -> Summary:
    """Count a group of masks."""
    right = [s for s in scores if s.right]
    located = sum(s.located for s in scores)
    absent = [s for s in scores if not s.on_map]
    return Summary(
        name,
        len(scores),
        located,
        sum(s.status == "ambiguous" for s in scores),
        sum(s.status == "missing" for s in scores),
        share(len(right), located),
        share(len(right), len(scores) - len(absent)),
        share(sum(not s.located for s in absent), len(absent)),
        _spread(s.center_m for s in right),
        _spread(s.corners_rms_m for s in right),
        _spread(s.compute_s for s in scores if s.seconds),
    )


def break_down(scores: Sequence[Score], by: str) -> list[Summary]:
    """Summarize by "kind", or by a property in the classes of `BREAKDOWNS`; masks without it are left out."""
    if by == "kind":
        return [
            summarize(kind, [s for s in scores if s.kind == kind]) for kind in dict.fromkeys(s.kind for s in scores)
        ]
    bounds = BREAKDOWNS[by]
    groups = []
    for low, high in zip(bounds, (*bounds[1:], math.inf), strict=True):
        members = [s for s in scores if low <= s.properties.get(by, math.nan) < high]
        if members:
            groups.append(summarize(f">= {low:g}" if high == math.inf else f"{low:g} to {high:g}", members))
    return groups


# --- calibration ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Band:
    """Wrong ones of the queries of a kind located with scores from `score` to the next band; the share at most."""

    kind: str
    score: float
    wrong: Share
    at_most: float

    @property
    def holds(self) -> bool:
        """Whether the count does not contradict the statement: the interval reaches down to it."""
        return self.wrong.of == 0 or self.wrong.low <= self.at_most


def calibrate_scores(scores: Sequence[Score]) -> list[Band]:
    """Count the wrong ones of each `error_rate` that answers state; masks without a place are wrong when located."""
    promised = [(s.promise, not s.right) for s in scores if s.located and s.promise is not None]
    wrong = {promise: [is_wrong for its, is_wrong in promised if its == promise] for promise, _ in sorted(promised)}
    return [Band(kind, score, share(sum(some), len(some)), most) for (kind, score, most), some in wrong.items()]


@dataclass(frozen=True)
class Calibration:
    """Errors of corners over their claims: error / sigma, sigma being the rms distance from the truth.

    Attributes
    ----------
    rms : float
        Root mean square: 1 if the claim is honest, 2 if errors are twice as large as claimed.
    robust : float
        The same from the median, which for Gaussian errors is sqrt(ln 2): outliers do not count.
    within_1, within_2, within_3 : Share
        Errors of at most 1, 2, 3 sigma; of Gaussian ones 63.2, 98.2 and 99.99 %.
    """

    rms: float
    robust: float
    within_1: Share
    within_2: Share
    within_3: Share


def calibrate_sigma(scores: Sequence[Score]) -> Calibration:
    """Compare the errors of the corners of all right masks with the standard deviations reported for them."""
    errors = np.array([s.corners_m for s in scores if s.right]).reshape(-1, 4)
    sigmas = np.array([s.sigma_m for s in scores if s.right]).reshape(-1, 4)
    is_known = np.isfinite(errors) & (sigmas > 0)
    ratio = errors[is_known] / sigmas[is_known]
    if len(ratio) == 0:
        return Calibration(math.nan, math.nan, *(share(0, 0),) * 3)
    within = [share(int((ratio <= k).sum()), len(ratio)) for k in (1, 2, 3)]
    return Calibration(float(np.sqrt(np.mean(ratio**2))), float(np.median(ratio) / math.sqrt(math.log(2))), *within)


# --- all together -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Evaluation:
    """Everything that a query set shows about a reference and a method.

    Attributes
    ----------
    settings : dict
        Plain values: input and options of the evaluation.
    breakdowns : dict of lists of Summary
        By "kind" and by each property of `BREAKDOWNS` that the queries have in more than one class.
    """

    settings: dict[str, Any]
    scores: list[Score]
    total: Summary
    breakdowns: dict[str, list[Summary]]
    bands: list[Band]
    sigma: Calibration

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`: NaN becomes None."""
        table: dict[str, Any] = _plain({"schema": "roadgeo.evaluation/1", **asdict(self)})
        return table


def evaluate(
    truths: Sequence[Truth],
    locations: Sequence[Mapping[str, Any] | None],
    settings: Mapping[str, Any] | None = None,
    radius_m: float = RADIUS_M,
) -> Evaluation:
    """Score results in the order of their truths."""
    scores = [score(truth, location, radius_m) for truth, location in zip(truths, locations, strict=True)]
    tables = {by: break_down(scores, by) for by in ("kind", *BREAKDOWNS)}
    return Evaluation(
        {"radius_m": radius_m, **(settings or {})},
        scores,
        summarize("all", scores),
        {by: table for by, table in tables.items() if len(table) > 1 or by == "kind"},
        calibrate_scores(scores),
        calibrate_sigma(scores),
    )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
