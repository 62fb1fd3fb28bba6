"""Equations of road points against a slow twin: derivatives by differences, weights by their formula."""

import numpy as np
from worlds.scenes import random_network

from roadgeo.kernels.road_equations import road_equations
from roadgeo.kernels.roads import nearest_road
from roadgeo.matching.index import build_index
from roadgeo.matching.scene import sample_roads

UNIT, ORIGIN, MIN_COS = 300.0, np.array([700.0, 700.0]), np.cos(np.radians(25))


def place(p, uv):
    q = np.append(uv, 1.0) @ np.append(p, 1.0).reshape(3, 3).T
    return ORIGIN + UNIT * q[:2] / q[2]


def twin(p, points, directions, radius, sigma, roads):
    normal, right, met = np.zeros((8, 8)), np.zeros(8), 0
    for uv, along in zip(points, directions, strict=True):
        x, y = place(p, uv)
        ahead = place(p, uv + 1e-6 * along) - (x, y)
        dx, dy = ahead / np.hypot(*ahead)
        d, fx, fy, rx, ry = nearest_road(x, y, dx, dy, radius, MIN_COS, *roads)
        if d == np.inf:
            continue
        met += 1
        across = np.array([-ry, rx])
        row = np.array([across @ (place(p + 1e-6 * e, uv) - (x, y)) / 1e-6 / UNIT for e in np.eye(8)])
        away = across @ (fx - x, fy - y)
        weight = 1.0 / (1.0 + (away / sigma) ** 2)
        normal += weight * np.outer(row, row)
        right += weight * row * away / UNIT
    return met, normal, right


def test_it_is_the_sum_over_points_that_meet_roads():
    network = random_network(3, 1400.0)
    index = build_index(network)
    roads = index.road_buckets
    points, directions = sample_roads(network.graph, 60.0)
    uv = (points - ORIGIN) / UNIT
    near = np.hypot(*uv.T) < 1.0
    uv, along = np.ascontiguousarray(uv[near]), np.ascontiguousarray(directions[near])
    p = np.array([1.01, 0.02, 0.01, -0.02, 0.99, -0.015, 0.02, -0.01])
    normal, right = np.zeros((8, 8)), np.zeros(8)
    met = road_equations(p, UNIT, ORIGIN, uv, along, 12.0, 4.0, MIN_COS, roads, normal, right)
    expected = twin(p, uv, along, 12.0, 4.0, roads)
    assert met == expected[0] > 20
    assert np.allclose(normal, expected[1], rtol=1e-3, atol=1e-3)
    assert np.allclose(right, expected[2], rtol=1e-3, atol=1e-4)


def test_beyond_the_horizon_nothing_is_met():
    network = random_network(3, 1400.0)
    index = build_index(network)
    roads = index.road_buckets
    p = np.array([1.0, 0, 0, 0, 1.0, 0, -2.0, 0])
    normal, right = np.zeros((8, 8)), np.zeros(8)
    points, along = np.array([[0.9, 0.0]]), np.array([[1.0, 0.0]])
    assert road_equations(p, UNIT, ORIGIN, points, along, 50.0, 4.0, MIN_COS, roads, normal, right) == 0
    assert not normal.any()
