"""A road source, a segmenter and an output for roadgeo: well-known text, and the yellow roads of printed maps."""

from pathlib import Path

import cv2
import shapely

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


def write_wkt(path, subject):
    """The footprint as a POLYGON in the reference's CRS."""
    path.write_text(f"{shapely.Polygon(subject.place.footprint).wkt}\n")


WKT = Output("wkt", "_footprint.wkt", write_wkt, "footprint as well-known text")
