"""`roadgeo track` on a small flight."""

import csv
import json
import math
import sqlite3
import time
import xml.etree.ElementTree as ET
from contextlib import closing
from datetime import UTC, datetime
from itertools import pairwise

import cv2
import jsonschema
import numpy as np
import pytest
from flights.test_motion import write_motion
from support.mavlink_peer import listening, of_kind

from examples.simulated_flights import FlightOptions, simulate_flight
from roadgeo.cli import main
from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.mavlink import has_pymavlink
from roadgeo.outputs.schemas import read_schema
from roadgeo.reference.reference import Reference

OPTIONS = FlightOptions(size_px=(400, 300), n_frames=(7, 7), gsd_m=(1.0, 1.2), turn_deg=1.0, intersections=(2, 30))


@pytest.fixture(scope="module")
def flown(town, tmp_path_factory):
    """A folder with a reference, frames and their motion, and the flight."""
    network, index = town
    folder = tmp_path_factory.mktemp("flown")
    Reference(index, network).save(folder / "town.gpkg")
    flight = simulate_flight(Landscape.from_network(network), OPTIONS, 1)
    (folder / "frames").mkdir()
    names = [f"frame_{k}.png" for k in range(len(flight.views))]
    for name, mask in zip(names, flight.masks(), strict=True):
        cv2.imwrite(str(folder / "frames" / name), mask)
    (folder / "motion.csv").write_text(write_motion(names, flight.motion))
    return folder, flight, network.plane


def test_a_flight_is_followed_and_written(flown, tmp_path, capfd):
    folder, flight, plane = flown
    command = ["track", str(folder / "frames"), "-r", str(folder / "town.gpkg"), "--motion", str(folder / "motion.csv")]
    focal = str(flight.views[0].focal_px)
    given = ["-o", str(tmp_path), "--start", "2024-05-01T09:30:00", "--json", "--focal", focal]
    assert main([*command, *given]) == 0
    output = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    for entry in output:
        jsonschema.validate(entry, read_schema("frame"))
    rows = {item["frame"]: item for item in output}
    assert sorted(rows) == list(range(7))
    assert rows[6]["time"] == "2024-05-01T09:30:06Z"
    for k, row in rows.items():
        to_crs = np.array(row["homography"])
        middle = to_crs @ (200.0, 150.0, 1.0)
        truth = plane.to_crs(flight.views[k].homography(np.array([200.0, 150.0])))
        assert np.hypot(*(middle[:2] / middle[2] - truth)) < 5.0
        height = flight.views[k].focal_px * flight.views[k].gsd_m * np.cos(np.radians(flight.views[k].tilt_deg))
        assert row["camera"]["height_m"] == pytest.approx(height, rel=0.05)
    table = list(csv.DictReader((tmp_path / "flight.csv").read_text().splitlines()))
    assert float(table[3]["Frame Center Latitude"]) == pytest.approx(rows[3]["center"]["lat"], abs=1e-7)
    assert int(table[1]["Precision Time Stamp"]) - int(table[0]["Precision Time Stamp"]) == 1_000_000
    points = ET.parse(tmp_path / "flight.gpx").getroot().findall(".//{*}trkpt")
    assert len(points) == 7
    features = json.loads((tmp_path / "flight.geojson").read_text())["features"]
    assert [feature["geometry"]["type"] for feature in features] == ["Polygon"] * 7 + ["LineString"]
    assert len(features[-1]["properties"]["coordTimes"]) == 7
    with closing(sqlite3.connect(tmp_path / "flight.gpkg")) as database:
        assert database.execute("select count(*) from footprints").fetchone() == (7,)
    page = (tmp_path / "flight.html").read_text()
    assert "frame_6.png" in page
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.skipif(not has_pymavlink(), reason="needs pymavlink")
def test_an_autopilot_hears_what_is_printed(flown, tmp_path, capfd):
    folder, flight, _ = flown
    command = ["track", str(folder / "frames"), "-r", str(folder / "town.gpkg"), "--motion", str(folder / "motion.csv")]
    began = time.time() - 60.0
    start = datetime.fromtimestamp(began, UTC).isoformat()
    given = ["-o", str(tmp_path), "--json", "-q", "--focal", str(flight.views[0].focal_px), "--start", start]
    with listening() as (url, heard):
        assert main([*command, *given, "--mavlink", url]) == 0
    rows = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    cameras = {(round(r["camera"]["lat"] * 1e7), round(r["camera"]["lon"] * 1e7)): r for r in rows if r["camera"]}
    places, commands = of_kind(heard, "GLOBAL_POSITION_SENSOR"), of_kind(heard, "COMMAND_INT")
    assert len(places) == len(commands) > 0
    for place, command in zip(places, commands, strict=True):
        row = cameras[place["lat"], place["lon"]]
        assert (command["command"], command["x"], command["y"]) == (43003, place["lat"], place["lon"])
        assert math.isclose(place["eph"], row["camera"]["sigma_m"], rel_tol=1e-6)
        assert math.isclose(command["param3"], row["camera"]["sigma_m"], rel_tol=1e-6)
        # When the frame was taken, and how long ago that was when its place was sent.
        taken = began + row["time_s"]
        assert place["time_usec"] / 1e6 == pytest.approx(taken, abs=1e-3)
        assert taken + place["processing_time"] / 1e6 == pytest.approx(place["heard_at"], abs=1.0)
    sent = [place["time_usec"] + place["processing_time"] for place in places]
    assert all(later - earlier >= 0.09e6 for earlier, later in pairwise(sent))  # 10 a second at most


def test_frames_in_no_order_are_placed_together(flown, tmp_path, capfd):
    folder, flight, plane = flown
    order = ["frame_2.png", "frame_0.png", "frame_3.png", "frame_1.png"]
    frames = [str(folder / "frames" / name) for name in order]
    command = ["track", "--unordered", *frames, "-r", str(folder / "town.gpkg"), "-o", str(tmp_path), "--json"]
    assert main(command) in (0, 3)
    rows = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    placed = [row for row in rows if row["status"] == "located"]
    assert len(placed) >= 3  # low frames show few roads: one of them may be linked to none
    assert [row["name"] for row in placed] == sorted(row["name"] for row in placed)
    for row in placed:
        k = int(row["name"][6])
        middle = np.array(row["homography"]) @ (200.0, 150.0, 1.0)
        truth = plane.to_crs(flight.views[k].homography(np.array([200.0, 150.0])))
        assert np.hypot(*(middle[:2] / middle[2] - truth)) < 5.0
    assert main([*command, "--mavlink", "udpout:127.0.0.1:1"]) == 2


def test_a_video_is_a_flight(flown, tmp_path, capfd):
    folder, _, _ = flown
    video = cv2.VideoWriter(str(tmp_path / "flight.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 2.0, (400, 300))
    for path in sorted((folder / "frames").iterdir())[:3]:
        video.write(cv2.imread(str(path)))
    video.release()
    command = ["track", str(tmp_path / "flight.avi"), "-r", str(folder / "town.gpkg"), "-o", str(tmp_path), "--json"]
    assert main([*command, "--every", "0.5", "--segment", "never", "--threshold", "127", "--band", "1"]) in (0, 3)
    rows = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert sorted({row["time_s"] for row in rows}) == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--motion", "nonesuch.csv"], 1, "cannot read nonesuch.csv"),
        (["--start", "yesterday"], 2, "expected a time such as"),
        (["--mavlink", "nowhere"], 1, "MAVLink"),
    ],
)
def test_what_is_wrong_is_one_line(flown, tmp_path, capfd, arguments, status, message):
    folder, _, _ = flown
    command = ["track", str(folder / "frames"), "-r", str(folder / "town.gpkg"), "-o", str(tmp_path), "-q"]
    assert main([*command, *arguments]) == status
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert message in said
