"""Matched intersections, and the homography through those that are switched on. Knows nothing of QGIS.

Matches come from a control-point file as `roadgeo locate --also match-points` writes it, and as the Georeferencer does.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

__all__ = ["FEWEST", "Fit", "TiePoint", "corners", "fit", "format_points", "place", "read_points", "rms"]

#: Points that a homography needs.
FEWEST = 4

_COLUMNS = "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"


@dataclass(frozen=True)
class TiePoint:
    """A point of the picture, pixels from its top left corner, and the same on the map, in its CRS."""

    column: float
    row: float
    x: float
    y: float
    on: bool = True


@dataclass(frozen=True)
class Fit:
    """The homography through the matches.

    Attributes
    ----------
    matrix : (3, 3) float64 or None
        Pixel (column, row) to map; None where too few matches are on, or they lie on a line.
    residuals : list of float
        Distance of each match, on or off, in map units from where the fit puts it; NaN without a fit.
    """

    matrix: np.ndarray | None
    residuals: list[float] = field(default_factory=list)


def rms(residuals: Sequence[float]) -> float:
    """Return the root mean square of residuals."""
    return math.sqrt(sum(apart * apart for apart in residuals) / len(residuals))


def read_points(path: str | Path) -> tuple[str, list[TiePoint]]:
    """Read a control-point file: the map's CRS as WKT ("" where it is missing), and the matches.

    Raises
    ------
    ValueError
        It is no list of points.
    """
    try:
        lines = Path(path).read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    crs = next((line.partition(":")[2].strip() for line in lines if line.startswith("#CRS:")), "")
    try:
        rows = list(csv.DictReader(line for line in lines if line and not line.startswith("#")))
        matches = [
            TiePoint(float(r["sourceX"]), -float(r["sourceY"]), float(r["mapX"]), float(r["mapY"]), r["enable"] != "0")
            for r in rows
        ]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} is no file of control points: expected the columns {_COLUMNS}") from error
    if not all(math.isfinite(v) for match in matches for v in (match.column, match.row, match.x, match.y)):
        raise ValueError(f"{path} holds a control point that is no number")
    return crs, matches


def format_points(crs: str, matches: Sequence[TiePoint], fitted: Fit) -> str:
    """Return the text that `read_points` and the Georeferencer read."""
    lines = [*([f"#CRS: {crs}"] if crs else []), _COLUMNS]
    for match, apart in zip(matches, np.nan_to_num(fitted.residuals).tolist()):  # noqa: B905 (as long as each other)
        lines.append(f"{match.x!r},{match.y!r},{match.column!r},{-match.row!r},{int(match.on)},0,0,{apart!r}")
    return "\n".join(lines) + "\n"


def fit(matches: Sequence[TiePoint]) -> Fit:
    """Fit a homography to the matches that are on: least squares of the distances on the map (Gauss-Newton).

    Four are met exactly. It starts from the linear solution in normalised coordinates (Hartley & Zisserman, 4.1, 4.4).
    """
    on = np.array([match.on for match in matches], bool)
    nothing = Fit(None, [math.nan] * len(matches))
    if on.sum() < FEWEST:
        return nothing
    pixels = np.array([(match.column, match.row) for match in matches])
    ground = np.array([(match.x, match.y) for match in matches])
    source, target = pixels[on], ground[on]
    from_source, from_target = _normaliser(source), _normaliser(target)
    uv, xy = place(from_source, source), place(from_target, target)
    system = np.zeros((2 * len(uv), 9))
    system[0::2, 0:2], system[0::2, 2] = uv, 1.0
    system[1::2, 3:5], system[1::2, 5] = uv, 1.0
    system[0::2, 6:8], system[0::2, 8] = -xy[:, :1] * uv, -xy[:, 0]
    system[1::2, 6:8], system[1::2, 8] = -xy[:, 1:] * uv, -xy[:, 1]
    _, sizes, rows = np.linalg.svd(system)
    if sizes[7] < 1e-9 * sizes[0]:
        return nothing  # points on a line
    matrix = _improved(rows[-1].reshape(3, 3), uv, xy)
    if matrix is None:
        return nothing
    matrix = np.linalg.inv(from_target) @ matrix @ from_source
    return Fit(matrix / matrix[2, 2], np.hypot(*(place(matrix, pixels) - ground).T).tolist())


def corners(width: float, height: float) -> np.ndarray:
    """Return the corners (4, 2) of a picture, from its top left one clockwise."""
    return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


def place(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return where a homography puts points (N, 2)."""
    mapped = np.c_[points, np.ones(len(points))] @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _normaliser(points: np.ndarray) -> np.ndarray:
    """Return the map that moves the middle of points to 0 and their usual distance from it to 1."""
    middle = points.mean(axis=0)
    size = max(float(np.hypot(*(points - middle).T).mean()), 1e-12)
    return np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, size]]) / size


def _improved(matrix: np.ndarray, uv: np.ndarray, xy: np.ndarray) -> np.ndarray | None:
    """Make the squared distances from `xy` least; None where the horizon lies among the points."""
    for _ in range(8):
        mapped = np.c_[uv, np.ones(len(uv))] @ matrix.T
        w = mapped[:, 2:]
        if (w * w[0] <= 1e-9).any():
            return None
        where, rows = mapped[:, :2] / w, np.c_[uv, np.ones(len(uv))] / w
        jacobian = np.zeros((2 * len(uv), 9))
        jacobian[0::2, 0:3], jacobian[1::2, 3:6] = rows, rows
        jacobian[0::2, 6:], jacobian[1::2, 6:] = -where[:, :1] * rows, -where[:, 1:] * rows
        step = np.linalg.lstsq(jacobian, (xy - where).ravel(), rcond=1e-12)[0]
        matrix = matrix + step.reshape(3, 3)
        if np.abs(step).max() < 1e-12:
            break
    return matrix
