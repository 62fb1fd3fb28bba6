"""Real photographs from elsewhere than the network learnt: who tells more gets no less, and nothing is wrong."""

import csv
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest

import roadgeo
from roadgeo.geometry.projection import metres_apart
from roadgeo.location import Location
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import Reference
from roadgeo.running.options import ReadOptions
from roadgeo.running.queries import locate_query

#: Searched blind, and again as told.
TOLD = {"boston_2": "scale and heading", "miami_26": "scale"}


def map_of(row: dict[str, str], data_dir: Path) -> Reference:
    """The map of the roads around a photograph."""
    middle, half = np.array([float(row["lon"]), float(row["lat"])]), np.array([0.04, 0.03])
    return roadgeo.index(gpd.read_file(data_dir / row["roads"], bbox=(*(middle - half), *(middle + half))))


def hinted(row: dict[str, str], what: str) -> LocateOptions:
    """What is told of a photograph. No clock: a busy machine changes nothing."""
    options, gsd = LocateOptions(), float(row["gsd_m"])
    camera = options.match.camera
    if what != "nothing":
        camera = replace(camera, gsd_m=(0.93 * gsd, 1.07 * gsd))
    if what == "scale and heading":
        camera = replace(camera, heading_deg=(float(row["heading_deg"]), 5.0))
    search = replace(options.search, time_limit_s=3600.0)
    return replace(options, match=replace(options.match, camera=camera), search=search)


def is_right(location: Location, row: dict[str, str]) -> bool:
    assert location.center is not None
    truth = np.array([float(row["lon"]), float(row["lat"])])
    off_m = metres_apart(truth, np.array([location.center.lon, location.center.lat]))
    return off_m < max(15.0, 3.0 * float(row["gsd_m"]))


#: A further look takes up to log10(5) off the odds: what is located blind by no more than that may be refused.
SURE = 3.5 + np.log10(5.0)


@pytest.mark.parametrize("name", TOLD)
def test_told_is_no_worse_than_blind(name: str, data_dir: Path) -> None:
    with (data_dir / "photographs" / "truth.csv").open() as truth:
        row = next(row for row in csv.DictReader(truth) if Path(row["file"]).stem == name)
    path, reference = str(data_dir / "photographs" / row["file"]), map_of(row, data_dir)
    blind, told = (
        locate_query(path, [reference], hinted(row, what), ReadOptions()).location for what in ("nothing", TOLD[name])
    )
    assert blind.located
    assert is_right(blind, row)
    assert told.located or (blind.log10_odds or 0.0) < SURE
    assert not told.located or is_right(told, row)
