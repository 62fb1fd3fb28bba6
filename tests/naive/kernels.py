"""Slow, obvious twins of the matching engine's kernels: of the same names, without buckets and without early exits."""

from itertools import combinations, permutations, product

import numpy as np

from roadgeo.geometry.lens import Lens
from roadgeo.kernels.triple_codes import UNITS

# buckets


def nearest_neighbours(xy, k):
    """Distances (N, k) of each point's nearest others, NaN where there are fewer."""
    far = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    found = np.full((len(xy), k), np.nan)
    for i in range(len(xy)):
        others = np.sort(np.delete(far[i], i))[:k]
        found[i, : len(others)] = others
    return found


# rays


def vectors(branches):
    """Branches of one intersection without the padding, (n, 2) float."""
    return branches[(branches != 0).any(axis=1)].astype(float)


def rays_agree(branches, i, ref_branches, j, J, tolerance):
    """Each branch in turn takes the nearest free partner within `tolerance` radians; the poorer side must be served."""
    turned = [np.arctan2(*(J @ b)[::-1]) for b in vectors(branches[i])]
    free = [np.arctan2(*b[::-1]) for b in vectors(ref_branches[j])]
    needed = min(len(turned), len(free))
    taken = 0
    for angle in turned:
        gaps = [abs((angle - other + np.pi) % (2 * np.pi) - np.pi) for other in free]
        if gaps and min(gaps) < tolerance:
            free.pop(int(np.argmin(gaps)))
            taken += 1
    return taken >= needed


# roads


def bin_segments(segments, grid, shape):
    """For every bucket the segments that pass through its square, sampled finely."""
    listed = [set() for _ in range(shape[0] * shape[1])]
    for s, (x1, y1, x2, y2) in enumerate(segments.astype(float)):
        for t in np.linspace(0, 1, 400):
            c = int(np.floor((x1 + t * (x2 - x1) - grid[0]) / grid[2]))
            r = int(np.floor((y1 + t * (y2 - y1) - grid[1]) / grid[2]))
            if 0 <= c < shape[0] and 0 <= r < shape[1]:
                listed[r * shape[0] + c].add(s)
    return listed


def nearest_road(x, y, dx, dy, radius, min_cos, segments):
    """(distance, foot, direction) of the nearest road alike in direction, among all."""
    start, stop = np.split(segments.astype(float), 2, axis=1)
    step = stop - start
    length = np.hypot(*step.T)
    is_alike = (length > 0) & (abs(step @ (dx, dy)) >= min_cos * length)
    start, step, length = start[is_alike], step[is_alike], length[is_alike, None]
    t = (((x, y) - start) * step).sum(axis=1, keepdims=True) / length**2
    foot = start + np.clip(t, 0, 1) * step
    distance = np.append(np.hypot(*(foot - (x, y)).T), radius)
    k = distance.argmin()
    return (distance[k], foot[k], (step / length)[k]) if distance[k] < radius else (np.inf, np.zeros(2), np.zeros(2))


def meets_road(x, y, dx, dy, radius, min_cos, segments):
    return bool(np.isfinite(nearest_road(x, y, dx, dy, radius, min_cos, segments)[0]))


def transform(matrix, xy):
    """A point under a homography, or None beyond the horizon."""
    x, y, w = matrix @ (*xy, 1.0)
    return np.array([x, y]) / w if w > 0 else None


def jacobian(matrix, xy, step=1e-4):
    """By central differences."""
    columns = [(transform(matrix, xy + move) - transform(matrix, xy - move)) / (2 * step) for move in step * np.eye(2)]
    return np.stack(columns, axis=1)


def shares_near_roads(matrix, points, directions, weights, radius, min_cos, shifts, segments):
    radii, shares = np.full(len(points), radius), []
    for x, y in shifts:
        moved = np.array([[1, 0, x], [0, 1, y], [0, 0, 1]]) @ matrix
        found = road_residuals(moved, points, directions, radii, min_cos, segments)
        shares.append(np.average(np.isfinite(found[:, 0]), weights=weights))
    return shares


def count_residuals(
    matrix, points, directions, weights, radius, min_cos, step, segments, inside, field, field_scale, observed, n
):
    """Weights of points, and pixels of the map's road, by the distance of the other: `n` bins, and none so near."""
    forward, backward = np.zeros(n + 1), np.zeros(n + 1)
    edges = np.linspace(0.0, radius, n + 1)
    distances = road_distances(matrix, points, directions, radius, min_cos, segments)
    for distance, weight in zip(distances, weights, strict=True):
        forward[np.searchsorted(edges, distance, side="right") - 1 if distance < radius else n] += weight
    inverse = np.linalg.inv(matrix)
    for s, (x1, y1, x2, y2) in enumerate(segments.astype(float)):
        length = np.hypot(x2 - x1, y2 - y1)
        count = int(length / step + (s * 0.6180339887) % 1.0)
        for k in range(count):
            place = np.array([x1, y1]) + (k + 0.5) / count * np.array([x2 - x1, y2 - y1])
            pixel = transform(inverse, place)
            if not inside(*place) or pixel is None:
                continue
            column, row = np.floor(pixel * (1, -1) / field_scale).astype(int)
            if not (0 <= row < field.shape[0] and 0 <= column < field.shape[1]) or not observed[row, column]:
                continue
            scale = np.sqrt(abs(np.linalg.det(jacobian(inverse, place))))
            distance = max(field[row, column] - 0.5, 0.0) * field_scale / scale  # field: a road's own cell has 0 or 1
            backward[np.searchsorted(edges, distance, side="right") - 1 if distance < radius else n] += (
                length / count * scale
            )
    return forward, backward


def screen(references, affines, anchor_xy, ref_xy, points, directions, radius, radius_px, min_cos, least, segments):
    shares = []
    for reference, affine in zip(references, affines, strict=True):
        J = affine.reshape(2, 2)
        reach = radius + radius_px * np.sqrt(np.linalg.det(J))
        hits = 0
        for point, direction in zip(points, directions, strict=True):
            place = ref_xy[reference] + J @ (point - anchor_xy)
            along = J @ direction / np.hypot(*(J @ direction))
            hits += nearest_road(*place, *along, reach, min_cos, segments)[0] < np.inf
        share = hits / len(points) if len(points) else 1.0
        shares.append(share if len(points) - hits <= (1.0 - least) * len(points) else 0.0)
    return np.array(shares)


def road_residuals(matrix, points, directions, radii, min_cos, segments):
    """(S, 3): the way to the nearest road along its normal, and the normal; NaN where there is no road."""
    out = np.full((len(points), 3), np.nan)
    for i, (point, direction, radius) in enumerate(zip(points, directions, radii, strict=True)):
        place = transform(matrix, point)
        if place is None:
            continue
        along = jacobian(matrix, point) @ direction
        distance, foot, road = nearest_road(*place, *(along / np.hypot(*along)), radius, min_cos, segments)
        if distance < np.inf:
            across = np.array([-road[1], road[0]])
            out[i] = across @ (foot - place), *across
    return out


def road_distances(matrix, points, directions, radius, min_cos, segments):
    """(S,) metres to the nearest road, to its end where that is nearest; inf where there is none."""
    found = np.full(len(points), np.inf)
    for i, (point, direction) in enumerate(zip(points, directions, strict=True)):
        place = transform(matrix, point)
        if place is not None:
            along = jacobian(matrix, point) @ direction
            found[i] = nearest_road(*place, *(along / np.hypot(*along)), radius, min_cos, segments)[0]
    return found


# growth


class GivenUpError(Exception):
    """A fit has too few points, or one of them at the horizon."""


def predict(p, u, v):
    a, b, c, d, e, f, g, h = map(float, p)
    w = g * u + h * v + 1.0
    return np.array([(a * u + b * v + c) / w, (d * u + e * v + f) / w])


def predict_rows(p, u, v, step=1e-6):
    """(2, 8) derivative of a predicted point by the parameters, by central differences."""
    return np.stack([(predict(p + move, u, v) - predict(p - move, u, v)) / (2 * step) for move in step * np.eye(8)], 1)


def fit_points(query, image, matched, prior, p):
    """One Gauss-Newton step to matched points. Returns p (8,) and the normal matrix."""
    normal, right = 1e-9 * np.eye(8) + np.diag([0.0] * 6 + [prior] * 2), np.append(np.zeros(6), -prior * p[6:8])
    for point, place, m in zip(query, image, matched, strict=True):
        if m >= 0:
            more, side = add_point(np.append(p, 0.0), 1.0, point, place, 1.0, 8)
            normal, right = normal + more, right + side
    return p + np.linalg.solve(normal, right), normal


def prediction_variance(normal, p, u, v):
    rows = predict_rows(p, u, v)
    return np.trace(rows @ np.linalg.inv(normal) @ rows.T)


def nearest_alike(x, y, radius, branches, i, ref_xy, ref_branches, J, tolerance):
    away = np.hypot(*(ref_xy - (x, y)).T)
    for j in np.argsort(away, kind="stable"):
        if away[j] >= radius:
            break
        if rays_agree(branches, i, ref_branches, j, J, tolerance):
            return j, away[j]
    return -1, radius


def keep_nearest(matched, distance):
    """Every partner's nearest claimant keeps it, the first of equals."""
    kept = np.full(len(matched), -1)
    for partner in set(matched[matched >= 0].tolist()):
        claimants = np.flatnonzero(matched == partner)
        kept[claimants[np.argmin(distance[claimants])]] = partner
    return kept


def match_all(matrix, xy, branches, radius, tolerance, ref_xy, ref_branches):
    matched, distance = np.full(len(xy), -1), np.full(len(xy), float(radius))
    for i, point in enumerate(xy):
        place = transform(matrix, point)
        if place is not None:
            matched[i], distance[i] = nearest_alike(
                *place, radius, branches, i, ref_xy, ref_branches, jacobian(matrix, point), tolerance
            )
    return matched, distance


def grow(
    xy, branches, order, half_size, anchor, ref_anchor, affine, neighbours, partners, ref_xy, ref_branches,
    sigma_m, radius_m, tolerance, perspective_sigma, hit_rate, chance_rate, patience,
):  # fmt: skip
    """(ratio, matches, tests, matched, matrix) of a hypothesis that grows from its seeds, or GivenUpError."""
    unit = half_size * np.sqrt(np.linalg.det(affine.reshape(2, 2)))
    query = (xy - xy[anchor]) / half_size
    seeds = {anchor: ref_anchor, **{int(neighbours[anchor, s]): int(b) for s, b in enumerate(partners) if b >= 0}}
    matched = np.full(len(xy), -1)
    matched[list(seeds)] = list(seeds.values())
    prior = (sigma_m / unit) ** 2 / perspective_sigma**2
    hit, miss = np.log(hit_rate / chance_rate), np.log((1 - hit_rate) / (1 - chance_rate))

    def fit(p):
        if (matched >= 0).sum() < 3 or (1.0 + query[matched >= 0] @ p[6:] < 0.05).any():
            raise GivenUpError
        return fit_points(query, (ref_xy[matched] - ref_xy[ref_anchor]) / unit, matched, prior, p)

    def search(i, p, normal):
        """(place, search radius, Jacobian) of a query point, or None near the horizon."""
        model = np.append(p, 1.0).reshape(3, 3)
        if model[2] @ (*query[i], 1.0) < 0.1:
            return None
        spread = np.sqrt(0.5 * prediction_variance(normal, p, *query[i]))
        place = ref_xy[ref_anchor] + unit * predict(p, *query[i])
        return place, 2.5 * sigma_m * np.hypot(spread, 1.0), jacobian(model, query[i])

    p, normal = fit(np.zeros(8))
    p, normal = fit(p)
    ratio, fitted, tested = 0.0, len(seeds), set(seeds)
    for _ in range(8):
        news = 0
        for i in order:
            if i in tested:
                continue
            found = search(i, p, normal)
            if found is None or found[1] > radius_m:
                continue
            place, radius, J = found
            tested.add(i)
            j, _ = nearest_alike(*place, radius, branches, i, ref_xy, ref_branches, J, tolerance)
            ratio += hit if j >= 0 else miss
            if j < 0 and ratio < -patience:
                raise GivenUpError
            if j >= 0:
                news += 1
                matched[i] = j
                if (matched >= 0).sum() >= 1.2 * fitted:
                    p, normal = fit(p)
                    fitted = (matched >= 0).sum()
        p, normal = fit(p)
        if news == 0:
            break
    for _ in range(2):
        distance = np.full(len(xy), np.inf)
        matched = np.full(len(xy), -1)
        for i in order:
            found = search(i, p, normal)
            if found is not None:
                place, radius, J = found
                reach = min(radius, radius_m)
                matched[i], distance[i] = nearest_alike(*place, reach, branches, i, ref_xy, ref_branches, J, tolerance)
        matched = keep_nearest(matched, distance)
        others = [i for i in order if i not in seeds]
        hits = sum(matched[i] >= 0 for i in others)
        ratio = hits * hit + (len(others) - hits) * miss
        p, normal = fit(p)
    to_query = np.array(
        [[1 / half_size, 0, -xy[anchor, 0] / half_size], [0, 1 / half_size, -xy[anchor, 1] / half_size]]
    )
    to_ground = np.array([[unit, 0, ref_xy[ref_anchor, 0]], [0, unit, ref_xy[ref_anchor, 1]], [0, 0, 1]])
    matrix = to_ground @ np.append(p, 1.0).reshape(3, 3) @ np.vstack([to_query, [0, 0, 1]])
    return ratio, hits, len(others), matched, matrix


# growth by roads


def nearest_in_plane(p, unit, origin, point, direction, radius, min_cos, segments):
    """(place, foot, direction) of the road nearest to a mapped road point, or None."""
    place = origin + unit * predict(p, *point)
    along = jacobian(np.append(p, 1.0).reshape(3, 3), point) @ direction
    distance, foot, road = nearest_road(*place, *(along / np.hypot(*along)), radius, min_cos, segments)
    return (place, foot, road) if distance < np.inf else None


def fit_to_roads(p, unit, origin, points, directions, radius, min_cos, holds, segments):
    """The parameters after one Gauss-Newton step, with Cauchy weights of half the radius."""
    rows, weights, residuals = [], [], []
    for point, direction in zip(points, directions, strict=True):
        found = nearest_in_plane(p, unit, origin, point, direction, radius, min_cos, segments)
        if found is not None:
            place, foot, road = found
            across = np.array([-road[1], road[0]])
            away = across @ (foot - place)
            rows.append(across @ predict_rows(p, *point))
            weights.append(1.0 / (1.0 + (2.0 * away / radius) ** 2))
            residuals.append(away / unit)
    A, W = np.array(rows), np.array(weights)
    return p + np.linalg.solve(A.T @ (W[:, None] * A) + np.diag(holds), A.T @ (W * residuals))


def share_on_roads(p, unit, origin, points, directions, radius, min_cos, segments):
    """Share of the points nearer than the radius to roads, and the mean of their closeness across the road."""
    closeness = []
    for pair in zip(points, directions, strict=True):
        found = nearest_in_plane(p, unit, origin, *pair, radius, min_cos, segments)
        if found is not None:
            place, foot, road = found
            closeness.append(1.0 - abs(np.array([-road[1], road[0]]) @ (foot - place)) / radius)
    return len(closeness) / len(points), sum(closeness) / len(points)


def grow_by_roads(ps, unit, origins, tolerance, points, directions, stages, segments):
    """Grow maps side by side, the worst given up after each of the first stages; `ps` are adjusted in place."""
    n = len(points)
    scores = np.zeros(len(ps))
    counts = [min(60, n)]
    while counts[-1] < n:
        counts.append(min(int(counts[-1] * 1.45) + 1, n))
    for stage, count in enumerate(counts):
        some, along = (array[: count : max(1, count // 120)] for array in (points, directions))
        bent = count == n or np.hypot(*points[count - 1]) > stages.affine_until
        slack = 0.08, 0.08, 10.0 / unit
        holds = (12.0 / unit / np.array([*slack, *slack, *2 * [stages.perspective_sigma if bent else np.nan]])) ** 2
        holds = np.nan_to_num(holds, nan=1e9)
        for m in np.flatnonzero(scores >= 0):
            for radius in (18.0 if stage else 25.0, 12.0 if stage else 18.0, 12.0):
                radius = max(radius, 1.5 * tolerance)
                ps[m] = fit_to_roads(ps[m], unit, origins[m], some, along, radius, stages.min_cos, holds, segments)
            share, closeness = share_on_roads(ps[m], unit, origins[m], some, along, tolerance, stages.min_cos, segments)
            scores[m] = closeness if share >= stages.least_share else -1.0
        if stage < len(stages.go_on) and count < n:
            others = [m for m in np.flatnonzero(scores >= 0) if m >= stages.sure]
            best = sorted(others, key=lambda m: (-scores[m], m))
            scores[best[stages.go_on[stage] :]] = -1.0
    return scores


# adjustment


def own_sigma(reach_m, sigma_m, map_sigma_m, mask_sigma):
    """The map's and the mask's part of how unsure a point is, in that of the middle of the frame."""
    return np.sqrt(map_sigma_m**2 + (mask_sigma * reach_m) ** 2) / sigma_m


def see(p, half_side, uv):
    """Where a normalised point comes to lie, by a homography p[:8] behind a lens p[8]; NaN where w < 0.02."""
    straight = Lens(p[8], (0.0, 0.0), half_side).straighten(np.asarray(uv, float))
    return predict(p[:8], *straight) if 1.0 + straight @ p[6:8] >= 0.02 else np.full(2, np.nan)


def see_rows(p, half_side, uv, step=1e-6):
    """(2, 9) derivative of that by the parameters, by central differences."""
    moves = step * np.eye(9)
    return np.stack([(see(p + m, half_side, uv) - see(p - m, half_side, uv)) / (2 * step) for m in moves], 1)


def see_jacobian(p, half_side, uv, step=1e-6):
    """(2, 2) derivative of that by the point, likewise."""
    moves = step * np.eye(2)
    return np.stack([(see(p, half_side, uv + m) - see(p, half_side, uv - m)) / (2 * step) for m in moves], 1)


def add_point(p, half_side, point, place, weight, n):
    """(normal matrix (n, n), right side (n,)) of the two equations of a point."""
    rows = see_rows(p, half_side, point)[:, :n]
    return weight * rows.T @ rows, weight * rows.T @ (place - see(p, half_side, point))


def meet_roads(p, plane, points, limits, inverse, segments):
    """(whether its place is sure enough, row, residual, sigma, own) of each point, None for what there is not."""
    found = []
    for point, direction in zip(points.xy, points.directions, strict=True):
        place, local = see(p, points.half_side, point), see_jacobian(p, points.half_side, point)
        along = local @ direction
        reach = plane.unit * abs(np.linalg.det(local)) / np.hypot(*along)
        along /= np.hypot(*along)
        rows = see_rows(p, points.half_side, point)[:, : len(inverse)]
        row = np.array([-along[1], along[0]]) @ rows
        own = own_sigma(reach, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
        sigma = limits.sigma_m * np.sqrt(own**2 + row @ inverse @ row)
        if not 3 * sigma <= limits.max_radius * max(1.0, own):
            found.append((False, None, None, None, None))
            continue
        here = np.array([plane.x, plane.y]) + plane.unit * place
        distance, foot, road = nearest_road(*here, *along, 3 * sigma, limits.min_cos, segments)
        across = np.array([-road[1], road[0]])
        is_met = distance < np.inf
        found.append((True, across @ rows, across @ (foot - here), sigma, own) if is_met else (True, *[None] * 4))
    return found


def adjust(p, free, plane, points, pairs, held, limits, segments):
    """(p, road points used, rms, normal matrix) of Gauss-Newton steps with Cauchy weights on `free` parameters."""
    shares = np.ones(limits.n_cells)
    previous, rms, normal, half_side = -1, np.inf, None, points.half_side
    for iteration in range(limits.n_iterations + 1):
        prior = limits.prior[:free]
        before, normal, right = normal, np.diag(prior + 1e-9), -prior * p[:free]
        both = []
        for pair, target, cell in zip(pairs.query, pairs.reference, pairs.cells, strict=True):
            far = np.hypot(*(target - see(p, half_side, pair))) * plane.unit
            if shares[cell] >= limits.least_share and far <= limits.max_radius:
                reach = plane.unit * np.sqrt(abs(np.linalg.det(see_jacobian(p, half_side, pair))))
                own = own_sigma(reach, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
                both.append((pair, target, pairs.weight / (own**2 + (far / (2 * limits.sigma_m)) ** 2)))
        if iteration < 6:
            both += [(*item, held.weight * 0.5**iteration) for item in zip(held.query, held.reference, strict=True)]
        for entry in both:
            more, side = add_point(p, half_side, *entry, free)
            normal, right = normal + more, right + side
        used = []
        if iteration > 0:
            found = meet_roads(p, plane, points, limits, np.linalg.inv(before), segments)
            for cell in range(limits.n_cells):
                here = [result for result, c in zip(found, points.cells, strict=True) if c == cell and result[0]]
                shares[cell] = np.mean([item[1] is not None for item in here]) if here else 1.0
            used = [
                result[1:]
                for result, cell in zip(found, points.cells, strict=True)
                if result[1] is not None and shares[cell] >= limits.least_share
            ]
            for row, residual, sigma, own in used:
                weight = points.weight / own**2 / (1 + (residual / sigma) ** 2)
                normal, right = normal + weight * np.outer(row, row), right + weight * row * residual / plane.unit
            if used:
                r, s, own = np.array([item[1:] for item in used]).T
                cauchy = 1 / (1 + (r / s) ** 2)
                slope = (1 - (r / s) ** 2) * cauchy**2  # of the influence r * cauchy
                rms = np.sqrt(np.mean((cauchy * r / own) ** 2) * cauchy.mean()) / max(slope.mean(), 0.1 * cauchy.mean())
        step = np.linalg.solve(normal, right)
        p = p + np.append(step, np.zeros(9 - free))
        settled = iteration > (6 if len(held.query) else 1)
        if settled and np.abs(step).max() * plane.unit < limits.tolerance_m and len(used) <= previous:
            break
        previous = len(used)
    return p, previous, rms, normal


# triples


def vertex_angle(e1, e2, tangent):
    """The tangent's angle after the affine map that sends e1, e2 to +-30 degrees about the axis, in units."""
    equilateral = np.array([[np.cos(np.pi / 6), np.cos(np.pi / 6)], [-0.5, 0.5]])
    direction = equilateral @ np.linalg.inv(np.stack([e1, e2], axis=1)) @ (np.cos(tangent), np.sin(tangent))
    return np.arctan2(*direction[::-1]) * UNITS / np.pi % (2 * UNITS)


def sides_of(tangent, branches):
    """Whether branches run along a tangent forwards, backwards ("both" if neither)."""
    along = branches.astype(float) @ (np.cos(tangent), np.sin(tangent)) / 127
    ways = (bool((along > 0.87).any()), bool((along < -0.87).any()))
    return ways if any(ways) else (True, True)


def vertex_codes(xy, tangents, branches, i, j, k, limit):
    """((u1, sides), (u2, sides)), u1 <= u2 whole units, of vertex i, those first that cross most openly."""
    seen = []
    for t in tangents[i][np.isfinite(tangents[i])]:
        unit = int(vertex_angle(xy[j] - xy[i], xy[k] - xy[i], t)) % (2 * UNITS)
        ways = sides_of(t, branches[i])
        seen.append((unit % UNITS, ways if unit < UNITS else ways[::-1]))
    pairs = [tuple(sorted(pair, key=lambda item: item[0])) for pair in combinations(seen, 2)]

    def openness(pair):
        between = pair[1][0] - pair[0][0]
        return min(between, UNITS - between)

    return sorted(pairs, key=lambda pair: -openness(pair))[:limit]


def shape_of(xy, a, b, c):
    """Twice the area over the longest side squared, positive where a, b, c run counterclockwise."""
    sides = [xy[b] - xy[a], xy[c] - xy[a], xy[c] - xy[b]]
    return (sides[0][0] * sides[1][1] - sides[0][1] * sides[1][0]) / max(side @ side for side in sides)


def fill_table(xy, tangents, branches, neighbours, min_shape, limit):
    """The multiset of (anchor, b, c, codes) of all triples, each anchored once."""
    near = [set(row[row >= 0].tolist()) for row in neighbours]
    rows = []
    for triple in combinations(range(len(xy)), 3):
        anchors = [a for a in triple if set(triple) - {a} <= near[a]]
        if not anchors or abs(shape_of(xy, *triple)) < min_shape:
            continue
        a = min(anchors)
        b, c = set(triple) - {a}
        b, c = (b, c) if shape_of(xy, a, b, c) > 0 else (c, b)
        vertices = [(a, b, c), (b, c, a), (c, a, b)]
        rows += [
            (a, b, c, code) for code in product(*(vertex_codes(xy, tangents, branches, *v, limit) for v in vertices))
        ]
    return rows


def alike(code, other, tolerance):
    """Whether two pairs of (unit, sides), unordered, agree: within a tolerance, and no side missing in both."""

    def ways(first, turned):
        return {(way + turned) % 2 for way in (0, 1) if first[1][way]}

    for order in permutations(other):
        pairs = list(zip(code, order, strict=True))
        gaps = [(first[0] - two[0] + UNITS // 2) % UNITS - UNITS // 2 for first, two in pairs]
        if max(map(abs, gaps)) > tolerance:
            continue
        ours = {(n, way) for n, (first, _) in enumerate(pairs) for way in ways(first, 0)}
        turned = [int(first[0] - gap != two[0]) for (first, two), gap in zip(pairs, gaps, strict=True)]
        theirs = {(n, way) for n, (_, two) in enumerate(pairs) for way in ways(two, turned[n])}
        if ours <= theirs or theirs <= ours:
            return True
    return False


def look_up(code, table, tolerance):
    """(A, B, C) of all table rows that some turn of which has this code."""
    hits = []
    for *corners, other in table:
        for turn in range(3):
            turned = [other[(v + turn) % 3] for v in range(3)]
            if all(alike(u, v, tolerance) for u, v in zip(code, turned, strict=True)):
                hits.append(tuple(corners[(v + turn) % 3] for v in range(3)))
    return hits


def next_alike(sides, e, alike):
    """(first, last + 1) of the next run of equal sides from `e` on that stand in all three sets; the end if none do."""
    while e < len(sides):
        stop = e
        while stop < len(sides) and sides[stop] == sides[e]:
            stop += 1
        if all(digit in some for digit, some in zip(np.unravel_index(sides[e], (9, 9, 9)), alike, strict=True)):
            return e, stop
        e = stop
    return e, e


def look_up_each(query, a, slots, world, limit, tolerance, ray_tolerance, scale, min_ratio):
    """All (b, c, A, B, C), b and c counterclockwise after a, of one anchor's triples, through the gates."""
    table, found = list(world.decoded()), set()
    for s, t in slots:
        b, c = query.neighbours[a, s], query.neighbours[a, t]
        b, c = (b, c) if shape_of(query.xy, a, b, c) > 0 else (c, b)
        edges = np.stack([query.xy[b] - query.xy[a], query.xy[c] - query.xy[a]], axis=1)
        vertices = [(a, b, c), (b, c, a), (c, a, b)]
        codes = (vertex_codes(query.xy, query.tangents, query.branches, *v, limit) for v in vertices)
        for x, y, z in (hit for code in product(*codes) for hit in look_up(code, table, tolerance)):
            J = np.stack([world.xy[y] - world.xy[x], world.xy[z] - world.xy[x]], axis=1) @ np.linalg.inv(edges)
            big, small = np.linalg.svd(J, compute_uv=False)
            if not scale[0] <= np.sqrt(np.linalg.det(J)) <= scale[1] or small / big < min_ratio:
                continue
            pairs = zip((a, b, c), (x, y, z), strict=True)
            if all(rays_agree(query.branches, i, world.branches, j, J, ray_tolerance) for i, j in pairs):
                found.add((b, c, x, y, z))
    return found


def gather(ids, affine, n_slots, tolerance):
    """(A, partners, number placed, mean map) of each map intersection on which hits of several triples agree."""
    out = []
    for a in sorted(set(ids[:, 0].tolist())):
        group = np.flatnonzero(ids[:, 0] == a)
        best = None
        for u in group:
            limit = tolerance * np.sqrt(2.0 * np.linalg.det(affine[u].reshape(2, 2)))
            partner = {int(ids[u, 1]): int(ids[u, 2]), int(ids[u, 3]): int(ids[u, 4])}
            together = []
            for v in group:
                placed = {int(ids[v, 1]): int(ids[v, 2]), int(ids[v, 3]): int(ids[v, 4])}
                alike = np.linalg.norm(affine[v] - affine[u]) <= limit
                if alike and all(partner.get(slot, place) == place for slot, place in placed.items()):
                    partner.update(placed)
                    together.append(v)
            if len(partner) > (2 if best is None else best[2]):
                places = [partner.get(slot, -1) for slot in range(n_slots)]
                best = a, places, len(partner), affine[together].mean(axis=0)
        out += [] if best is None else [best]
    return out
