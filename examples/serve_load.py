"""How `roadgeo serve` bears load, and strangers.

    python examples/serve_load.py boston.gpkg mask.png --rate 200 --seconds 10 --hostile 10000

Starts the server on a free port of this machine, posts a mask at a steady rate, whether or not earlier requests were
answered, and then hostile requests; prints how many were located, how many were asked to come again, how long both
took, and whether the server still locates at the end. Nothing but loopback is asked.
"""

import argparse
import json
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np


def post(port: int, body: bytes, path: str = "/locate", timeout: float = 90.0) -> tuple[int, float, bool]:
    """Return status, seconds, and whether it gave a time to come again."""
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    return send(port, head.encode() + body, timeout)


def send(port: int, data: bytes, timeout: float) -> tuple[int, float, bool]:
    answer, seconds = ask(port, data, timeout)
    return status_of(answer), seconds, status_of(answer) == 503


def ask(port: int, data: bytes, timeout: float) -> tuple[bytes, float]:
    """Return all that is answered, and seconds."""
    started, answer = time.perf_counter(), b""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=timeout) as sock:
            sock.sendall(data)
            while part := sock.recv(65536):
                answer += part
    except OSError:
        pass  # answers before the connection broke count
    return answer, time.perf_counter() - started


def status_of(answer: bytes) -> int:
    """Return the status of an answer, 0 if it is no HTTP answer."""
    return int(answer[9:12]) if answer[:5] == b"HTTP/" and answer[9:12].isdigit() else 0


def steady(port: int, mask: bytes, rate: float, seconds: float) -> list[tuple[int, float, bool]]:
    with ThreadPoolExecutor(400) as pool:
        started, futures = time.perf_counter(), []
        for k in range(int(rate * seconds)):
            time.sleep(max(0.0, started + k / rate - time.perf_counter()))
            futures.append(pool.submit(post, port, mask))
        return [future.result() for future in futures]


def png(width: int, height: int, content: bytes) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    packed = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(content)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + packed


def hostile(rng: random.Random, mask: bytes) -> tuple[bytes, float]:
    """Return the bytes of one request, and how long its sender waits for an answer."""
    start = b"POST /locate HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n"

    def with_body(body: bytes) -> bytes:
        return start + b"Content-Length: %d\r\n\r\n" % len(body) + body

    flipped = bytearray(mask)
    for _ in range(20):
        flipped[rng.randrange(8, len(flipped))] = rng.randrange(256)
    kinds = [
        lambda: with_body(png(60_000, 60_000, bytes(1000))),
        lambda: with_body(mask[: rng.randrange(8, len(mask))]),
        lambda: with_body(bytes(flipped)),
        lambda: with_body(rng.randbytes(rng.randrange(2000))),
        lambda: with_body(b"<VRTDataset><SourceFilename>/etc/passwd</SourceFilename></VRTDataset>"),
        lambda: start + b"Content-Length: 99999999999\r\n\r\n",
        lambda: start + b"Transfer-Encoding: chunked\r\n\r\nFFFFFFFF\r\n" + bytes(3000),
        lambda: start + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n",
        lambda: b"GET / HTTP/1.1\r\n" + b"".join(b"X%d: y\r\n" % k for k in range(300)) + b"\r\n",
        lambda: b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n",
        lambda: rng.randbytes(300) + b"\r\n\r\n",
        lambda: b"GET /tiles/0/1/1/" + b"9" * 5000 + b".mvt HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n",
        lambda: b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n",
    ]  # fmt: skip
    if rng.random() < 0.02:  # a slow sender: it stops halfway, and goes
        return start + b"Content-Length: 1000\r\n\r\n" + bytes(10), 0.3
    return rng.choice(kinds)(), 60.0


def attack(port: int, mask: bytes, count: int, seed: int = 0) -> Counter[int]:
    seen, lock = Counter[int](), threading.Lock()

    def send(k: int) -> None:
        data, patience = hostile(random.Random(seed * 1_000_003 + k), mask)
        answer, seconds = ask(port, data, patience)
        status = status_of(answer)
        with lock:
            seen[status] += 1
        if status == 500:  # a fault of the server: name the request, so that it can be sent again
            print(f"request {k} after {seconds:.1f} s: {data[:80]!r} -> {answer[-300:]!r}", flush=True)

    with ThreadPoolExecutor(16) as pool:
        list(pool.map(send, range(count)))
    return seen


def report(name: str, seconds: list[float]) -> None:
    if seconds:
        p50, p99 = (1000 * float(np.quantile(seconds, q)) for q in (0.5, 0.99))
        print(f"{name:28} {len(seconds):6}   median {p50:8.1f} ms   p99 {p99:8.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reference")
    parser.add_argument("mask", type=Path)
    parser.add_argument("--rate", type=float, default=200.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--hostile", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    mask = given.mask.read_bytes()
    program = "import sys; from roadgeo.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "serve", "--quiet", "-r", given.reference]
    command += ["--port", "0", "--jobs", str(given.jobs)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        try:
            line = next(line for line in server.stderr or [] if "Listening" in line)
            port = int(re.findall(r":(\d+)/", line)[0])
            alone = [post(port, mask)[1] for _ in range(5)]
            report("alone", alone)
            answers = steady(port, mask, given.rate, given.seconds)
            report("answered", [s for status, s, _ in answers if status == 200])
            report("told to come again", [s for status, s, again in answers if status == 503 and again])
            others = [status for status, _, again in answers if status != 200 and not (status == 503 and again)]
            print(f"neither: {len(others)} {dict(Counter(others))}")
            started = time.perf_counter()
            seen = attack(port, mask, given.hostile)
            print(f"hostile: {given.hostile} in {time.perf_counter() - started:.0f} s, statuses {dict(seen)}")
            for _ in range(20):
                status, seconds, again = post(port, mask)
                if not again:
                    break
                time.sleep(1.0)
            print(f"after that: status {status} in {1000 * seconds:.0f} ms")
            print(json.dumps({"server still runs": server.poll() is None}))
        finally:
            server.send_signal(signal.SIGINT)


if __name__ == "__main__":
    main()
