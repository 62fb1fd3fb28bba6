"""A homography fitted to matched points, and how sure its predictions are.

The model is a homography in normalised coordinates, query (x - x0) / s to reference (X - X0) / (s g), s being the
query's half size in pixels and g the ground sampling there, so that it is near a rotation. Its eight parameters
p = (h00 h01 h02 h10 h11 h12 h20 h21), h22 = 1, come from linear least squares with a prior on the two perspective ones:
with few matches it is an affine map, with many a homography. The same normal matrix predicts how far off a new point
may be.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1
from roadgeo.kernels.compilation import kernel

__all__ = [
    "add_row",
    "cholesky",
    "fit_homography",
    "point_row",
    "predict",
    "solve_cholesky",
    "spread",
]


@kernel()
def cholesky(matrix: NDArray[np.float64], factor: NDArray[np.float64]) -> bool:
    """Factorise a symmetric matrix; return whether it is positive definite.

    Parameters
    ----------
    matrix : (n, n) float64
        Only its lower triangle is read.
    factor : (n, n) float64
        Its lower triangle is filled with L, L L^T = matrix.
    """
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 1e-300:  # NaN neither
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@kernel()
def solve_cholesky(factor: NDArray[np.float64], right: NDArray[np.float64]) -> None:
    """Solve L L^T x = right, L (n, n) as left by `cholesky`; x replaces `right` (n,)."""
    n = factor.shape[0]
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@kernel(writes=("row",))
def point_row(p: Floats1, u: float, v: float, axis_x: float, axis_y: float, row: Floats1) -> tuple[float, float, float]:
    """Differentiate a predicted point's component along (axis_x, axis_y) by the parameters `p` (8,).

    Parameters
    ----------
    u, v : float
        Normalised query point.
    row : (8,) float64
        Filled with the derivative.

    Returns
    -------
    x', y', w : float
        The point, normalised, and its denominator.
    """
    w = 1.0 + p[6] * u + p[7] * v
    x, y = (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w
    row[0], row[1], row[2] = axis_x * u / w, axis_x * v / w, axis_x / w
    row[3], row[4], row[5] = axis_y * u / w, axis_y * v / w, axis_y / w
    along = axis_x * x + axis_y * y
    row[6], row[7] = -along * u / w, -along * v / w
    return x, y, w


@kernel()
def add_row(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    row: NDArray[np.float64],
    weight: float,
    residual: float,
) -> None:
    """Add the equation row . dp = residual to the lower triangle of the normal equations `normal` dp = `right`."""
    for r in range(8):
        scaled = weight * row[r]
        for c in range(r + 1):
            normal[r, c] += scaled * row[c]
        right[r] += scaled * residual


@kernel()
def fit_homography(
    query: NDArray[np.float64],
    image: NDArray[np.float64],
    matched: NDArray[np.int64],
    prior: float,
    p: NDArray[np.float64],
    normal: NDArray[np.float64],
    factor: NDArray[np.float64],
) -> bool:
    """Fit a homography to matched points by one step of linear least squares; return whether that worked.

    x' (1 + p6 u + p7 v) = p0 u + p1 v + p2 is linear in p. The equations are divided by the w of the `p` given, so that
    residuals are distances on the reference plane.

    Parameters
    ----------
    query, image : (N, 2) float64
        Normalised points u, v and their images; those with `matched` >= 0 count.
    prior : float
        Weight that holds the two perspective parameters near zero: variance of a residual over theirs.
    p : (8,) float64
        Present parameters; replaced.
    normal, factor : (8, 8) float64
        Their lower triangles are filled with the normal matrix and its Cholesky factor.
    """
    right = np.zeros(8)
    row = np.zeros(8)
    normal[:] = 0.0
    n = 0
    # two equations for each match, one of x' and one of y'
    for i in range(query.shape[0]):
        if matched[i] < 0:
            continue
        n += 1
        u, v = query[i, 0], query[i, 1]
        w = 1.0 + p[6] * u + p[7] * v
        if w < 0.05:
            return False
        for axis in range(2):
            target = image[i, axis]
            row[:] = 0.0
            row[3 * axis] = u / w
            row[3 * axis + 1] = v / w
            row[3 * axis + 2] = 1.0 / w
            row[6] = -target * u / w
            row[7] = -target * v / w
            add_row(normal, right, row, 1.0, target / w)
    if n < 3:
        return False
    # hold the perspective, and whatever the matches do not determine
    normal[6, 6] += prior
    normal[7, 7] += prior
    for r in range(8):
        normal[r, r] += 1e-9
    if not cholesky(normal, factor):
        return False
    solve_cholesky(factor, right)
    for r in range(8):
        p[r] = right[r]
    return True


@kernel(forceinline=True)
def spread(row: NDArray[np.float64], factor: NDArray[np.float64], work: NDArray[np.float64]) -> float:
    """Return the variance of the value whose derivative is `row`, |L^-1 row|^2, L the factor of the step before."""
    total = 0.0
    for r in range(8):
        value = row[r]
        for c in range(r):
            value -= factor[r, c] * work[c]
        work[r] = value / factor[r, r]
        total += work[r] * work[r]
    return total


@kernel()
def predict(
    p: NDArray[np.float64],
    u: float,
    v: float,
    factor: NDArray[np.float64],
    row: NDArray[np.float64],
    work: NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """Return x', y', w of a normalised query point under the parameters `p` (8,), and its variance.

    That is summed over x and y, in units of the residuals' variance: with J (2, 8) the derivative of the point by p,
    the trace of J (L L^T)^-1 J^T.

    Parameters
    ----------
    factor : (8, 8) float64
        L, as left by `fit_homography`.
    row, work : (8,) float64
        Room to work in.
    """
    x, y, w = point_row(p, u, v, 1.0, 0.0, row)
    variance = spread(row, factor, work)
    point_row(p, u, v, 0.0, 1.0, row)
    return x, y, w, variance + spread(row, factor, work)
