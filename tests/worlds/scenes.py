"""Made-up road networks, and what a camera above them sees, with everything known; no mask is drawn."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import shapely
from scipy.spatial import Delaunay

from roadgeo.geometry.projection import LocalPlane
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.growing import SharedSweeps
from roadgeo.matching.scene import Scene, prepare_scene
from roadgeo.matching.search import Search, SearchOptions, search_together
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import IntersectionOptions, find_intersections
from roadgeo.roads.network import RoadNetwork, build_network
from worlds.drawn import camera, joined, mapped, vertices

__all__ = [
    *("PLANE", "Sight", "camera", "estimator_of", "look", "mapped", "random_lines", "random_network", "scene_of"),
    *("search", "soft"),
]

PLANE = LocalPlane("EPSG:32619", (330000.0, 4690000.0))


def random_lines(seed: int, side: float = 3000.0, spacing: float = 120.0) -> list[shapely.LineString]:
    """Roads of a made-up town: a triangulation of scattered points, without what leaves a node too sharply."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, side, (int(3 * (side / spacing) ** 2), 2))
    n = 0
    xy = np.empty_like(points)
    for point in points:
        if (np.hypot(*(xy[:n] - point).T) > 0.75 * spacing).all():
            xy[n] = point
            n += 1
    xy = xy[:n]
    triangles = Delaunay(xy).simplices
    pairs = np.unique(np.sort(np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]])), axis=0)
    length = np.hypot(*(xy[pairs[:, 0]] - xy[pairs[:, 1]]).T)
    taken: dict[int, list[float]] = {i: [] for i in range(len(xy))}
    lines, least = [], math.cos(math.radians(50))
    angles = np.arctan2(*(xy[pairs[:, 1]] - xy[pairs[:, 0]]).T[::-1]).tolist()
    for pair in np.argsort(length):
        (a, b), angle = pairs[pair], angles[pair]
        at = ((a, angle), (b, angle + np.pi))
        if any(math.cos(angle - other) > least for n, angle in at for other in taken[n]):
            continue
        for n, angle in at:
            taken[n].append(angle)
        if rng.uniform() < 0.12:  # a block of its own size and shape here and there
            continue
        middle = (xy[a] + xy[b]) / 2 + rng.normal(0, 4, 2)
        lines.append(shapely.LineString([xy[a], middle, xy[b]]))
    return lines


@lru_cache(maxsize=16)
def random_network(seed: int, side: float = 3000.0, spacing: float = 120.0) -> RoadNetwork:
    """The same as a reference has it."""
    return build_network(random_lines(seed, side, spacing), PLANE, {"name": f"town {seed}"})


@dataclass(frozen=True)
class Sight:
    """How well the query sees: standard deviation of its roads' places in metres, over stretches of 60 m, the share of
    roads it misses, and the share that is not there."""

    sigma_m: float = 0.0
    missing: float = 0.0
    false: float = 0.0


def look(
    network: RoadNetwork,
    matrix: np.ndarray,
    size: tuple[int, int] = (1000, 1000),
    sight: Sight | None = None,
    seed: int = 0,
) -> RoadGraph:
    """The network as a camera sees it, in the query plane; roads end at the frame."""
    rng = np.random.default_rng(seed)
    sight = sight or Sight()
    graph = network.graph
    back = np.linalg.inv(matrix)
    low, high = np.array([0.0, -size[1]]), np.array([size[0], 0.0])
    moved = graph.xy + rng.normal(0, sight.sigma_m, graph.xy.shape) if sight.sigma_m else graph.xy
    width = float(np.ptp(graph.xy))
    nodes: list[np.ndarray] = []
    number: dict[int, int] = {}
    edges, lines = [], []

    def node(n: int, xy: np.ndarray) -> int:
        if n < 0 or n not in number:
            if n >= 0:
                number[n] = len(nodes)
            nodes.append(xy)
        return number[n] if n >= 0 else len(nodes) - 1

    chosen, drawn = [], []
    for ends, line in zip(graph.edges, vertices(graph.lines(), 60.0), strict=True):
        if rng.uniform() < sight.missing:
            continue
        if sight.sigma_m:
            line[1:-1] += rng.normal(0, sight.sigma_m, (len(line) - 2, 2))
        line[[0, -1]] = moved[ends]
        chosen.append(ends)
        drawn.append(line)
    fine = vertices(joined(drawn), 10.0)
    xy = np.concatenate(fine)
    seen = mapped(back, xy)
    ahead = xy @ back[2, :2] + back[2, 2] > 0
    inside = ahead & (seen > low).all(axis=1) & (seen < high).all(axis=1)
    line = np.repeat(np.arange(len(fine)), [*map(len, fine)])
    first = np.diff(line, prepend=-1) > 0
    last = np.roll(first, -1)
    starts = np.flatnonzero(inside & (first | ~np.roll(inside, 1)))
    stops = np.flatnonzero(inside & (last | ~np.roll(inside, -1))) + 1
    for start, stop in zip(starts, stops, strict=True):
        if stop - start < 2:
            continue
        (a, b), piece = chosen[line[start]], seen[start:stop]
        ends = (a if first[start] else -1, b if last[stop - 1] else -1)
        edges.append((node(ends[0], piece[0]), node(ends[1], piece[-1])))
        lines.append(piece)
    for _ in range(int(sight.false * len(edges))):
        middle, angle = rng.uniform(low, high), rng.uniform(0, np.pi)
        reach = 0.02 * width * np.array([np.cos(angle), np.sin(angle)])
        piece = np.clip(np.array([middle - reach, middle, middle + reach]), low + 1, high - 1)
        edges.append((node(-1, piece[0]), node(-1, piece[-1])))
        lines.append(piece)
    return RoadGraph.from_polylines(np.array(nodes).reshape(-1, 2), np.array(edges).reshape(-1, 2), lines)


def scene_of(graph: RoadGraph, size: tuple[int, int] = (1000, 1000), px_per_m: float = 1.0, **changes: object) -> Scene:
    """A scene from a graph in the query plane."""
    metres = IntersectionOptions()
    found = find_intersections(
        graph,
        replace(
            metres,
            tangent_length=metres.tangent_length * px_per_m,
            skip_length=metres.skip_length * px_per_m,
            min_branch_length=metres.min_branch_length * px_per_m,
            max_shift=metres.max_shift * px_per_m,
        ),
    )
    return prepare_scene(graph, found, size, **changes)


def shaken(matrix, scene, size_m, rng):
    """The homography after its frame's corners have moved by some metres."""
    import cv2

    corners = mapped(matrix, scene.corners)
    moved = (corners + rng.normal(0, size_m, (4, 2)) - corners[0]).astype(np.float32)
    return np.array([[1, 0, corners[0, 0]], [0, 1, corners[0, 1]], [0, 0, 1]]) @ cv2.getPerspectiveTransform(
        scene.corners.astype(np.float32), moved
    )


def sight_of(network, seed, tilt=0.0, sight=None, gsd=1.0):
    """(truth, scene) of a camera somewhere over the town."""
    rng = np.random.default_rng(seed)
    center = tuple(rng.uniform(1300, 2700, 2))
    truth = camera(center, (1000, 1000), gsd, tilt, rng.uniform(0, 360), rng.uniform(0, 360))
    return truth, scene_of(look(network, truth, sight=sight, seed=seed), px_per_m=1 / gsd)


def soft(scene, strength=1.0, seed=0):
    """The scene with a picture of probabilities: blurred, noisy, at most about as sure as `strength`."""
    away_m = scene.field * scene.field_scale
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0.0, 1.0, away_m.shape).astype(np.float32), (0, 0), 3)
    odds = strength * (4.0 - 0.5 * away_m + 4.0 * noise)
    probability = np.asarray(1.0 / (1.0 + np.exp(-np.clip(odds, -5.0, 5.0))), np.float32)
    return replace(scene, probability=probability)


def estimator_of(scene, index, options: MatchOptions | None = None, *more, **named) -> TripleEstimator:
    """What searches a part by itself."""
    options = options or MatchOptions()
    return TripleEstimator(SharedSweeps(scene, options.camera), index, options, *more, **named)


def search(estimator, limits: SearchOptions | None = None) -> Search:
    """Search one part alone, within a minute."""
    alone = Search(estimator)
    search_together([alone], limits or SearchOptions(time_limit_s=60.0))
    return alone
