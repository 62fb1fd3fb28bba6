"""MAVLink on loopback: what another process decodes is what was sent."""

import math
import time
from dataclasses import replace

import pytest
from support.mavlink_peer import free_port, listening, of_kind

from roadgeo.errors import OutputError
from roadgeo.flights.mavlink import MavlinkSender, PositionFix, fix_of, has_pymavlink

needs = pytest.mark.skipif(not has_pymavlink(), reason="needs pymavlink")


def talk(fixes, count, lose=0, pause_s=0.0, **options):
    """Send places, whose times are how long ago frames were taken, to a peer in another process.

    Return what it decoded, and the sender.
    """
    with listening(count, lose) as (url, heard), MavlinkSender(url, **options) as sender:
        for fix in fixes:
            sender.send(replace(fix, taken_s=time.time() - fix.taken_s))
            time.sleep(pause_s)
    return heard, sender


@needs
def test_a_peer_decodes_what_was_sent():
    fixes = [PositionFix(-71.0954851 + 0.001 * k, 42.3450061, 0.8 + k, 0.25) for k in range(3)]
    started = time.time()
    heard, _ = talk(fixes, 3, max_rate_hz=1000.0, pause_s=0.01)
    places, commands = of_kind(heard, "GLOBAL_POSITION_SENSOR"), of_kind(heard, "COMMAND_INT")
    assert len(places) == len(commands) == 3
    for fix, place, command in zip(fixes, places, commands, strict=True):
        assert place["id_"] == 296
        sent_at = (round(fix.lat * 1e7), round(fix.lon * 1e7))
        assert (place["lat"], place["lon"]) == (command["x"], command["y"]) == sent_at
        assert math.isclose(place["eph"], fix.sigma_m, rel_tol=1e-6)
        assert place["alt"] is place["alt_ellipsoid"] is place["epv"] is None
        assert started - 0.25 <= place["time_usec"] / 1e6 < time.time()
        assert command["command"] == 43003
        assert math.isclose(command["param3"], fix.sigma_m, rel_tol=1e-6)
        assert command["z"] is None
        # Delay: from when the frame was taken to when the place was sent.
        assert 0.25 <= command["param2"] < 0.75
        assert math.isclose(place["processing_time"] / 1e6, command["param2"], abs_tol=1e-4)
    sent = [item["param1"] for item in commands]
    assert sent == sorted(sent)
    assert of_kind(heard, "HEARTBEAT")
    assert {item["src"] for item in heard} == {197}


@needs
def test_places_that_come_too_fast_are_left_out():
    clock = iter([0.0, *(0.01 * k for k in range(100))])
    with MavlinkSender(f"udpout:127.0.0.1:{free_port()}", clock=lambda: next(clock)) as sender:
        sent = [sender.send(PositionFix(1.0, 2.0, 3.0, 0.0)) for _ in range(100)]
    assert sent == [k % 10 == 0 for k in range(100)]
    assert (sender.n_sent, sender.n_left_out) == (10, 90)


@needs
def test_losses_are_seen_by_the_peer_and_the_rest_arrives():
    fixes = [PositionFix(1.0, 2.0 + 0.001 * k, 1.0, 0.0) for k in range(30)]
    heard, sender = talk(fixes, 20, lose=5, pause_s=0.005, max_rate_hz=1000.0)
    places = of_kind(heard, "GLOBAL_POSITION_SENSOR")
    assert sender.n_sent == 30
    assert 20 <= len(places) < 30
    assert heard[-1]["lost"] > 0
    sent = {round(fix.lat * 1e7) for fix in fixes}
    assert {place["lat"] for place in places} <= sent


@needs
def test_heartbeats_come_at_their_rate():
    heard, _ = talk([PositionFix(1.0, 2.0, 1.0, 0.0)] * 10, 10, pause_s=0.1, max_rate_hz=100.0, heartbeat_hz=10.0)
    assert 6 <= len(of_kind(heard, "HEARTBEAT")) <= 25


@needs
@pytest.mark.parametrize("url", ["udpout:nonsense", "nonsense:1:2:3", "udpout:127.0.0.1:99999", "/dev/nonesuch"])
def test_addresses_that_are_none_are_told(url):
    with pytest.raises(OutputError, match="MAVLink"):
        MavlinkSender(url)


def test_without_pymavlink_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setattr("roadgeo.flights.mavlink.has_pymavlink", lambda: False)
    with pytest.raises(OutputError, match=r"pip install .*pymavlink"):
        MavlinkSender("udpout:127.0.0.1:1")


def test_the_camera_is_told_where_its_lens_is_known_and_the_middle_otherwise():
    middle = {"status": "tracked", "center": {"lon": 1.0, "lat": 2.0}, "sigma_m": 3.0, "camera": None}
    assert fix_of(middle, 5.0) == PositionFix(1.0, 2.0, 3.0, 5.0)
    row = {**middle, "camera": {"lon": 1.5, "lat": 2.5, "height_m": 300.0, "sigma_m": 4.0}}
    assert fix_of(row, 5.0) == PositionFix(1.5, 2.5, 4.0, 5.0)
    location = {"status": "located", "center": {"lon": 1.0, "lat": 2.0}, "corner_sigma_m": [1.0, 2.0, 1.5, 1.0]}
    assumed = {"lon": 1.5, "lat": 2.5, "source": "assumed", "sigma": {"x_m": 3.0, "y_m": 4.0}}
    assert fix_of({**location, "camera": assumed}, 5.0) == PositionFix(1.0, 2.0, 2.0, 5.0)
    assert fix_of({**location, "camera": {**assumed, "source": "camera"}}, 5.0) == PositionFix(1.5, 2.5, 5.0, 5.0)
    assert fix_of({"status": "not_located", "center": None}, 5.0) is None
    assert fix_of({**location, "status": "ambiguous"}, 5.0) is None
