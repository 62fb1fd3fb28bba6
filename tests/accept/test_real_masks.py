"""Masks of real cities that some engine got wrong, or must get right; `cases.json` says why each is kept.

`tests/support/draw_accept.py` draws them anew. What has no place must be refused or ambiguous, never located.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from worlds.drawn import mapped

import roadgeo

DATA = Path(__file__).parents[1] / "data" / "accept"
CASES = json.loads((DATA / "cases.json").read_text(encoding="utf-8"))


@cache
def reference_of(city):
    return roadgeo.index(DATA / f"{city}.parquet")


def locate(case):
    options = roadgeo.LocateOptions(effort=case["effort"])
    return roadgeo.locate(DATA / "masks" / case["mask"], reference_of(case["city"]), options)


def cases(has_place):
    chosen = [case for case in CASES if (case["homography"] is not None) == has_place]
    return [pytest.param(case, id=case["mask"].removesuffix(".png")) for case in chosen]


@pytest.mark.parametrize("case", cases(has_place=False))
def test_what_has_no_place_is_refused(case):
    found = locate(case)
    assert found.status in {"not_located", "ambiguous"}, f"{case['why']}; {found.reason}"


@pytest.mark.parametrize("case", cases(has_place=True))
def test_what_has_a_place_is_located(case):
    """Within 20 m at the middle, as everywhere in the project; corners of tilted views lie farther off."""
    from pyproj import Transformer

    found = locate(case)
    assert found.status == "located", f"{case['why']}; {found.reason}"
    width, height = found.size
    points = np.array([[width / 2, height / 2], [0, 0], [width, 0], [width, height], [0, height]], float)
    there = mapped(np.array(found.homography), points)
    there = np.column_stack(Transformer.from_crs(found.crs, crs_of(case["city"]), always_xy=True).transform(*there.T))
    off = np.hypot(*(there - mapped(np.array(case["homography"]), points)).T)
    assert off[0] < 20.0
    assert off[1:].max() < 60.0


@cache
def crs_of(city):
    import geopandas as gpd

    return gpd.read_parquet(DATA / f"{city}.parquet").crs
