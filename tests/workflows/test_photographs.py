"""Real photographs from elsewhere than the network learnt: who tells more gets no less, and nothing is wrong."""

import csv
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import roadgeo
from roadgeo.geometry.projection import metres_apart
from roadgeo.location import Location
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import Reference
from roadgeo.running.options import ReadOptions
from roadgeo.running.queries import locate_query

FEW = ("boston_2", "miami_26")


@pytest.fixture(scope="module")
def rows(data_dir: Path) -> list[dict[str, str]]:
    """Photographs that lie on a map: two of them, for each is searched three times."""
    with (data_dir / "photographs" / "truth.csv").open() as truth:
        return [row for row in csv.DictReader(truth) if Path(row["file"]).stem in FEW]


@pytest.fixture(scope="module")
def maps(data_dir: Path, rows: list[dict[str, str]], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reference]:
    folder = tmp_path_factory.mktemp("maps")
    files = dict.fromkeys(row["roads"] for row in rows)
    return {file: roadgeo.index(data_dir / file, path=folder / f"{Path(file).stem}.gpkg") for file in files}


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


def test_told_is_no_worse_than_blind(data_dir: Path, rows: list[dict[str, str]], maps: dict[str, Reference]) -> None:
    found: dict[str, dict[str, float]] = {"nothing": {}, "scale": {}, "scale and heading": {}}
    for what in found:
        for row in rows:
            path, query = str(data_dir / "photographs" / row["file"]), ReadOptions()
            location = locate_query(path, [maps[row["roads"]]], hinted(row, what), query).location
            if location.located:
                assert is_right(location, row), (what, row["file"])
                found[what][row["file"]] = location.log10_odds or 0.0
    for less, more in pairwise(found.values()):
        assert {name for name, odds in less.items() if odds >= SURE} <= more.keys()
    assert len(found["nothing"]) == len(FEW)
