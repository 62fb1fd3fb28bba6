"""Open a map, locate a mask on it, use the result. Run it anywhere: python examples/locate_a_mask.py"""

import tempfile
from pathlib import Path

import geopandas as gpd
import numpy as np

import roadgeo
from roadgeo.evaluation.demo import ROADS, demo_masks

# Roads of any kind and CRS, as a GeoDataFrame of lines; here a piece of Porto that ships with roadgeo.
reference = roadgeo.index(gpd.read_file(ROADS), name="porto")

# A reference is built once and kept; opening it takes milliseconds, whatever its size.
path = Path(tempfile.mkdtemp()) / "porto.gpkg"
reference.save(path)
reference = roadgeo.open_reference(path)

# A mask is a path or a numpy array. Nothing is written.
mask = demo_masks()[1].path
location = roadgeo.locate(mask, reference)
print(f"{location.status}: {location.reason}")

# The homography takes pixels (column, row; the centre of the first pixel is 0.5, 0.5) to the map.
x, y, w = location.homography @ (640.0, 480.0, 1.0)
print(f"the image's middle lies at {x / w:.1f}, {y / w:.1f} in {location.crs}")
print(f"its corners are known to {location.corner_sigma_m.max():.1f} m:")
print(np.round(location.footprint_lonlat, 5).tolist())
