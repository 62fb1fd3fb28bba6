"""Processes that locate, on a real reference: what is hostile ends in an answer, and the next is located."""

import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zlib
from contextlib import nullcontext

import cv2
import numpy as np
import pytest
from support.mavlink_peer import listening, of_kind

from roadgeo.errors import IndexFormatError
from roadgeo.evaluation.landscape import Landscape
from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query
from roadgeo.reference.reference import Reference
from roadgeo.running.flights.mavlink import has_pymavlink
from roadgeo.running.serving.workers import Asked, Workers

pytestmark = pytest.mark.slow

VIEW = ViewOptions(size_px=(900, 900), gsd_m=(1.0, 1.0), heading_deg=(0.0, 360.0), intersections=(25, 1000))


@pytest.fixture(scope="module")
def place(town, tmp_path_factory):
    """A reference on disk, and a mask of it."""
    network, index = town
    folder = tmp_path_factory.mktemp("served")
    Reference(index, network).save(folder / "town.gpkg")
    query = simulate_query(Landscape.from_network(network), SimulationOptions(VIEW, NOISE_MODELS["clean"]), 0)
    cv2.imwrite(str(folder / "mask.png"), query.mask)
    return folder, query.truth


def png(width, height):
    """A PNG that says it is so large, and holds next to nothing."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )


def test_a_process_locates_and_survives_what_is_hostile(place, tmp_path):
    folder, truth = place
    hostile = {
        "bomb.png": (png(60_000, 60_000), 413),
        "cut.png": ((folder / "mask.png").read_bytes()[:400], 422),
        "noise.jpg": (b"\xff\xd8\xff\xe0" + bytes(range(256)), 422),
        "empty.tif": (b"II*\0", 422),
    }
    workers = Workers([str(folder / "town.gpkg")], 1, 2)
    try:
        for name, (content, status) in hostile.items():
            (tmp_path / name).write_bytes(content)
            answer = workers.ask(Asked(str(tmp_path / name), {}, 5.0, 64_000_000))
            assert answer.status == status, (name, answer)
            assert str(tmp_path) not in answer.document["detail"]
        first = workers._all[0]._process
        first.kill()
        first.join()
        answer = workers.ask(Asked(str(folder / "mask.png"), {"gsd_m": (0.5, 2.0)}, 10.0, 64_000_000))
        assert answer.status == 200
        found = answer.document
        assert found["status"] == "located"
        assert np.hypot(found["center"]["x"] - truth.center[0], found["center"]["y"] - truth.center[1]) < 5.0
    finally:
        workers.close()


def test_a_missing_reference_is_said(tmp_path):
    with pytest.raises(IndexFormatError):
        Workers([str(tmp_path / "nonesuch.gpkg")], 1, 0)


def test_the_command_serves_until_it_is_interrupted(place):
    folder, truth = place
    program = "import sys; from roadgeo.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "serve", "-r", str(folder / "town.gpkg"), "--port", "0"]
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


@pytest.mark.parametrize("options", [["--host", "0.0.0.0"], ["--token-file", os.devnull]])
def test_others_may_ask_with_a_token_only(options):
    program = "import sys; from roadgeo.cli import main; sys.exit(main())"
    environment = {name: value for name, value in os.environ.items() if name != "ROADGEO_TOKEN"}
    done = subprocess.run(
        [sys.executable, "-c", program, "serve", *options], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 2
    assert "token" in done.stderr
