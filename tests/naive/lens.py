"""Road points behind a lens, by the classes that know lenses and homographies."""

import numpy as np

from naive.kernels import nearest_road, own_sigma
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


def reach(p, k1, half_side, points, directions):
    """How far across its road a step of 1 reaches at each point (S,)."""
    lens, homography = Lens(k1, (0.0, 0.0), half_side), Homography(np.append(p, 1.0).reshape(3, 3))
    whole = homography.jacobian(lens.straighten(points)) @ lens.stretch(points)
    return abs(np.linalg.det(whole)) / np.linalg.norm(np.einsum("nij,nj->ni", whole, directions), axis=1)


def meet_roads(p, k1, half_side, points, directions, inverse, limits, segments):
    """(row across the road, residual, sigma, own) of each point that meets a road, None for the others."""
    found = []
    reaches = reach(p, k1, half_side, points, directions)
    for place, along, row, far in zip(*lens_rows(p, k1, half_side, points, directions), reaches, strict=True):
        spread = np.trace(row @ inverse @ row.T)
        own = own_sigma(limits.unit * far, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
        sigma = limits.sigma_m * np.sqrt(own**2 + limits.slack**2 * max(spread, 0.0))
        here = limits.unit * place + (limits.x, limits.y)
        if not 3.0 * sigma <= limits.max_radius * max(1.0, own) or np.isnan(here).any():
            found.append(None)
            continue
        distance, foot, road = nearest_road(*here, *along, 3.0 * sigma, limits.min_cos, segments)
        across = np.array([-road[1], road[0]]) if distance < np.inf else None
        found.append(None if across is None else (across @ row, across @ (foot - here), sigma, own))
    return found
