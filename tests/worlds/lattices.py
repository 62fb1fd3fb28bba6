"""A lattice of equal blocks, some not parted by a street, and a view of it."""

import numpy as np
import shapely

from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane
from roadgeo.matching.evidence import Evidence
from roadgeo.matching.index import build_index
from roadgeo.matching.shifts import Shift, move_about
from roadgeo.roads.network import build_network
from worlds.scenes import Sight, camera, look, scene_of

BLOCK = (110, 90)
SIZE = (700, 500)


def lattice(kept: float):
    """Equal blocks over 3.3 by 3.2 km, of which some are not parted by a street."""
    rng, (width, height) = np.random.default_rng(5), BLOCK
    lines = [
        shapely.LineString([a, b])
        for x in range(0, 30 * width, width)
        for y in range(0, 35 * height, height)
        for a, b in (((x, y), (x + width, y)), ((x, y), (x, y + height)))
        if rng.random() < kept
    ]
    network = build_network(lines, LocalPlane("EPSG:32619", (330000.0, 4690000.0)), {"name": "lattice"})
    return network, build_index(network)


def contest(kept: float, size: tuple[int, int] = SIZE):
    """Return the true place of a view, the map, and what weighs places of it."""
    network, index = lattice(kept)
    low, high = network.graph.xy.min(axis=0), network.graph.xy.max(axis=0)
    truth = camera(tuple(((low + high) / 2).tolist()), size, 1.0, heading_deg=15.0)
    scene = scene_of(look(network, truth, size, Sight(sigma_m=1.0, missing=0.15, false=0.05), 2), size)
    return truth, index, Evidence(scene, index, 1.0)


def beside(truth, among):
    shift = Shift(float(BLOCK[0]), 0.0, 0.0, 1.0, 0.0)
    return move_about(Homography(truth)(among.scene.center), shift) @ truth
