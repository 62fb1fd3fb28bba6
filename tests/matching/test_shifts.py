"""Places that shifts of a start lead to."""

import numpy as np
from worlds.lattices import BLOCK, contest

from roadgeo.matching import shifts
from roadgeo.matching.shifts import LocalSearchOptions, search_nearby


def test_of_shifts_that_agree_equally_the_nearest_come_first(monkeypatch):
    """Where all blocks are equal, those beside are, and not those of one end of the map."""
    truth, index, among = contest(1.0)
    monkeypatch.setattr(shifts, "_ROAD_M", 30.0)
    options = LocalSearchOptions(reach_m=400.0, turn_deg=0.0, n_places=6)
    found = search_nearby(truth, among.scene, index, options)
    away = [np.hypot(result.east_m, result.north_m) for result in found]
    alike = [length for length, result in zip(away, found, strict=True) if result.share == found[0].share]
    assert len(alike) > 3
    assert alike == sorted(alike)
    assert alike[1] < 2.0 * max(BLOCK)
