"""Frames stitched on one plane."""

from itertools import pairwise

import numpy as np

from roadgeo.flights.mosaic import ROAD_PX, chain, level, stitch
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PROBABILITY_UNKNOWN, RoadMask
from roadgeo.geometry.pinhole import make_view

FRAME = Frame(320, 240)


def flight(tilt_deg, n=8):
    views = [make_view((0.0, 96.0 * k), (320, 240), 1.0, tilt_deg, 0.0, 0.0) for k in range(n)]
    motion = [np.eye(3)] + [(a.homography.inverse() @ b.homography).matrix for a, b in pairwise(views)]
    return views, motion


def test_chained_motion_leads_to_the_first_frame():
    views, motion = flight(10.0)
    matrix = Homography(chain(motion)[-1]).facing(FRAME.center)
    assert np.allclose(matrix(FRAME.center), (views[0].homography.inverse() @ views[-1].homography)(FRAME.center))


def test_a_flight_towards_the_horizon_of_its_first_frame_is_levelled():
    """Tilted by 25 degrees, the first frame's plane ends before the flight does; on the levelled one all is alike."""
    views, motion = flight(25.0, 14)
    first = Homography(chain(motion)[-1]).facing(FRAME.center)(FRAME.corners)
    assert not np.isfinite(first).all() or np.ptp(first[:, 0]) < 200
    corners = np.array([Homography(matrix)(FRAME.corners) for matrix in level(np.array(chain(motion)), FRAME)])
    truth = np.array([view.footprint for view in views])
    sizes = np.ptp(corners, axis=1) / np.ptp(truth, axis=1)
    assert np.allclose(sizes / sizes[0], 1.0, atol=0.1)


def test_roads_that_one_frame_misses_are_taken_from_others():
    _, motion = flight(0.0, 4)
    roads = np.zeros((240, 320), bool)
    roads[:, 150:170] = True
    broken = roads.copy()
    broken[100:200] = False
    masks = [RoadMask(item) for item in (roads, broken, roads, roads)]
    mosaic = stitch(masks, motion, ROAD_PX)
    assert mosaic is not None
    for k, matrix in enumerate(mosaic.to_mosaic):
        column, row = np.floor(Homography(matrix)(np.array([160.5, 120.5]))).astype(int)
        assert mosaic.mask.roads[row, column], k
    assert mosaic.mask.observed is not None
    assert not (mosaic.mask.roads & ~mosaic.mask.observed).any()


def test_motion_of_no_camera_is_refused():
    masks = [RoadMask(np.ones((240, 320), bool))] * 2
    assert stitch(masks, [np.eye(3), np.diag([-1.0, 1.0, 1.0])], 5.0) is None


def test_a_mosaic_is_as_sure_as_its_frames():
    _, motion = flight(0.0, 4)
    roads = np.zeros((240, 320), bool)
    roads[:, 150:170] = True
    frames = [RoadMask(roads, probability=np.where(roads, sure, 30).astype(np.uint8)) for sure in (200, 100, 200, 100)]
    mosaic = stitch(frames, motion, ROAD_PX)
    assert mosaic is not None
    assert mosaic.mask.probability is not None
    assert mosaic.mask.observed is not None
    column, row = np.floor(Homography(mosaic.to_mosaic[1])(np.array([160.5, 120.5]))).astype(int)
    assert 130 <= mosaic.mask.probability[row, column] <= 170
    assert (mosaic.mask.probability[~mosaic.mask.observed] == PROBABILITY_UNKNOWN).all()
    assert stitch([RoadMask(roads)] * 4, motion, 20.0).mask.probability is None
