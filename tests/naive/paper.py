"""Slow, obvious twins of the paper's method."""

from itertools import combinations

import numpy as np


def relative_angles(tangents, phi):
    """Angles of tangents counterclockwise from a line of direction phi, ascending in (0, pi)."""
    return np.sort((tangents[np.isfinite(tangents)].astype(float) - phi) % np.pi)


def list_pairs(xy, tangents, d_max, min_angle):
    """All unordered pairs that pass eq. 7-8, as a set of frozensets."""
    found = set()
    for i, j in combinations(range(len(xy)), 2):
        step = xy[j] - xy[i]
        if not 0 < np.hypot(*step) < d_max:
            continue
        angles = [relative_angles(tangents[k], np.arctan2(step[1], step[0])) for k in (i, j)]
        if all(len(r) >= 2 and (np.minimum(r, np.pi - r) > min_angle).all() for r in angles):
            found.add(frozenset((i, j)))
    return found


def cross_ratios(angles):
    """Cross ratios of all fours of {connecting line, tangents}, from sines (eq. 4)."""
    lines = [0.0, *angles]
    return [np.sin(c - a) * np.sin(d - b) / (np.sin(c - b) * np.sin(d - a)) for a, b, c, d in combinations(lines, 4)]


def describe_pairs(pairs, xy, tangents):
    rows = []
    for i, j in pairs:
        phi = np.arctan2(*(xy[j] - xy[i])[::-1])
        rows.append([c for k in (i, j) for c in cross_ratios(relative_angles(tangents[k], phi))])
    return np.array(rows)


def nearest_of_type(xy, codes, reference_xy, reference_codes, radius):
    found = []
    for point, code in zip(xy, codes, strict=True):
        distance = np.hypot(*(reference_xy - point).T)
        distance[reference_codes != code] = np.inf
        found.append(np.argmin(distance) if distance.min() < radius else -1)
    return np.array(found)


def line_through(point, angle):
    """Homogeneous line through a point."""
    return np.array([np.sin(angle), -np.cos(angle), point[1] * np.cos(angle) - point[0] * np.sin(angle)])


def homography_from_lines(lines, images):
    """Direct linear transformation of l' = H^-T l, that is l = H^T l' (eq. 9)."""
    rows = []
    for line, image in zip(lines, images, strict=True):
        line, image = line / np.linalg.norm(line), image / np.linalg.norm(image)
        cross = np.array([[0, -line[2], line[1]], [line[2], 0, -line[0]], [-line[1], line[0], 0]])
        rows.append(np.kron(cross, image))  # of H^T, row by row
    return np.linalg.svd(np.concatenate(rows))[2][-1].reshape(3, 3).T


def homography_from_pair(query_xy, query_tangents, pair, reference_xy, reference_tangents, image, signs=(1, 1)):
    """H from the connecting line and all tangents of two tuples; sign -1 pairs an end's tangents in reverse order."""
    lines, images = [], []
    for xy, tangents, ends, into in (
        (query_xy, query_tangents, pair, lines),
        (reference_xy, reference_tangents, image, images),
    ):
        phi = np.arctan2(*(xy[ends[1]] - xy[ends[0]])[::-1])
        into.append(line_through(xy[ends[0]], phi))
        for end, sign in zip(ends, signs, strict=True):
            angles = phi + relative_angles(tangents[end], phi)
            into.extend(line_through(xy[end], a) for a in (angles[::sign] if into is lines else angles))
    H = homography_from_lines(lines, images)
    w = H[2] @ [*query_xy[pair[0]], 1.0]
    return H / w


def evaluate_pairs(query, pair, reference, candidates, frame, radius, is_physical):
    """Inlier counts of all candidates (-1 where not physical), and their homographies."""
    query_xy, query_tangents, query_codes = query
    reference_xy, reference_tangents, reference_codes = reference
    counts, models = [], []
    for image in candidates:
        H = homography_from_pair(query_xy, query_tangents, pair, reference_xy, reference_tangents, image)
        w = np.column_stack([np.array([*frame, query_xy[pair[1]]]), np.ones(5)]) @ H[2]
        models.append(H)
        if is_physical and not ((w > 0).all() and np.linalg.det(H) > 0):
            counts.append(-1)
            continue
        mapped = np.column_stack([query_xy, np.ones(len(query_xy))]) @ H.T
        nearest = nearest_of_type(mapped[:, :2] / mapped[:, 2:], query_codes, reference_xy, reference_codes, radius)
        counts.append(int((nearest >= 0).sum()))
    return np.array(counts), models
