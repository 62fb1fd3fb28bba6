import numpy as np
import pytest
import shapely
from scipy.spatial import KDTree

from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.network import RoadNetwork
from roadgeo.roads.simplification import planarize, simplify
from roadgeo.roads.updating import ground_of, move_lines, replace_area, replace_roads

PLANE = LocalPlane("EPSG:32619", (330000.0, 4690000.0))


def streets(columns: range, rows: range, step: float = 150.0, shift: float = 0.0) -> np.ndarray:
    """Lines of a grid whose corners are moved, the same for the same corner."""

    def corner(c: int, r: int) -> np.ndarray:
        rng = np.random.default_rng([c + 100, r + 100])
        return np.array([c, r]) * step + rng.uniform(-25, 25, 2) + shift

    lines = [[corner(c, r) for c in columns] for r in rows] + [[corner(c, r) for r in rows] for c in columns]
    return np.array([shapely.LineString(line) for line in lines], object)


def draw(lines: np.ndarray) -> RoadNetwork:
    graph = simplify(planarize(lines))
    return RoadNetwork(graph, find_intersections(graph), PLANE, (), {"name": "grid"})


def apart(a: RoadNetwork, b: RoadNetwork) -> float:
    """Largest distance from an intersection of one to the nearest of the other."""
    a_xy, b_xy = a.intersections.xy, b.intersections.xy
    return max(KDTree(a_xy).query(b_xy)[0].max(), KDTree(b_xy).query(a_xy)[0].max())


CITY = streets(range(-12, 13), range(-12, 13))


@pytest.mark.parametrize(
    "area",
    [
        shapely.box(-310, -420, 505, 333),
        shapely.Point(100, 50).buffer(500),
        shapely.MultiPolygon([shapely.box(-900, -900, -600, -600), shapely.box(0, 0, 300, 300)]),
        shapely.Point(0, 0).buffer(400).difference(shapely.Point(0, 0).buffer(200)),
    ],
)
def test_the_same_roads_give_the_same_network(area: shapely.Geometry) -> None:
    old = draw(CITY)
    new = replace_area(old, CITY, area, meta={"name": "new"})
    assert len(new.intersections) == len(old.intersections)
    assert apart(old, new) < 0.2  # the grid on which lines are noded
    assert new.graph.edge_lengths().sum() == pytest.approx(old.graph.edge_lengths().sum(), abs=10)
    assert (new.graph.n_nodes, new.graph.n_edges) == (old.graph.n_nodes, old.graph.n_edges)
    assert (new.meta, new.plane) == ({"name": "new"}, PLANE)


def test_what_is_far_stays() -> None:
    old, area = draw(CITY), shapely.box(-300, -300, 300, 300)
    new = replace_area(old, streets(range(-3, 4), range(-3, 4), shift=40), area)
    far = np.abs(old.intersections.xy).max(axis=1) > 600
    distance, _ = KDTree(new.intersections.xy).query(old.intersections.xy[far])
    assert distance.max() < 1e-9
    near = np.abs(old.intersections.xy).max(axis=1) < 200
    distance, _ = KDTree(new.intersections.xy).query(old.intersections.xy[near])
    assert distance.min() > 10


def test_roads_drawn_a_little_elsewhere_are_joined_at_the_border() -> None:
    old, area = draw(CITY), shapely.box(-375, -375, 375, 375)
    new = replace_area(old, streets(range(-12, 13), range(-12, 13), shift=6), area)
    assert (new.graph.degree() == 1).sum() == (old.graph.degree() == 1).sum()
    assert len(new.intersections) == len(old.intersections)


def test_an_area_is_emptied_and_filled_again() -> None:
    old, area = draw(CITY), shapely.box(-460, -460, 460, 460)
    bare = replace_area(old, [], area)
    assert not shapely.contains_xy(area, *bare.intersections.xy.T).any()
    assert len(bare.intersections) < len(old.intersections) - 30
    full = replace_area(bare, CITY, area)
    assert apart(old, full) < 0.2


def test_a_town_is_added() -> None:
    old, town = draw(CITY), streets(range(40, 46), range(40, 46))
    new = replace_area(old, town, ground_of(town))
    assert len(new.intersections) == len(old.intersections) + len(draw(town).intersections)
    assert len(new.coverage) == 2


def test_a_network_begins_with_nothing() -> None:
    nothing = RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2), np.int32), [])
    graph = replace_roads(nothing, CITY, shapely.box(-2000, -2000, 2000, 2000))
    assert graph.n_edges == simplify(planarize(CITY)).n_edges
    assert replace_roads(nothing, [], shapely.box(0, 0, 1, 1)).n_edges == 0


def test_ground_hugs_the_roads() -> None:
    ground = ground_of(CITY)
    assert all(ground.contains(line) for line in CITY)
    hull = shapely.convex_hull(shapely.multilinestrings(CITY))
    assert ground.difference(hull.buffer(12)).is_empty
    assert ground.area > 0.97 * hull.area
    assert len(shapely.get_parts(ground_of(np.concatenate((CITY, streets(range(40, 46), range(40, 46))))))) == 2


def test_lines_are_moved_to_another_plane() -> None:
    other = LocalPlane("EPSG:26986", (236000.0, 900000.0))
    there = move_lines(CITY[:2], PLANE, other)
    back = move_lines(there, other, PLANE)
    assert not there[0].equals_exact(CITY[0], 100)
    assert all(a.equals_exact(b, 1e-3) for a, b in zip(CITY[:2], back, strict=True))
    assert move_lines(CITY, PLANE, PLANE)[0] is CITY[0]
