"""A road source, a segmenter and an output for roadgeo: well-known text, yellow roads of printed maps, OGC GeoPose."""

import json
from pathlib import Path

import cv2
import shapely
from scipy.spatial.transform import Rotation

from roadgeo.outputs.registry import Output
from roadgeo.sources.roads import choose_roads


def read_wkt(where, say=print):
    """Roads from a text file: on each line one LINESTRING in degrees."""
    say(f"reading {where}")
    return choose_roads(shapely.from_wkt(Path(where).read_text().splitlines()), crs="EPSG:4326")


def find_yellow(picture):
    """The roads of a map sheet that draws them in yellow: an array that is above 0 where there is road."""
    hsv = cv2.cvtColor(cv2.imread(str(picture)), cv2.COLOR_BGR2HSV)
    return cv2.inRange(hsv, (20, 90, 90), (35, 255, 255))


def write_geopose(path, subject):
    """The camera's position and axes (x right, y to the image's top, z backwards) to east, north, up: OGC 21-056r11."""
    camera = subject.location.camera
    turn = dict(zip("xyzw", Rotation.from_matrix(camera.rotation).as_quat().tolist(), strict=True))
    position = {"lat": camera.lat, "lon": camera.lon, "h": camera.height_m}
    path.write_text(json.dumps({"position": position, "quaternion": turn}))


GEOPOSE = Output("geopose", "_geopose.json", write_geopose, "the camera, as OGC GeoPose", needs_camera=True)
