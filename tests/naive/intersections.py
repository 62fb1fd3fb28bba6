"""Slow, obvious twins of the kernels of `roadgeo.intersections`."""

import numpy as np


def walk(line, start, end, step=1e-3):
    """Points at every `step` of arc length between `start` and `end` of a polyline."""
    along = np.concatenate(([0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    s = np.arange(start + step / 2, end, step)
    return np.stack([np.interp(s, along, line[:, k]) for k in (0, 1)], axis=1)


def fit_branch(line, skip, reach, least):
    """Mean point, outward direction and mean square distance of one branch, or None."""
    length = np.hypot(*np.diff(line, axis=0).T).sum()
    if length < least:
        return None
    end = min(reach, length)
    points = walk(line, max(min(skip, end - least), 0), end)
    mean = points.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((points - mean).T, bias=True))
    direction = vectors[:, 1] * np.sign(vectors[:, 1] @ (points[-1] - points[0]))
    return mean, np.arctan2(direction[1], direction[0]), values[0]


def merge_lines(angles, merge_angle):
    """Groups of directions modulo pi whose means are apart by `merge_angle` or more."""
    angles = sorted(a % np.pi for a in angles)
    gaps = [(angles[k] - angles[k - 1]) % np.pi for k in range(len(angles))]
    first = int(np.argmax(gaps)) if len(angles) > 1 else 0
    turned = angles[first:] + [a + np.pi for a in angles[:first]]
    groups = []
    for a in turned:
        if groups and a - np.mean(groups[-1]) < merge_angle:
            groups[-1].append(a)
        else:
            groups.append([a])
    return sorted(np.mean(group) % np.pi for group in groups)
