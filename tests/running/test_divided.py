"""A map that is divided among workers: who searches what, and whose place counts."""

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from running.test_cluster import draw
from worlds.fenway import write_vector
from worlds.scenes import PLANE, random_lines

from roadgeo.cli import main
from roadgeo.errors import RoadgeoError
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Location
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import read_query

pytest.importorskip("distributed")
from roadgeo.running import divided
from roadgeo.running.divided import owners
from roadgeo.running.pool import Lost

PARTS = [f"0/{n}" for n in range(300)]


def test_each_part_has_one_owner_and_a_worker_that_goes_leaves_the_others_alone():
    workers = [f"tcp://10.0.0.{k}:4000" for k in range(6)]
    before = owners(PARTS, workers)
    assert sorted(part for share in before.values() for part in share) == sorted(PARTS)
    assert all(25 <= len(share) <= 80 for share in before.values())
    after = owners(PARTS, workers[1:])
    for worker in workers[1:]:
        assert set(before[worker]) <= set(after[worker])
    assert owners(["0/"], workers[:1]) == {workers[0]: ["0/"]}


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A folder with the shards of a town, one more map, and masks of both, of another town, and of nothing."""
    folder = tmp_path_factory.mktemp("divided")
    lines = {"town": random_lines(5, 3000.0), "hamlet": random_lines(8, 3000.0), "stranger": random_lines(6, 3000.0)}
    for name in ("town", "hamlet"):
        shifted = [shapely.transform(line, PLANE.to_crs) for line in lines[name]]
        write_vector(folder / f"{name}.gpkg", shifted, crs=PLANE.crs)
        shards = ["--shards", "2km", "--margin", "700"] if name == "town" else []
        out = folder / ("town.shards" if shards else "hamlet_map.gpkg")
        asked = ["index", "--roads", str(folder / f"{name}.gpkg"), *shards, "--name", name, "-q", "--out", str(out)]
        assert main(asked) == 0
    for mask, name, corner in (
        ("a", "town", 900.0),
        ("b", "town", 300.0),
        ("c", "hamlet", 600.0),
        ("d", "stranger", 0.0),
    ):
        draw(str(folder / f"{mask}.png"), lines[name], corner)
    (folder / "e.png").write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    return folder


def test_a_divided_map_answers_as_the_whole_does(town, monkeypatch, capsys):
    monkeypatch.chdir(town)
    asked = [
        "locate",
        *(f"{mask}.png" for mask in "abcde"),
        "-r",
        "town.shards",
        "-r",
        "hamlet_map.gpkg",
        "--json",
        "-q",
    ]
    found = {}
    divided = ["--engine", "dask", "--jobs", "3", "--divide-map"]
    for out, more in (("whole", []), ("divided", divided), ("divided", [*divided, "--skip-existing"])):
        assert main([*asked, "-o", out, "--effort", "quick", *more]) == 1
        found[out] = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        for item, other in zip(found["whole"], found[out], strict=True):
            same = ("query", "status", "reference", "attribution", "reference_digest", "reason_code", "crs", "options")
            assert [item[key] for key in same] == [other[key] for key in same]
            if item["center"]:
                assert np.allclose(item["footprint"], other["footprint"], atol=1e-6)
                assert other["log10_odds"] == pytest.approx(item["log10_odds"], abs=1.5)
    values = [(result["status"], result["reference"]) for result in found["divided"]]
    assert values[:3] == [("located", "town"), ("located", "town"), ("located", "hamlet")]
    assert [status for status, _ in values[3:]] == ["not_located", "error"]
    assert sorted(path.name for path in (town / "whole").iterdir()) == sorted(
        path.name for path in (town / "divided").iterdir()
    )


def test_a_place_counts_only_against_all_of_the_map(town, monkeypatch, capsys):
    """Where two maps hold a place, neither worker may report it alone."""
    monkeypatch.chdir(town)
    east = np.array([50_000.0, 0.0])
    twins = [shapely.transform(line, lambda xy: PLANE.to_crs(xy) + east) for line in random_lines(8, 3000.0)]
    write_vector(town / "twin.gpkg", twins, crs=PLANE.crs)
    assert main(["index", "--roads", "twin.gpkg", "--name", "twin", "-q", "--out", "twin_map.gpkg"]) == 0
    asked = ["locate", "c.png", "-r", "hamlet_map.gpkg", "-r", "twin_map.gpkg", "--json", "-q", "--effort", "quick"]
    for out, more in (("one", []), ("two", ["--engine", "dask", "--jobs", "2", "--divide-map"])):
        main([*asked, "-o", out, *more])
        assert json.loads(capsys.readouterr().out)["status"] == "ambiguous"


def test_a_false_hint_is_named_where_the_map_is_divided(town, monkeypatch, capsys):
    monkeypatch.chdir(town)
    lon, lat = to_lonlat(PLANE.crs, PLANE.to_crs(np.array([[2600.0, 2600.0]])))[0].tolist()
    asked = ["locate", "c.png", "-r", "hamlet_map.gpkg", "--near", f"{lon},{lat},300", "--json", "-q"]
    for out, more in (("alone", []), ("among", ["--engine", "dask", "--jobs", "2", "--divide-map"])):
        main([*asked, "-o", out, *more])
        assert json.loads(capsys.readouterr().out)["reason_code"] == "fits_elsewhere"


def test_of_a_map_that_lacks_a_part_nothing_is_said(town, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(town / "town.shards", "town.shards")
    for path in sorted(Path("town.shards").glob("*/*.*"))[:2]:
        path.write_bytes(b"nothing")
    asked = ["locate", str(town / "b.png"), "-r", "town.shards", "--json", "-q", "--effort", "quick"]
    assert main([*asked, "--engine", "dask", "--jobs", "2", "--divide-map"]) == 1
    output = json.loads(capsys.readouterr().out)
    assert (output["status"], output["reason_code"]) == ("error", "no_reference")


@pytest.mark.parametrize("more", [[], ["--engine", "dask", "--method", "pair"], ["--engine", "dask", "--explain"]])
def test_it_needs_a_cluster_and_the_usual_search(more, capsys):
    assert main(["locate", __file__, "--divide-map", *more]) == 2
    assert "--divide-map goes with --engine dask" in capsys.readouterr().err


class Slow:
    """Stands for a pool whose only worker is busy with other masks for a while before each task."""

    def __init__(self):
        self.limits = []

    def run(self, tasks):
        for asked in tasks:
            time.sleep(0.3)
            self.limits.append(asked.options.search.time_limit_s)
            yield divided._PartAnswer(Location("q", "not_located", "nothing"), [])

    def names(self):
        return ["tcp://one"]


def locate_on(pool, time_limit_s):
    options = LocateOptions()
    options = replace(options, search=replace(options.search, time_limit_s=time_limit_s))
    mask = np.zeros((64, 64), bool)
    mask[30:34] = mask[:, 30:34] = True
    traced_s = read_query(RoadMask(mask)).seconds.vectorize
    found = divided._locate(pool, {"0/": 100}, RoadMask(mask), [SimpleNamespace(name="")], options)
    return found, traced_s


def test_waiting_for_a_worker_is_no_time_of_the_search():
    pool = Slow()
    found, traced_s = locate_on(pool, 0.5)
    assert found.status == "not_located"
    assert len(pool.limits) == 2
    assert pool.limits[0] > 0.5 - 2.0 * traced_s - 0.1
    assert pool.limits[1] == pool.limits[0]


def test_without_a_part_of_the_map_there_is_no_answer():
    lost = Lost("died", "the workers died")
    pool = Slow()
    pool.run = lambda tasks: (divided._Map(()).give_up(task, lost) for task in tasks)
    with pytest.raises(RoadgeoError, match="a part of the map has no answer: the workers died"):
        locate_on(pool, 0.5)
