"""Road points behind a lens, by the classes that know lenses and homographies."""

import numpy as np

from naive.kernels import nearest_road
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens


def lens_rows(p, k1, half_side, points, directions):
    """Places (S, 2), unit directions (S, 2) and derivatives (S, 2, 9); NaN where w < 0.02."""
    lens, homography = Lens(k1, (0.0, 0.0), half_side), Homography(np.append(p, 1.0).reshape(3, 3))
    straight = lens.straighten(points)
    straight = np.where((1.0 + straight @ p[6:8] >= 0.02)[:, None], straight, np.nan)
    jacobian = homography.jacobian(straight)
    along = np.einsum("nij,nj->ni", jacobian, lens.straighten_directions(points, directions))
    by_k1 = np.einsum("nij,nj->ni", jacobian, lens.moves(points))
    rows = np.concatenate([homography.by_elements(straight), by_k1[:, :, None]], axis=2)
    return homography.everywhere(straight), along / np.linalg.norm(along, axis=1, keepdims=True), rows


def meet_roads(p, k1, half_side, points, directions, inverse, limits, segments):
    """(row across the road, residual, sigma) of each point that meets a road, None for the others."""
    found = []
    for place, along, row in zip(*lens_rows(p, k1, half_side, points, directions), strict=True):
        spread = np.trace(row @ inverse @ row.T)
        sigma = limits.sigma_m * np.sqrt(1.0 + limits.slack**2 * max(spread, 0.0))
        here = limits.unit * place + (limits.x, limits.y)
        if not 3.0 * sigma <= limits.max_radius or np.isnan(here).any():
            found.append(None)
            continue
        distance, foot, road = nearest_road(*here, *along, 3.0 * sigma, limits.min_cos, segments)
        across = np.array([-road[1], road[0]]) if distance < np.inf else None
        found.append(None if across is None else (across @ row, across @ (foot - here), sigma))
    return found
