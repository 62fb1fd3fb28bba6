"""Tasks on a real scheduler with worker processes, some of which are killed."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from support.cluster_work import Maps, Squares
from worlds.fenway import write_vector
from worlds.scenes import PLANE, random_lines

from roadgeo.cli import main
from roadgeo.errors import RoadgeoError
from roadgeo.reference.shards import open_shards

pytest.importorskip("distributed")
from roadgeo.running import pool
from roadgeo.running.cluster import Cluster

TESTS = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address of a scheduler with two workers, each a process that is started again when it dies."""
    folder = tmp_path_factory.mktemp("dask")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")]),
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
        "DASK_DISTRIBUTED__ADMIN__LOW_LEVEL_LOG_LENGTH": "0",
    }
    reported, processes = folder / "scheduler.json", []

    def start(*arguments):
        with (folder / "log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", *arguments],
                env=environment,
                cwd=folder,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        processes.append(process)

    start("distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(reported))
    workers = ("--nthreads", "1", "--nworkers", "2", "--no-dashboard", "--memory-limit", "0")
    start("distributed.cli.dask_worker", "--scheduler-file", str(reported), *workers)
    try:
        deadline = time.monotonic() + 60
        while not reported.exists() or not reported.read_text():
            assert time.monotonic() < deadline, (folder / "log").read_text()
            time.sleep(0.1)
        yield json.loads(reported.read_text())["address"]
    finally:
        for process in reversed(processes):
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            with contextlib.suppress(ProcessLookupError):  # nobody of those that it started is left
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def draw(name, lines, corner, size=1000):
    """Draw what lies in a square of the plane as a mask of 1 m pixels."""
    mask = np.zeros((size, size), np.uint8)
    for line in lines:
        xy = np.array(line.coords) - corner
        cv2.polylines(mask, [np.round(xy * (1, -1) + (0, size)).astype(np.int32)], False, 255, 9)
    cv2.imwrite(name, mask)
    return name


def counts(folder):
    """How often each number was worked on."""
    return {int(path.stem): path.read_text().count("\n") for path in Path(folder).glob("*.txt")}


def test_results_come_in_order_and_each_task_is_done_once(scheduler, tmp_path):
    found = list(Cluster(scheduler).run(range(60), Squares(str(tmp_path))))
    assert found == [n * n for n in range(60)]
    assert set(counts(tmp_path).values()) == {1}


def test_no_more_is_begun_than_may_wait_to_be_read(scheduler, tmp_path):
    results = Cluster(scheduler).run(range(200), Squares(str(tmp_path)))
    assert next(results) == 0
    time.sleep(0.5)
    assert len(counts(tmp_path)) <= 2 * pool._UNREAD
    results.close()


def test_killed_workers_lose_nothing_and_what_kills_them_all_is_given_up(scheduler, tmp_path):
    work = Squares(str(tmp_path), once=(3,), always=17)
    found = list(Cluster(scheduler).run(range(20), work))
    assert [result for n, result in enumerate(found) if n != 17] == [n * n for n in range(20) if n != 17]
    assert found[17].startswith("17: the workers that it was given to died")
    assert len(found) == 20


def test_a_worker_lets_go_of_an_earlier_runs_maps_before_it_opens_others(scheduler):
    assert [list(Cluster(scheduler).run(range(8), Maps())) for _ in range(2)] == [[0] * 8] * 2


def test_shards_and_masks_come_out_as_from_one_process(scheduler, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines, strangers = random_lines(5, 3000.0), random_lines(6, 3000.0)
    write_vector(tmp_path / "town.gpkg", [shapely.transform(line, PLANE.to_crs) for line in lines], crs=PLANE.crs)
    built = {}
    for name, where in (("here", []), ("there", ["--scheduler", scheduler])):
        asked = ["index", "--roads", "town.gpkg", "--shards", "2km", "--margin", "700", "--name", "town", "-q"]
        assert main([*asked, "--out", f"{name}.shards", *where]) == 0
        built[name] = [entry.digest for entry in open_shards(tmp_path / f"{name}.shards/manifest.json").manifest.shards]
    assert built["here"] == built["there"]
    masks = [draw(f"{name}.png", town, 900.0) for name, town in (("seen", lines), ("stranger", strangers))]
    capsys.readouterr()
    found = []
    for where in ([], ["--scheduler", scheduler]):
        main(["locate", *masks, "-r", "here.shards", "--json", "-q", "-o", "out", "--effort", "quick", *where])
        found.append([json.loads(line) for line in capsys.readouterr().out.splitlines()])
    assert [result["status"] for result in found[0]] == ["located", "not_located"]
    for item, other in zip(*found, strict=True):
        assert {key: value for key, value in item.items() if key != "seconds"} == {
            key: value for key, value in other.items() if key != "seconds"
        }


def test_without_a_scheduler_processes_of_this_machine_do_it(scheduler, tmp_path):
    """Also beside another cluster, which serves its status where Dask does."""
    assert list(Cluster(workers=2).run(range(8), Squares(str(tmp_path)))) == [n * n for n in range(8)]
    assert set(counts(tmp_path).values()) == {1}


def test_workers_that_all_went_away_are_said_and_an_error_of_a_task_is_its_own(tmp_path, monkeypatch):
    from roadgeo.running import cluster

    with Cluster().connected(Squares(str(tmp_path / "nonesuch"))) as workers:
        with pytest.raises(FileNotFoundError):
            list(workers.run([1]))
        monkeypatch.setattr(cluster, "_PATIENCE_S", 0.5)
        workers._client.retire_workers(workers.names())
        with pytest.raises(RoadgeoError, match="its workers, went away"):
            list(workers.run([1]))


def test_without_dask_the_command_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(RoadgeoError, match=r"-m pip install dask"):
        list(Cluster().run([1], Squares("")))


def test_no_scheduler_is_an_error_on_one_line(monkeypatch):
    from roadgeo.running import cluster

    monkeypatch.setattr(cluster, "_PATIENCE_S", 0.5)
    with pytest.raises(RoadgeoError, match=r"no Dask scheduler with workers at tcp://127\.0\.0\.1:1: .*"):
        list(Cluster("tcp://127.0.0.1:1").run([1], Squares("")))
