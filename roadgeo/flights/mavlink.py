"""Places sent to an autopilot over MAVLink: PX4's GLOBAL_POSITION_SENSOR, ArduPilot's external position estimate.

pymavlink is an extra. Messages go out by any connection of pymavlink (udpout:, tcp:,
a serial port); nothing is received. A heartbeat announces us. See https://mavlink.io/en/messages/common.html,
message 296 and command 43003.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roadgeo.errors import OutputError, how_to_install

__all__ = ["MavlinkSender", "PositionFix", "fix_of", "has_pymavlink"]

#: MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY and MAV_TYPE_ONBOARD_CONTROLLER: our role for the autopilot.
_COMPONENT, _TYPE = 197, 18
#: Our system, which is the vehicle's; the autopilot, its system and component; number of our sensor.
_SYSTEM, _AUTOPILOT, _SENSOR = 1, (1, 1), 1
_SRC_VISION = 2
_COMMAND_EXTERNAL_POSITION = 43003
#: The time of transmission starts anew after this many seconds: a 32-bit float then resolves milliseconds.
_WRAP_S = 36_000.0


@dataclass(frozen=True)
class PositionFix:
    """A place and when it held.

    Attributes
    ----------
    lon, lat : float
        Degrees, WGS 84.
    sigma_m : float
        Standard deviation of the place: root mean square of its distance from the truth.
    taken_s : float
        When the frame was taken, seconds since 1970.
    """

    lon: float
    lat: float
    sigma_m: float
    taken_s: float


def fix_of(row: Mapping[str, Any], taken_s: float) -> PositionFix | None:
    """Return our position, from a frame's row or a location as plain values; None where that is not known.

    It is the place of the camera where its focal length was given, and otherwise the frame's middle. The place of a
    frame whose roads contradict its motion is not known.
    """
    if row.get("status") == "predicted" and row.get("log10_odds") is not None:
        return None
    camera = row.get("camera")
    if camera and camera.get("source", "camera") == "camera":
        stated = camera.get("sigma")
        accuracy_m = row.get("lonlat_accuracy_m") or 0.0
        sigma = camera["sigma_m"] if stated is None else math.hypot(stated["x_m"], stated["y_m"], accuracy_m)
        return PositionFix(camera["lon"], camera["lat"], sigma, taken_s)
    if row.get("center") is None or row.get("status") == "ambiguous":
        return None
    sigma = row.get("sigma_m")
    if sigma is None:
        sigma = max(row.get("lonlat_sigma_m") or row.get("corner_sigma_m") or [math.nan])
    return PositionFix(row["center"]["lon"], row["center"]["lat"], sigma, taken_s)


def has_pymavlink() -> bool:
    """Whether pymavlink is installed."""
    from importlib.util import find_spec

    return find_spec("pymavlink") is not None


class MavlinkSender:
    """Sends places, and a heartbeat in a thread of its own until it is closed.

    Attributes
    ----------
    n_sent, n_left_out : int
        Places sent, and those that came too fast.
    """

    def __init__(
        self, url: str, max_rate_hz: float = 10.0, heartbeat_hz: float = 1.0, clock: Callable[[], float] = time.time
    ) -> None:
        """Connect; places that come faster than `max_rate_hz` are left out.

        Raises
        ------
        OutputError
            There is no pymavlink, it is too old, or the address cannot be used.
        """
        self._least_s, self._beat_s, self._clock = 1.0 / max_rate_hz, 1.0 / heartbeat_hz, clock
        self._link = _connect(url)
        self._started = clock()
        self._last = -math.inf
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self.n_sent = self.n_left_out = 0
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()

    def __enter__(self) -> MavlinkSender:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, fix: PositionFix) -> bool:
        """Send one place to both kinds of autopilot; return whether it was sent, for it may have come too fast."""
        now = self._clock()
        with self._lock:
            if now - self._last < self._least_s - 1e-9:
                self.n_left_out += 1
                return False
            self._last = now
            self.n_sent += 1
            processing_s = max(now - fix.taken_s, 0.0)
            with contextlib.suppress(OSError):  # a peer that is not there yet
                self._send_px4(fix, processing_s)
                self._send_ardupilot(fix, processing_s, now)
        return True

    def close(self) -> None:
        """End the heartbeat and the connection."""
        self._ended.set()
        self._thread.join(5.0)
        self._link.close()

    def _send_px4(self, fix: PositionFix, processing_s: float) -> None:
        self._link.mav.global_position_sensor_send(
            *_AUTOPILOT, _SENSOR,
            round(fix.taken_s * 1e6), min(round(processing_s * 1e6), 2**32 - 1), _SRC_VISION, 0,
            round(fix.lat * 1e7), round(fix.lon * 1e7), math.nan, math.nan, fix.sigma_m, math.nan,
        )  # fmt: skip

    def _send_ardupilot(self, fix: PositionFix, processing_s: float, now: float) -> None:
        self._link.mav.command_int_send(
            *_AUTOPILOT, 0, _COMMAND_EXTERNAL_POSITION, 0, 0,
            (now - self._started) % _WRAP_S, processing_s, fix.sigma_m, 0.0,
            round(fix.lat * 1e7), round(fix.lon * 1e7), math.nan,
        )  # fmt: skip

    def _beat(self) -> None:
        while True:
            with self._lock, contextlib.suppress(OSError):
                self._link.mav.heartbeat_send(_TYPE, 8, 0, 0, 4)  # no autopilot; active
            if self._ended.wait(self._beat_s):
                return


def _connect(url: str) -> Any:
    if not has_pymavlink():
        raise OutputError(f"MAVLink needs pymavlink: {how_to_install('mavlink')}")
    form = re.fullmatch(r"(udpout|udpin|udpbcast|tcp|tcpin):[^:\s]+:(\d{1,5})", url)
    if not (form and int(form[2]) < 65536) and not Path(url.split(",")[0]).exists():  # a device, and its speed
        raise OutputError(f"cannot send MAVLink to {url}; expected such as udpout:127.0.0.1:14550, or a serial device")
    kept = os.environ.get("MAVLINK20")
    os.environ["MAVLINK20"] = "1"  # message 296 exists in version 2 of the protocol only
    try:
        from pymavlink import mavutil

        mavutil.set_dialect("common")
        link = mavutil.mavlink_connection(url, source_system=_SYSTEM, source_component=_COMPONENT)
    except Exception as error:  # pymavlink raises of any kind
        why = f"{type(error).__name__}: {error}"
        raise OutputError(f"cannot send MAVLink to {url}: {why}; expected such as udpout:127.0.0.1:14550") from error
    finally:
        if kept is None:
            os.environ.pop("MAVLINK20", None)
    if not hasattr(link.mav, "global_position_sensor_send"):
        link.close()
        raise OutputError(f"pymavlink is too old: it knows no GLOBAL_POSITION_SENSOR; {how_to_install('mavlink')} -U")
    return link
