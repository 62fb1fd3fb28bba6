"""A MAVLink peer in a process of its own, which prints what it decodes."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["free_port", "listening", "of_kind"]

#: Prints every message it decodes as a line of JSON, until it has heard so many places or is ended. Of the datagrams
#: that come it loses every so manieth, as a radio does.
_PEER = """
import json, os, sys, time
os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil
port, count, lose, patience = map(int, sys.argv[1:])
mavutil.set_dialect("common")
link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
received, recv = 0, link.recv
def losing(n=None):
    global received
    data = recv(n)
    received += bool(data)
    return b"" if lose and data and received % lose == 0 else data
link.recv = losing
print("ready", flush=True)
heard, end = 0, time.time() + patience
while time.time() < end:
    message = link.recv_match(blocking=True, timeout=0.1)
    if message is None:
        continue
    said = {k: (None if isinstance(v, float) and v != v else v) for k, v in message.to_dict().items()}
    said.update(id_=message.get_msgId(), lost=link.mav_loss, src=message.get_srcComponent(), heard_at=time.time())
    print(json.dumps(said), flush=True)
    heard += message.get_type() == "GLOBAL_POSITION_SENSOR"
    if count and heard == count:  # the command that goes with the last place is still to come
        heard, end = heard + 1, time.time() + 0.4
"""


def free_port() -> int:
    """Return a UDP port of this machine that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@contextmanager
def listening(count: int = 0, lose: int = 0, patience_s: int = 120) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Start a peer; yield the address to send to, and a list that holds what it decoded once the block has ended.

    With a `count` it listens on until it has heard so many places; without one, to the end of the block.
    """
    port, heard = free_port(), list[dict[str, Any]]()
    command = [sys.executable, "-c", _PEER, *map(str, (port, count, lose, patience_s))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as peer:
        assert peer.stdout is not None
        assert peer.stdout.readline() == "ready\n"
        try:
            yield f"udpout:127.0.0.1:{port}", heard
            if not count:
                time.sleep(0.5)  # what was sent last is still on its way
                peer.terminate()
            heard += [json.loads(line) for line in peer.stdout]
            peer.wait(30)
        finally:
            peer.kill()


def of_kind(heard: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    """Return the messages of a type."""
    return [item for item in heard if item["mavpackettype"] == kind]
