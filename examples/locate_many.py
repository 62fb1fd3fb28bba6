"""Locate masks made by a program of your own, knowing something of the camera, and write what a GIS opens."""

import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import geopandas as gpd

import roadgeo
from roadgeo.evaluation.demo import ROADS, demo_masks
from roadgeo.geometry.mask import RoadMask
from roadgeo.outputs.location_files import write_location
from roadgeo.outputs.paths import output_paths
from roadgeo.workflows import LocateOptions

reference = roadgeo.index(gpd.read_file(ROADS), name="porto")
folder = Path(tempfile.mkdtemp())

# Options are small frozen dataclasses, one per stage, nested: replace those that you know. Each makes the search surer.
options = LocateOptions()
camera = replace(options.match.camera, gsd_m=(0.5, 3.0), max_tilt_deg=40.0)
options = replace(options, match=replace(options.match, camera=camera))

for demo in demo_masks():
    probability = cv2.imread(str(demo.path), cv2.IMREAD_GRAYSCALE) / 255  # stands for your segmenter
    mask = RoadMask(probability > 0.5, name=demo.path.name)
    location = roadgeo.locate(mask, reference, options)
    if location.located:
        write_location(location, mask, output_paths(folder, demo.path.stem))
    print(f"{mask.name}: {location.status}, {location.reason}")
print(f"{len(list(folder.glob('*.tif')))} footprints in {folder}")
