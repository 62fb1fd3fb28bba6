"""Put the real photograph of the demonstration, and the streets around it, into the demonstration's data.

    python examples/demo/add_berkeley.py berkeley_naip.png berkeley_city_streets.gpkg

The photograph is NAIP, 1,361 x 827 pixels of 0.943 m, north up; the streets are the City of Berkeley's centre lines.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np

import roadgeo.evaluation.demo
from roadgeo.storage.geopackage import FeatureTable, write_layers

__all__ = ["add_berkeley"]


def add_berkeley(photo: str, streets: str, folder: Path) -> None:
    """Write `berkeley_photo.jpg` and `berkeley_streets.gpkg` into a folder."""
    picture = cv2.imread(photo, cv2.IMREAD_COLOR)
    assert picture is not None, photo
    cv2.imwrite(str(folder / "berkeley_photo.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    roads = gpd.read_file(streets).explode()
    # The lines have a vertex for each 2.5 m; a few are enough to draw them to 0.2 m.
    lines = [np.round(line.coords, 1) for line in roads.geometry.simplify(0.2)]
    columns = {"name": roads["FULLNAME"].tolist()}
    write_layers(
        folder / "berkeley_streets.gpkg", [FeatureTable("streets", "LINESTRING", lines, columns, "EPSG:32610")]
    )


if __name__ == "__main__":
    add_berkeley(sys.argv[1], sys.argv[2], Path(roadgeo.evaluation.demo.__file__).parent / "data")
