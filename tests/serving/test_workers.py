"""Processes that locate, on a real reference: what is hostile ends in an answer, and the next is located."""

import contextlib
import errno
import json
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.groups import is_gone
from support.mavlink_peer import listening, of_kind
from worlds.pngs import png

from roadgeo.cli import main
from roadgeo.errors import IndexFormatError, ModelError
from roadgeo.flights.mavlink import has_pymavlink
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Content, Location
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.running.passes import Sighting
from roadgeo.running.pool import Lost
from roadgeo.serving.workers import ImageRequest, ImageWorkers, Serving, _reply
from roadgeo.sources.segmentation.probability import ProbabilityMap

#: The program that serves.
SERVE = [sys.executable, "-m", "roadgeo", "serve"]


def test_a_process_locates_and_survives_what_is_hostile(place, tmp_path):
    folder, truth = place
    hostile = {
        "bomb.png": (png(60_000, 60_000), 413),
        "cut.png": ((folder / "mask.png").read_bytes()[:400], 422),
        "noise.jpg": (b"\xff\xd8\xff\xe0" + bytes(range(256)), 422),
        "empty.tif": (b"II*\0", 422),
    }
    workers = ImageWorkers([str(folder / "town.gpkg")], 1, 2)
    try:
        for name, (content, status) in hostile.items():
            (tmp_path / name).write_bytes(content)
            answer = workers.ask(ImageRequest(str(tmp_path / name), {}, 5.0, 64_000_000))
            assert answer.status == status, (name, answer)
            assert str(tmp_path) not in answer.document["detail"]
        first = workers._processes.all[0].process
        first.kill()
        first.join()
        answer = workers.ask(ImageRequest(str(folder / "mask.png"), {"gsd_m": (0.5, 2.0)}, 10.0, 64_000_000))
        assert answer.status == 200
        found = answer.document
        assert found["status"] == "located"
        assert np.hypot(found["center"]["x"] - truth.center[0], found["center"]["y"] - truth.center[1]) < 5.0
    finally:
        workers.close()


def test_what_a_process_answers(place, tmp_path):
    folder, _ = place
    (tmp_path / "cut.png").write_bytes((folder / "mask.png").read_bytes()[:400])
    (tmp_path / "bomb.png").write_bytes(png(60_000, 60_000))
    cv2.imwrite(str(tmp_path / "mask.tif"), cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE))
    asked = [
        ImageRequest(str(folder / "mask.png"), {"gsd_m": (0.5, 2.0)}, 10.0, 64_000_000),
        ImageRequest(str(tmp_path / "mask.tif"), {"near": (0.0, 0.0, 10.0)}, 10.0, 64_000_000),
        ImageRequest(str(tmp_path / "mask.tif"), {}, 10.0, 100),
        ImageRequest(str(tmp_path / "bomb.png"), {}, 10.0, 64_000_000),
        ImageRequest(str(tmp_path / "cut.png"), {}, 10.0, 64_000_000),
    ]
    found, elsewhere, small, bomb, cut = map(Serving((str(folder / "town.gpkg"),), 1).prepare(), asked)
    assert (found.status, found.document["status"], found.document["query"]) == (200, "located", "")
    assert found.document["reference_digest"] == open_reference(folder / "town.gpkg").digest
    assert found.document["options"]["match"] == {"camera": {"gsd_m": [0.5, 2.0]}}
    assert (elsewhere.status, elsewhere.document["reason_code"]) == (200, "few_near")
    assert (small.status, small.document["detail"][:15]) == (413, "900 x 900 pixel")
    assert bomb.status == 413
    assert cut.status == 422
    assert "the image" in cut.document["detail"]
    assert str(tmp_path) not in cut.document["detail"]


def test_a_place_that_is_not_listed_is_no_fault(place):
    folder, _ = place
    asked = ImageRequest(str(folder / "mask.png"), {"gsd_m": (0.5, 2.0), "take": 9}, 10.0, 64_000_000)
    answer = _reply(asked, [open_reference(folder / "town.gpkg")])
    assert answer.status == 422
    assert "there is no place 9" in answer.document["detail"]


def test_a_circle_on_no_map_is_refused_where_longitude_and_latitude_are_exchanged(place):
    folder, _ = place
    town = open_reference(folder / "town.gpkg")
    lon, lat = to_lonlat(town.index.plane.crs, town.index.plane.to_crs(town.index.xy[:1]))[0].tolist()
    asked = ImageRequest(str(folder / "mask.png"), {"near": (lat, lon, 900.0)}, 10.0, 64_000_000)
    answer = _reply(asked, [town])
    assert answer.status == 400
    assert f"did you mean near={lon:.9g},{lat:.9g},900" in answer.document["detail"]


def test_a_fault_is_answered_and_not_where_files_lie(place, monkeypatch):
    def fail(path, *_, **__):
        raise ZeroDivisionError(f"in {path}")

    monkeypatch.setattr("roadgeo.running.queries.locate_query", fail)
    folder, _ = place
    answer = _reply(
        ImageRequest(str(folder / "mask.png"), {}, 10.0, 64_000_000), [open_reference(folder / "town.gpkg")]
    )
    assert answer.status == 500
    assert answer.document == {"detail": "a fault of roadgeo: ZeroDivisionError: in the image"}


def test_a_port_that_is_taken_is_said(place, capsys):
    folder, _ = place
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "-r", str(folder / "town.gpkg"), "--port", str(port), "--jobs", "1"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"Error: cannot listen on 127.0.0.1 port {port}: ")
    assert said.endswith("choose another --port")
    assert not multiprocessing.active_children()


@pytest.fixture
def one_worker(place):
    workers = ImageWorkers([str(place[0] / "town.gpkg")], 1, 2)
    yield workers, ImageRequest(str(place[0] / "mask.png"), {"gsd_m": (0.5, 2.0)}, 10.0, 64_000_000)
    workers.close()


@contextmanager
def request_beside(workers, request):
    """Ask a process that stands still: a list that holds the answer after the block."""
    answers = []
    os.kill(workers._processes.all[0].process.pid, signal.SIGSTOP)
    thread = threading.Thread(target=lambda: answers.append(workers.ask(request)))
    thread.start()
    yield answers
    thread.join(60)


def test_a_process_that_breaks_at_work_costs_nobody_an_answer(one_worker):
    workers, request = one_worker
    with request_beside(workers, request) as answers:
        time.sleep(0.2)
        workers._processes.all[0].process.kill()
    assert [answer.status for answer in answers] == [200]


def test_an_image_that_breaks_every_process_is_told_so(one_worker, monkeypatch):
    def broken(self, *_):
        return "lost", Lost("died", "it died")

    workers, request = one_worker
    with monkeypatch.context() as patch:
        patch.setattr("roadgeo.running.processes._Process.ask", broken)
        assert workers.ask(request).status == 500
    assert workers.ask(request).status == 200


def test_what_takes_too_long_is_ended_and_no_fault(one_worker, monkeypatch):
    workers, request = one_worker
    monkeypatch.setattr("roadgeo.serving.workers._GRACE_S", 0.3)
    with request_beside(workers, replace(request, time_limit_s=0.2)) as answers:
        pass
    assert [answer.status for answer in answers] == [503]
    assert "longer than 0.5 s" in answers[0].document["detail"]
    monkeypatch.undo()
    assert workers.ask(request).status == 200


def test_a_system_without_room_for_a_process_is_no_fault(one_worker, monkeypatch):
    def none(*_, **__):
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    workers, request = one_worker
    workers._processes.all[0].process.kill()
    with monkeypatch.context() as patch:
        patch.setattr("multiprocessing.process.BaseProcess.start", none)
        assert [workers.ask(request).status for _ in range(2)] == [503, 503]
    assert workers.ask(request).status == 200


def test_who_asks_while_the_server_ends_is_told(one_worker):
    workers, request = one_worker
    process = workers._processes.all[0].process
    with request_beside(workers, request) as answers:
        time.sleep(0.2)
        workers.close()
    assert [answer.status for answer in answers] == [503]
    assert not process.is_alive()


def test_photographs_are_refused_where_there_is_no_model_for_them(monkeypatch):
    def none(*_, **__):
        raise ModelError("photographs need onnxruntime: pip install 'roadgeo[segment]'")

    monkeypatch.setattr("roadgeo.storage.rasters.raster_size", lambda _: (10, 10))
    monkeypatch.setattr("roadgeo.running.queries.locate_query", none)
    answer = _reply(ImageRequest("/images/sent/photo.jpg", {}, 1.0, 1000), [])
    assert answer.status == 415
    assert "onnxruntime" in answer.document["detail"]


def test_the_roads_of_a_photograph_are_found_once(tmp_path, town, monkeypatch):
    asked_of = []

    def locate_query(path, *_, **__):
        asked_of.append(Path(path).name)
        seen = ProbabilityMap(np.full((40, 60), 9, np.uint8))
        refused = Location("photo.png", "not_located", "hardly a road", content=Content((60, 40)))
        return Sighting(refused, RoadMask(np.zeros((40, 60), bool)), probability=seen).showing(kind="photograph")

    monkeypatch.setattr("roadgeo.running.queries.locate_query", locate_query)
    network, index = town
    (tmp_path / "sent").mkdir()
    image = tmp_path / "sent" / "photo.png"
    cv2.imwrite(str(image), np.full((40, 60, 3), 99, np.uint8))
    for hints in ({}, {"near": (0.0, 0.0, 9.0)}, {"gsd_m": (1.0, 2.0)}):
        request = ImageRequest(str(image), hints, 1.0, 10_000, keeps=True)
        assert _reply(request, [Reference(index, network)]).status == 200
        assert json.loads((tmp_path / "own" / "view.json").read_text())["is_photograph"] is True
    assert asked_of == ["photo.png", "seen.tif", "photo.png"]


def test_a_place_is_told_though_there_is_no_room_for_its_view(place, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("roadgeo.serving.view.write_view", full)
    request = ImageRequest(str(place[0] / "mask.png"), {"gsd_m": (0.5, 2.0)}, 10.0, 64_000_000, keeps=True)
    answer = _reply(request, [open_reference(place[0] / "town.gpkg")])
    assert (answer.status, answer.document["status"], answer.lacks_view) == (200, "located", True)


def test_a_missing_reference_is_said(tmp_path):
    with pytest.raises(IndexFormatError):
        ImageWorkers([str(tmp_path / "nonesuch.gpkg")], 1, 0)


def test_the_command_serves_until_it_is_interrupted(place):
    folder, truth = place
    command = [*SERVE, "-r", str(folder / "town.gpkg"), "--port", "0"]
    peer = listening() if has_pymavlink() else nullcontext(("", []))
    with (
        peer as (url, heard),
        subprocess.Popen(
            [*command, *(["--mavlink", url] if url else [])], stderr=subprocess.PIPE, text=True
        ) as process,
    ):
        try:
            line = next(line for line in process.stderr if "Listening" in line)
            address = re.search(r"http://127\.0\.0\.1:\d+/", line)[0]
            asked = urllib.request.Request(address + "locate", (folder / "mask.png").read_bytes(), method="POST")
            asked_at = time.time()
            with urllib.request.urlopen(asked, timeout=60) as answer:
                found = json.load(answer)
            assert found["status"] == "located"
            assert abs(found["center"]["x"] - truth.center[0]) < 5.0
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(address + "locate", b"no image", timeout=60)
            assert refused.value.code == 415
            refused.value.close()
            for _ in range(30):  # more than fits into a pipe: nobody reads what is logged
                with urllib.request.urlopen(f"{address}health?{'a' * 6000}", timeout=60) as answer:
                    assert json.load(answer)["status"] == "ok"
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    if heard:
        (place,), (command,) = of_kind(heard, "GLOBAL_POSITION_SENSOR"), of_kind(heard, "COMMAND_INT")
        there = (round(found["center"]["lat"] * 1e7), round(found["center"]["lon"] * 1e7))
        assert (place["lat"], place["lon"]) == (command["x"], command["y"]) == there
        assert place["eph"] == pytest.approx(max(found["corner_sigma_m"]), rel=1e-6)
        assert asked_at - 0.1 < place["time_usec"] / 1e6 < place["heard_at"]
        assert place["time_usec"] + place["processing_time"] <= place["heard_at"] * 1e6
    assert bool(heard) == has_pymavlink()


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_neither_processes_nor_images_outlive_a_server_that_is_killed(place, tmp_path_factory):
    command = [*SERVE, "-r", str(place[0] / "town.gpkg"), "--port", "0", "-j", "2"]
    folder = tmp_path_factory.mktemp("own")  # short: sockets lie in it, whose paths have at most 107 characters
    environment = {**os.environ, "TMPDIR": str(folder)}
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment
    ) as process:
        try:
            said: list[str] = []
            assert any(said.append(line) or "Listening" in line for line in process.stderr), said
            assert list(folder.glob("roadgeo-*"))
            process.kill()
            process.wait(10)
            assert is_gone(process.pid)
            assert not list(folder.glob("roadgeo-*"))
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("options", [["--host", "0.0.0.0"], ["--token-file", os.devnull]])
def test_others_may_ask_with_a_token_only(options):
    environment = {name: value for name, value in os.environ.items() if name != "ROADGEO_TOKEN"}
    done = subprocess.run([*SERVE, *options], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 2
    assert "token" in done.stderr


@pytest.mark.parametrize(
    "url", ["ftp://a/{z}/{x}/{y}", "https://a.example/{z}/{x}.png", "https://a; script-src */{z}/{x}/{y}"]
)
def test_a_basemap_is_an_address_of_tiles(url, capsys):
    assert main(["serve", "--basemap", url]) == 2
    assert "{z}/{x}/{y}" in capsys.readouterr().err


def test_a_supervisor_that_ends_it_is_told_so(place):
    folder, _ = place
    command = [*SERVE, "--reference", str(folder / "town.gpkg"), "--port", "0", "--no-browser"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        assert server.stderr is not None
        while "Listening" not in server.stderr.readline():
            assert server.poll() is None
        server.send_signal(signal.SIGTERM)
        assert server.wait(30) == 128 + signal.SIGTERM
