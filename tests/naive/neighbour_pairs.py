"""Slow, obvious twins of the kernels of neighbour pairs: of the same names. What has a twin of its own is called."""

from itertools import combinations

import numpy as np

from roadgeo.kernels.growth import nearest_alike
from roadgeo.kernels.rays import rays_agree


def turned(tangents, line):
    """Angles of tangents from a line, modulo pi."""
    return [(t - line) % np.pi for t in tangents if not np.isnan(t)]


def describe_end(tangents, line, min_sine):
    """Falling cotangents of the two usable tangents that cross most openly, or None."""
    angles = [r for r in turned(tangents, line) if np.sin(r) >= min_sine]
    open_by, chosen = max(((abs(np.sin(p - q)), (p, q)) for p, q in combinations(angles, 2)), default=(0.0, ()))
    return sorted((1 / np.tan(r) for r in chosen), reverse=True) if open_by > min_sine else None


def describe_pair(xy, tangents, a, b, min_sine):
    """Four cotangents and the logarithm of the ratio of their gaps, or None."""
    line = np.arctan2(*(xy[b] - xy[a])[::-1])
    ends = [describe_end(tangents[i], line, min_sine) for i in (a, b)]
    if None in ends:
        return None
    (c1, c2), (c3, c4) = ends
    return np.array([c1, c2, c3, c4, np.log((c1 - c2) / (c3 - c4))])


def fit_pencils(query, reference):
    """Weighted least squares with numpy, the weights renewed once."""
    gaps = [pair[0:4:2] - pair[1:4:2] for pair in (reference, query)]
    alpha = np.sqrt(np.prod(gaps[0] / gaps[1]))
    for _ in range(2):
        weight = ((alpha * (1 + query[:4] ** 2)) ** 2 + (1 + reference[:4] ** 2) ** 2) ** -0.5
        rows = np.column_stack([query[:4], np.ones(4)]) * weight[:, None]
        (alpha, beta), *_ = np.linalg.lstsq(rows, reference[:4] * weight, rcond=None)
        if alpha <= 0:
            return None
        error = np.sum((rows @ (alpha, beta) - reference[:4] * weight) ** 2)
    return alpha, beta, error


def is_alike(pair, other, spread, max_error):
    """Whether two pairs may be the same."""
    fit = fit_pencils(pair, other)
    return abs(pair[4] - other[4]) <= spread and fit is not None and fit[2] <= max_error


def affine_of(start, end, ref_start, ref_end, alpha, beta):
    """The linear map that takes one pair to another and cotangents c to alpha c + beta."""

    def frame(step):
        return np.array([[step[0], -step[1]], [step[1], step[0]]])

    inside = np.array([[1.0, beta / alpha], [0.0, 1.0 / alpha]])
    return frame(ref_end - ref_start) @ inside @ np.linalg.inv(frame(end - start))


def find_pairs(scene, a, b, pair, spread, max_error, scale, min_ratio, min_cos, reach, least, index, ends, pairs):
    """Rows (map intersection, partners, affine map) in the order of the map's pairs."""
    xy, found = scene.intersections.xy, []
    for (i, j), other in zip(ends, pairs, strict=True):
        if not is_alike(pair, other, spread, max_error):
            continue
        matrix = affine_of(xy[a], xy[b], index.xy[i], index.xy[j], *fit_pencils(pair, other)[:2])
        large, small = np.linalg.svd(matrix, compute_uv=False)
        if not scale[0] ** 2 <= large * small <= scale[1] ** 2 or small < min_ratio * large:
            continue
        if not all(
            rays_agree(scene.branches, q, index.branches, r, *matrix.ravel(), min_cos) for q, r in ((a, i), (b, j))
        ):
            continue
        partners = []
        for k in scene.neighbours[a]:
            where = -1
            if k == b:
                where = j
            elif k >= 0:
                away = matrix @ (xy[k] - xy[a])
                radius = min(reach[0] + reach[1] * np.hypot(*away), reach[2])
                where, _ = nearest_alike(
                    *(index.xy[i] + away), radius, scene.branches, k, index.xy, index.branches, index.point_starts,
                    index.grid, index.shape, *matrix.ravel(), min_cos,
                )  # fmt: skip
                where = -1 if where in (i, j) else where
            partners.append(int(where))
        if sum(p >= 0 for p in partners) >= least:
            found.append((int(i), partners, matrix))
    return found
