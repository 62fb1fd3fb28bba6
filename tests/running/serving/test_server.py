"""The server over real sockets, with workers that answer at once, slowly, or not."""

import errno
import http.client
import json
import os
import socket
import struct
import threading
import time
from contextlib import contextmanager, suppress

import pytest

from roadgeo.running.serving.server import ServeOptions, Server
from roadgeo.running.serving.workers import Answer, Full

PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)
FOUND = {"schema": "roadgeo.location/1", "status": "located", "center": {"lon": 1.0, "lat": 2.0}}


class Workers:
    """Stands for processes: it keeps what it was asked."""

    def __init__(self, places=4):
        self.asked, self.places, self.busy = [], threading.Semaphore(places), threading.Event()
        self.busy.set()

    def is_full(self):
        free = self.places.acquire(blocking=False)
        if free:
            self.places.release()
        return not free

    def ask(self, asked):
        if not self.places.acquire(blocking=False):
            raise Full
        try:
            self.busy.wait(10.0)
            self.asked.append(asked)
            return Answer(200, FOUND)
        finally:
            self.places.release()

    def close(self):
        pass


@contextmanager
def serving(workers=None, told=None, **options):
    server = Server(workers or Workers(), ["town"], ServeOptions(port=0, **options), told)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.close()
        thread.join()


def ask(server, method, path, body=None, headers=None):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.request(method, path, body, headers or {})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer, json.loads(content) if content else None


def send_raw(server, data, wait_s=5.0):
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=wait_s) as sock:
        sock.sendall(data)
        answer = b""
        try:
            while part := sock.recv(65536):
                answer += part
        except (TimeoutError, ConnectionResetError):
            pass
    return answer


def test_an_image_is_located_with_its_hints():
    workers = Workers()
    with serving(workers) as server:
        answer, found = ask(server, "POST", "/locate?gsd=0.5,1&timeLimit=3", PNG)
        assert (answer.status, found) == (200, FOUND)
        assert workers.asked[0].hints == {"gsd_m": (0.5, 1.0)}
        assert workers.asked[0].time_limit_s == 3.0
        assert workers.asked[0].path.endswith(".png")


def test_nobody_searches_longer_than_the_server_allows():
    workers = Workers()
    with serving(workers, time_limit_s=5.0) as server:
        ask(server, "POST", "/locate?timeLimit=500", PNG)
    assert workers.asked[0].time_limit_s == 5.0


def test_a_chunked_body_is_read():
    with serving() as server:
        answer, _ = ask(server, "POST", "/locate", iter([PNG[:7], PNG[7:]]))
        assert answer.status == 200


def test_it_describes_itself_as_a_process_server():
    with serving() as server:
        for path in ("/", "/api", "/conformance", "/processes", "/processes/locate", "/jobs"):
            assert ask(server, "GET", path)[0].status == 200, path
        conforms = ask(server, "GET", "/conformance")[1]["conformsTo"]
        assert any("ogcapi-processes-1/1.0/conf/core" in one for one in conforms)
        links = ask(server, "GET", "/")[1]["links"]
        for link in links:
            assert ask(server, "GET", link["href"])[0].status == 200
        answer, found = ask(
            server, "POST", "/processes/locate/execution",
            json.dumps({"inputs": {"image": {"value": "iVBORw0KGgoAAAAA", "mediaType": "image/png"}}}),
        )  # fmt: skip
        assert (answer.status, found) == (200, {"location": FOUND})


@pytest.mark.parametrize(
    ("method", "path", "body", "headers", "status"),
    [
        ("GET", "/nonesuch", None, {}, 404),
        ("GET", "/locate", None, {}, 404),
        ("POST", "/processes", PNG, {}, 405),
        ("POST", "/nonesuch", PNG, {}, 404),
        ("POST", "/locate", b"<VRTDataset>", {}, 415),
        ("POST", "/locate?colour=red", PNG, {}, 400),
        ("POST", "/locate", bytes(2000), {}, 413),
        ("POST", "/locate", PNG, {"Content-Encoding": "gzip"}, 415),
        ("POST", "/locate", PNG, {"Host": "evil.example"}, 403),
        ("POST", "/locate", PNG, {"Origin": "https://evil.example"}, 403),
        ("POST", "/processes/locate/execution", b"{", {}, 400),
        ("DELETE", "/locate", None, {}, 501),
    ],
)
def test_what_is_wrong_is_said(method, path, body, headers, status):
    with serving(max_bytes=1000) as server:
        answer, document = ask(server, method, path, body, headers) if method != "DELETE" else (None, None)
        if answer is None:
            assert b" 501 " in send_raw(server, b"DELETE /locate HTTP/1.1\r\nHost: localhost\r\n\r\n", 1.0)[:40]
            return
        assert answer.status == status
        assert document["status"] == status
        assert document["detail"]


POST = b"POST /locate HTTP/1.1\r\nHost: localhost\r\n"


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (POST + b"\r\n", b" 411 "),
        (POST + b"Content-Length: -5\r\n\r\n", b" 411 "),
        (POST + b"Content-Length: 9\r\nContent-Length: 8\r\n\r\n", b" 400 "),
        (POST + b"Content-Length: 9\r\nTransfer-Encoding: chunked\r\n\r\n", b" 400 "),
        (POST + b"Transfer-Encoding: chunked\r\n\r\nxyz\r\n", b" 400 "),
        (POST + b"Transfer-Encoding: chunked\r\n\r\nfffff\r\n", b" 413 "),
        (POST + b"Transfer-Encoding: chunked\r\n\r\n3\r\nabcdef\r\n0\r\n\r\n", b" 400 "),
        (b"GET / HTTP/1.1\r\nHost: [::1\r\n\r\n", b" 403 "),
        (POST + b"Content-Length: 99999\r\nExpect: 100-continue\r\n\r\n", b" 413 "),
        (b"GET / HTTP/1.1\r\n" + b"".join(b"X-%d: 1\r\n" % k for k in range(200)) + b"\r\n", b" 431 "),
        (b"GET / HTTP/1.1\r\nX: " + b"a" * 70_000 + b"\r\n\r\n", b" 431 "),
        (b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", b" 414 "),
        (b"\0\xff\xfe nonsense\r\n\r\n", b" 400 "),
        (b"POST http://[/locate HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n", b" 400 "),
        (b"GET http://[/ HTTP/1.1\r\nHost: localhost\r\n\r\n", b" 400 "),
        (b"GET / HTTP/1.1\r\nHost: [\r\n\r\n", b" 403 "),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://[\r\n\r\n", b" 403 "),
        (b"POST /locate HTTP/1.1\r\nHost: evil.example\r\nContent-Length: \xb2\r\n\r\n", b" 403 "),
    ],
)
def test_heads_that_are_none_get_an_answer_and_the_next_is_served(head, status):
    with serving(max_bytes=1000, head_s=1.0, body_s=1.0) as server:
        assert status in send_raw(server, head, 3.0)[:60]
        assert ask(server, "GET", "/")[0].status == 200


def test_a_head_is_asked_for_alone():
    with serving() as server:
        (head, _), (whole, document) = (ask(server, method, "/processes") for method in ("HEAD", "GET"))
        assert head.status == 200
        assert head.headers["Content-Length"] == whole.headers["Content-Length"]
        assert document
        answer = send_raw(server, b"HEAD /processes HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n", 1.0)
        assert answer.endswith(b"\r\n\r\n")


def test_a_body_that_may_be_taken_is_asked_for():
    with serving() as server, socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as sock:
        sock.sendall(POST + b"Content-Length: %d\r\nExpect: 100-continue\r\n\r\n" % len(PNG))
        assert sock.recv(100).startswith(b"HTTP/1.1 100 ")
        sock.sendall(PNG)
        assert sock.recv(100).startswith(b"HTTP/1.1 200 ")


def test_a_body_that_ends_before_it_should_is_not_located():
    workers = Workers()
    with serving(workers) as server, socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as sock:
        sock.sendall(POST + b"Content-Length: %d\r\n\r\n" % len(PNG) + PNG[:-1])
        sock.shutdown(socket.SHUT_WR)
        answer = sock.makefile("rb").read()
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert b"the body ends before it should" in answer
    assert not workers.asked


def test_what_workers_refuse_is_a_problem():
    workers = Workers()
    workers.ask = lambda _: Answer(422, {"detail": "the image: no road in it"})
    with serving(workers) as server:
        answer, document = ask(server, "POST", "/locate", PNG)
    assert answer.status == document["status"] == 422
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert document["detail"] == "the image: no road in it"


def has_ipv6():
    with suppress(OSError), socket.create_server(("::1", 0), family=socket.AF_INET6):
        return True
    return False


@pytest.mark.skipif(not has_ipv6(), reason="no IPv6 here")
def test_it_listens_on_ipv6_too():
    with serving(host="::1") as server, socket.create_connection(("::1", server.server_port), timeout=5) as sock:
        sock.sendall(b"GET / HTTP/1.1\r\nHost: [::1]\r\n\r\n")
        assert sock.recv(100).startswith(b"HTTP/1.1 200 ")


def test_a_fault_is_told_and_logged_and_the_next_is_served(caplog):
    workers = Workers()
    workers.ask = lambda _: {}["nothing"]
    with serving(workers) as server:
        answer, document = ask(server, "POST", "/locate", PNG)
        assert (answer.status, document["status"]) == (500, 500)
        assert "KeyError" in caplog.text
        assert "POST /locate" in caplog.text
        assert ask(server, "GET", "/")[0].status == 200


def test_a_disk_that_is_full_is_no_fault(monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with serving() as server:
        monkeypatch.setattr("pathlib.Path.write_bytes", full)
        answer, document = ask(server, "POST", "/locate", PNG)
        assert (answer.status, answer.headers["Retry-After"]) == (503, "1")
        assert "No space left" in document["detail"]


def test_who_asked_gets_the_place_though_it_cannot_be_told_to_others():
    def told(*_):
        raise OSError("no autopilot")

    with serving(told=told) as server:
        assert ask(server, "POST", "/locate", PNG)[1] == FOUND


def test_an_answer_that_takes_too_long_says_when_to_come_again():
    workers = Workers()
    workers.ask = lambda _: Answer(503, {"detail": "it took longer than 25 s and was ended"})
    with serving(workers) as server:
        answer, document = ask(server, "POST", "/locate", PNG)
        assert (answer.status, answer.headers["Retry-After"]) == (503, "1")
        assert "25 s" in document["detail"]


def test_whoever_goes_while_sending_is_no_fault(caplog):
    with serving() as server:
        with socket.create_connection(("127.0.0.1", server.server_port)) as sock:
            sock.sendall(POST + b"Content-Length: 1000\r\n\r\nabc")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close with a reset
        assert ask(server, "GET", "/")[0].status == 200
    assert not caplog.records


def test_slow_senders_are_cut_off():
    with serving(head_s=0.3, body_s=0.3) as server:
        started = time.monotonic()
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as sock:
            sock.sendall(b"POST /locate HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\n")
            sock.settimeout(0.05)
            said = b""
            while not said and time.monotonic() - started < 4.0:
                with suppress(TimeoutError):
                    sock.sendall(b"x")
                    said = sock.recv(1000)
        assert b" 408 " in said[:40]
        assert time.monotonic() - started < 4.0


def test_who_comes_when_it_is_full_is_told_when_to_come_again():
    workers = Workers(places=1)
    workers.busy.clear()
    with serving(workers) as server:
        first = threading.Thread(target=ask, args=(server, "POST", "/locate", PNG))
        first.start()
        for _ in range(200):
            if workers.is_full():
                break
            time.sleep(0.01)
        answer, _ = ask(server, "POST", "/locate", PNG)
        assert answer.status == 503
        assert int(answer.headers["Retry-After"]) >= 1
        assert ask(server, "GET", "/")[0].status == 200
        workers.busy.set()
        first.join()
        assert ask(server, "POST", "/locate", PNG)[0].status == 200


def test_too_many_connections_are_refused_politely():
    with serving(connections=1) as server, socket.create_connection(("127.0.0.1", server.server_port)) as held:
        held.sendall(b"GET / HTTP/1.1\r\n")
        time.sleep(0.2)
        said = send_raw(server, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", 2.0)
        assert b" 503 " in said[:40]
        assert b"Retry-After" in said
        assert b"application/problem+json" in said
        assert json.loads(said.partition(b"\r\n\r\n")[2])["status"] == 503


def test_with_a_token_nobody_else_is_answered():
    with serving(token="open sesame") as server:
        for shown in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Bearer ü"}):
            answer, _ = ask(server, "GET", "/", headers={k: v.encode("latin-1") for k, v in shown.items()})
            assert answer.status == 401
        right = {"Authorization": "Bearer open sesame", "Host": "elsewhere.example"}
        assert ask(server, "POST", "/locate", PNG, right)[0].status == 200


def test_it_listens_on_loopback_only():
    assert ServeOptions().host == "127.0.0.1"
    with serving() as server:
        assert server.server_address[0] == "127.0.0.1"
