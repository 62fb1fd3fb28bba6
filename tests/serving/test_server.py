"""The server over real sockets, with workers that answer at once, slowly, or not."""

import asyncio
import errno
import gzip
import http.client
import json
import os
import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from urllib.parse import urljoin

import cv2
import numpy as np
import pytest
from starlette.exceptions import HTTPException

from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Content, Location
from roadgeo.reference.reference import Reference
from roadgeo.running.passes import Sighting
from roadgeo.serving.app import Service
from roadgeo.serving.options import ServeOptions
from roadgeo.serving.server import Server
from roadgeo.serving.workers import Reply, _reply
from roadgeo.sources.segmentation.probability import ProbabilityMap

PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)
REFUSED = Location("photo.png", "not_located", "hardly a road", content=Content((60, 40)))
SEEN_ROADS = ProbabilityMap(np.full((40, 60), 9, np.uint8))
FOUND = {"schema": "roadgeo.location/1", "status": "located", "center": {"lon": 1.0, "lat": 2.0}}


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """Uvicorn looks every 0.1 s whether it should end, and gives connections as long to close: here a tenth of that."""
    swift = SimpleNamespace(**{**vars(asyncio), "sleep": lambda seconds: asyncio.sleep(seconds / 10)})
    monkeypatch.setattr("uvicorn.server.asyncio", swift)
    monkeypatch.setattr("roadgeo.serving.guard._GUESS_S", 0.1)


class Workers:
    """Stands for processes: it keeps what it was asked."""

    def __init__(self, places=4):
        self.asked, self.places, self.goes_on = [], threading.Semaphore(places), threading.Event()
        self.goes_on.set()
        self._temporary = TemporaryDirectory(prefix="roadgeo-")
        self.folder = Path(self._temporary.name)

    def take_place(self):
        if not self.places.acquire(blocking=False):
            raise HTTPException(503, "full; come again")
        place = ExitStack()
        place.callback(self.places.release)
        return place

    def ask(self, asked, say=None, called_off=None):
        if asked.keeps:
            say("finding roads", 0.5)
        while not self.goes_on.wait(0.02) and not called_off.is_set():
            pass
        self.asked.append(asked)
        return Reply(200, {**FOUND, "query": asked.name} if asked.name else FOUND)

    def close(self):
        self._temporary.cleanup()


def serving(workers=None, listener=None, **options):
    options = ServeOptions(port=0, **options)
    return running(Server(Service(workers or Workers(), [SimpleNamespace(name="town")], options, listener)))


@contextmanager
def running(server):
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.close()


def get(server, path, headers=None, method="GET", body=None):
    with closing(http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)) as connection:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        return answer, answer.read()


def ask(server, method, path, body=None, headers=None):
    answer, content = get(server, path, headers, method, body)
    return answer, json.loads(content) if content else None


def wait_until(happens):
    for _ in range(300):
        if found := happens():
            return found
        time.sleep(0.02)
    raise AssertionError("it has not happened")


def send_raw(server, data, wait_s=5.0, quiet_s=0.4):
    """All that is answered, until nothing more comes for a while."""
    answer = b""
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=wait_s) as sock:
        sock.sendall(data)
        with suppress(TimeoutError, ConnectionResetError):
            while part := sock.recv(65536):
                answer += part
                sock.settimeout(quiet_s)
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


@pytest.mark.parametrize(
    ("method", "path", "body", "headers", "status"),
    [
        ("GET", "/nonesuch", None, {}, 404),
        ("GET", "/locate", None, {}, 405),
        ("POST", "/health", PNG, {}, 405),
        ("GET", "/health/", None, {}, 404),
        ("GET", f"/tiles/0/1/1/{'9' * 5000}.mvt", None, {}, 404),
        ("GET", "/tiles/0/1/1/x.mvt", None, {}, 404),
        ("POST", "/nonesuch", PNG, {}, 404),
        ("POST", "/locate", b"<VRTDataset>", {}, 415),
        ("POST", "/locate?colour=red", PNG, {}, 400),
        ("POST", "/locate", bytes(2000), {}, 413),
        ("POST", "/locate", gzip.compress(PNG, mtime=0), {"Content-Encoding": "gzip"}, 415),
        ("POST", "/locate", PNG, {"Host": "evil.example"}, 403),
        ("POST", "/locate", PNG, {"Origin": "https://evil.example"}, 403),
        ("POST", "/locate", PNG, {"Origin": "http://127.0.0.1:3000"}, 403),
        ("POST", "/locate", PNG, {"Origin": "null"}, 403),
        ("DELETE", "/locate", None, {}, 405),
    ],
)
def test_what_is_wrong_is_said(method, path, body, headers, status):
    with serving(max_bytes=1000) as server:
        answer, document = ask(server, method, path, body, headers)
        assert answer.status == status
        assert document["status"] == status
        assert document["detail"]


def test_an_origin_is_of_the_scheme_too():
    with serving() as server:
        for scheme, status in (("http", 200), ("https", 403), ("ftp", 403)):
            origin = {"Origin": f"{scheme}://127.0.0.1:{server.server_port}"}
            assert ask(server, "POST", "/locate", PNG, origin)[0].status == status


def test_guesses_at_the_token_are_answered_one_after_another(monkeypatch):
    monkeypatch.setattr("roadgeo.serving.guard._GUESS_S", 0.25)
    with serving(token="open sesame") as server, ThreadPoolExecutor(4) as threads:
        started = time.monotonic()
        guesses = [threads.submit(ask, server, "POST", "/session", b"guess") for _ in range(4)]
        assert ask(server, "POST", "/session", b"open sesame")[0].status == 200
        assert time.monotonic() - started < 0.75
        assert {guess.result()[0].status for guess in guesses} == {401}
        assert time.monotonic() - started > 0.95


GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
POST = b"POST /locate HTTP/1.1\r\nHost: localhost\r\n"


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (POST + b"\r\n", b" 415 "),
        (POST + b"Content-Length: -5\r\n\r\n", b" 400 "),
        (POST + b"Content-Length: 9\r\nContent-Length: 8\r\n\r\n", b" 400 "),
        (POST + b"Transfer-Encoding: chunked\r\n\r\nxyz\r\n", b" 400 "),
        (POST + b"Transfer-Encoding: chunked\r\n\r\nfffff\r\n" + bytes(1001), b" 413 "),
        (POST + b"Transfer-Encoding: chunked\r\n\r\nfffff\r\n", b" 408 "),
        (POST + b"Content-Length: 99999\r\nExpect: 100-continue\r\n\r\n", b" 413 "),
        (b"GET / HTTP/1.1\r\n\r\n", b" 400 "),
        (b"GET / HTTP/1.1\r\nHost: [::1\r\n\r\n", b" 403 "),
        (b"GET / HTTP/1.1\r\nHost: [\r\n\r\n", b" 403 "),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://[\r\n\r\n", b" 403 "),
        (GET + b"X: " + b"a" * 70_000, b" 400 "),
        (b"GET /" + b"a" * 400_000, b" 400 "),
        (b"\0\xff\xfe nonsense\r\n\r\n", b" 400 "),
        (b"GET http://[/ HTTP/1.1\r\nHost: localhost\r\n\r\n", b" 404 "),
    ],
)
def test_heads_that_are_none_get_an_answer_and_the_next_is_served(head, status):
    with serving(max_bytes=1000, body_s=0.5) as server:
        assert status in send_raw(server, head, 3.0, quiet_s=0.02)[:60]
        assert ask(server, "GET", "/health")[0].status == 200


def test_a_head_is_asked_for_alone():
    with serving() as server:
        (head, _), (whole, document) = (ask(server, method, "/health") for method in ("HEAD", "GET"))
        assert head.status == 200
        assert head.headers["Content-Length"] == whole.headers["Content-Length"]
        assert document
        answer = send_raw(server, b"HEAD /health HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n", 1.0)
        assert answer.endswith(b"\r\n\r\n")


def test_a_body_that_may_be_taken_is_asked_for():
    with serving() as server, socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as sock:
        sock.sendall(POST + b"Content-Length: %d\r\nExpect: 100-continue\r\n\r\n" % len(PNG))
        assert sock.recv(100).startswith(b"HTTP/1.1 100 ")
        sock.sendall(PNG)
        assert sock.recv(100).startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize(
    ("status", "detail", "again"),
    [(422, "the image: no road in it", None), (503, "it took longer than 25 s and was ended", "1")],
)
def test_what_workers_refuse_is_a_problem(status, detail, again):
    workers = Workers()
    workers.ask = lambda *_: Reply(status, {"detail": detail})
    with serving(workers) as server:
        answer, document = ask(server, "POST", "/locate", PNG)
    assert answer.status == document["status"] == status
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert (document["detail"], answer.headers["Retry-After"]) == (detail, again)


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
    workers.ask = lambda *_: {}["nothing"]
    with serving(workers) as server:
        answer, document = ask(server, "POST", "/locate", PNG)
        assert (answer.status, document["status"]) == (500, 500)
        wait_until(lambda: "KeyError" in caplog.text)  # it is logged once the answer is sent
        assert ask(server, "GET", "/health")[0].status == 200


def fill(monkeypatch, folders):
    """Let the disk of the server be full as long as it holds so many folders."""
    make = Path.mkdir

    def mkdir(path, *args, **kwargs):
        if path.parent.name.startswith("roadgeo-") and len(list(path.parent.iterdir())) >= folders:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        make(path, *args, **kwargs)

    monkeypatch.setattr("pathlib.Path.mkdir", mkdir)


def test_a_disk_that_is_full_is_no_fault(monkeypatch):
    with serving() as server:
        fill(monkeypatch, 0)
        answer, document = ask(server, "POST", "/locate", PNG)
        assert (answer.status, answer.headers["Retry-After"]) == (503, "1")
        assert "No space left" in document["detail"]


def test_a_disk_that_is_full_keeps_nobody_out_for_ever(monkeypatch):
    with serving() as server:
        fill(monkeypatch, 2)
        jobs = [finished(server) for _ in range(2)]
        assert [ask(server, "POST", "/locate", PNG)[0].status for _ in range(2)] == [503, 200]
        assert [ask(server, "GET", f"/jobs/{job}")[0].status for job in jobs] == [404, 200]


def test_an_answer_without_its_view_is_kept_and_makes_room():
    workers = Workers()
    with serving(workers) as server:
        old = finished(server)
        workers.ask = lambda *_: Reply(200, FOUND, lacks_view=True)
        job = finished(server)
        assert ask(server, "GET", f"/jobs/{job}/results")[1] == {"location": FOUND}
        assert ask(server, "GET", f"/jobs/{old}")[0].status == 404


def test_who_asked_gets_the_place_though_it_cannot_be_reported_to_others():
    def fail(*_):
        raise OSError("no autopilot")

    with serving(listener=fail) as server:
        assert ask(server, "POST", "/locate", PNG)[1] == FOUND


def test_whoever_goes_while_sending_is_no_fault(caplog):
    with serving() as server:
        with socket.create_connection(("127.0.0.1", server.server_port)) as sock:
            sock.sendall(POST + b"Content-Length: 1000\r\n\r\nabc")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close with a reset
        assert ask(server, "GET", "/health")[0].status == 200
    assert not caplog.records


def test_slow_senders_are_cut_off():
    with serving(body_s=0.3) as server:
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
    workers.goes_on.clear()
    with serving(workers) as server:
        first = threading.Thread(target=ask, args=(server, "POST", "/locate", PNG))
        first.start()
        wait_until(lambda: not workers.places._value)
        answer, _ = ask(server, "POST", "/locate", PNG)
        assert answer.status == 503
        assert int(answer.headers["Retry-After"]) >= 1
        assert ask(server, "GET", "/health")[0].status == 200
        workers.goes_on.set()
        first.join()
        assert ask(server, "POST", "/locate", PNG)[0].status == 200


def test_with_a_token_nobody_else_is_answered():
    with serving(token="open sesame") as server:
        for shown in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Bearer ü"}):
            answer, _ = ask(server, "GET", "/references", headers={k: v.encode("latin-1") for k, v in shown.items()})
            assert answer.status == 401
        right = {"Authorization": "Bearer open sesame", "Host": "elsewhere.example"}
        assert ask(server, "POST", "/locate", PNG, right)[0].status == 200


@pytest.mark.parametrize("coding", ["utf-8", "latin-1"])
@pytest.mark.parametrize("scheme", ["Bearer", "bearer", "BEARER"])
def test_tokens_may_hold_any_letters(coding, scheme):
    with serving(token="schlüssel") as server:
        shown = {"Authorization": f"{scheme} schlüssel".encode(coding)}
        assert ask(server, "GET", "/jobs/x", headers=shown)[0].status == 404


def test_who_waits_while_the_server_ends_is_told():
    workers, ended, answers = Workers(), threading.Event(), []

    def ask_until_end(*_):
        ended.wait(10.0)
        return Reply(503, {"detail": "the server is ending; come again"})

    close = workers.close
    workers.ask, workers.close = ask_until_end, lambda: (ended.set(), close())
    with serving(workers) as server:
        asking = threading.Thread(target=lambda: answers.append(ask(server, "POST", "/locate", PNG)))
        asking.start()
        wait_until(lambda: workers.places._value < 4)
        time.sleep(0.1)
        server.shutdown()
        asking.join(10.0)
    assert [answer.status for answer, _ in answers] == [503]


def test_it_listens_on_loopback_only():
    assert ServeOptions().host == "127.0.0.1"
    with serving() as server:
        assert server.server_address[0] == "127.0.0.1"


# --- bodies that nobody asked for -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "path"), [(b"GET", b"/health"), (b"HEAD", b"/nonesuch"), (b"DELETE", b"/jobs/none/events")]
)
@pytest.mark.parametrize("coding", ["length", "chunked"])
def test_a_body_is_never_read_as_the_next_request(method, path, coding):
    hidden = b"GET /health HTTP/1.1\r\nHost: localhost\r\nX-Hidden: yes\r\n\r\n"
    framed = b"%x\r\n%b\r\n0\r\n\r\n" % (len(hidden), hidden)
    reported = b"Transfer-Encoding: chunked" if coding == "chunked" else b"Content-Length: %d" % len(hidden)
    head = b"%b %b HTTP/1.1\r\nHost: localhost\r\n%b\r\n\r\n" % (method, path, reported)
    with serving() as server:
        answer = send_raw(server, head + (framed if coding == "chunked" else hidden))
    assert answer.count(b"HTTP/1.1 ") == 1
    assert b"version" not in answer or path == b"/health"


def test_the_next_request_is_answered_after_a_body_that_nobody_read():
    first = b"GET /health HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nabcde"
    last = b"GET /health HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    with serving() as server:
        answer = send_raw(server, first + last)
    assert answer.count(b"HTTP/1.1 200 ") == 2
    assert answer.endswith(b"}")


def test_bodies_that_drip_hold_no_place():
    workers = Workers(places=1)
    with serving(workers) as server, ExitStack() as open_ones:
        for _ in range(9):
            sock = open_ones.enter_context(socket.create_connection(("127.0.0.1", server.server_port), timeout=5))
            sock.sendall(POST + b"Content-Length: 1000\r\n\r\nabc")
        time.sleep(0.3)
        assert ask(server, "POST", "/locate", PNG)[0].status == 200


def test_more_connections_than_may_be_open_are_asked_to_come_again():
    with serving(connections=2) as server, socket.create_connection(("127.0.0.1", server.server_port)):
        time.sleep(0.2)
        assert b" 503 " in send_raw(server, GET + b"\r\n", 2.0)[:40]


# --- forms, jobs, health ----------------------------------------------------------------------------------------------


def form(*parts):
    """The body of a form, and its headers."""
    lines = []
    for disposition, content in parts:
        lines += [b"--sep", b"Content-Disposition: form-data; " + disposition, b"", content]
    return b"\r\n".join([*lines, b"--sep--", b""]), {"Content-Type": "multipart/form-data; boundary=sep"}


def test_a_form_is_taken():
    workers = Workers()
    body = form((b'name="gsd"', b"0.5,1"), (b'name="image"; filename="../a/photo.png"', PNG), (b'name="northUp"', b""))
    with serving(workers) as server:
        answer, found = ask(server, "POST", "/locate?timeLimit=2", *body)
    assert (answer.status, found["status"]) == (200, "located")
    assert workers.asked[0].hints == {"gsd_m": (0.5, 1.0), "north_up": True}
    assert (workers.asked[0].time_limit_s, workers.asked[0].name) == (2.0, "photo.png")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of a torn form the file is not closed
@pytest.mark.parametrize(
    ("parts", "status"),
    [
        ([(b'name="gsd"', b"1,2")], 400),
        ([(b'name="image"', PNG)], 400),
        ([(b'name="image"; filename="a.png"', b"<html>")], 415),
        ([(b'name="image"; filename="a.png"', PNG)] * 2, 400),
        ([(b'name="colour"', b"red"), (b'name="image"; filename="a.png"', PNG)], 400),
        ([(b'name="gsd"', b"9" * 5000), (b'name="image"; filename="a.png"', PNG)], 400),
        ([(b'name="image"; filename="a.png"', PNG + bytes(9000))], 413),
        ([(b'name="a%d"' % k, b"1") for k in range(60)], 400),
    ],
)
def test_other_forms_are_refused(parts, status):
    with serving(max_bytes=8000) as server:
        answer, document = ask(server, "POST", "/locate", *form(*parts))
        assert (answer.status, document["status"]) == (status, status)
        torn, headers = form(*parts)
        assert ask(server, "POST", "/locate", torn[: len(torn) // 2], headers)[0].status in (400, 413)
        assert ask(server, "POST", "/locate", torn, {"Content-Type": "multipart/form-data"})[0].status in (400, 413)


def test_it_says_that_it_lives():
    with serving(token="open sesame") as server:
        answer, document = ask(server, "GET", "/health")
    assert (answer.status, document["status"]) == (200, "ok")


LATER = {"Prefer": "respond-async"}


def wait_for(server, job, *states):
    return wait_until(
        lambda: (document := ask(server, "GET", f"/jobs/{job}")[1]) and document["status"] in states and document
    )


def finished(server, body=PNG, headers=LATER):
    """Send an image, and return its job once that is done."""
    job = ask(server, "POST", "/locate", body, headers)[1]["jobID"]
    wait_for(server, job, "successful")
    return job


def test_who_prefers_not_to_wait_gets_a_job():
    workers = Workers()
    workers.goes_on.clear()
    with serving(workers) as server:
        answer, job = ask(server, "POST", "/locate?gsd=1,2", PNG, LATER)
        assert answer.status == 201
        assert urljoin("/at/locate", answer.headers["Location"]) == f"/at/jobs/{job['jobID']}"
        reported = wait_for(server, job["jobID"], "running")
        assert (reported["message"], reported["progress"]) == ("finding roads", 50)
        assert ask(server, "GET", f"/jobs/{job['jobID']}/results")[0].status == 404
        workers.goes_on.set()
        assert wait_for(server, job["jobID"], "successful")["progress"] == 100
        assert ask(server, "GET", f"/jobs/{job['jobID']}/results")[1] == {"location": FOUND}
        assert ask(server, "GET", "/jobs")[0].status == 404


def test_progress_is_told_as_it_is_made_and_again_where_nothing_happens(monkeypatch):
    monkeypatch.setattr("roadgeo.serving.jobs._PULSE_S", 0.05)
    workers = Workers()
    workers.goes_on.clear()
    with serving(workers) as server:
        job = ask(server, "POST", "/locate", PNG, LATER)[1]["jobID"]
        connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
        connection.request("GET", f"/jobs/{job}/events")
        answer = connection.getresponse()
        assert answer.headers["Content-Type"].startswith("text/event-stream")
        states, output = [], answer.readline()
        while output:
            if output.startswith(b"data: "):
                states.append(json.loads(output[6:])["status"])
                if states[-3:] == ["running"] * 3:
                    workers.goes_on.set()
            output = answer.readline()
        connection.close()
    assert states[-1] == "successful"
    assert states.count("successful") == 1


def test_a_job_that_fails_says_why():
    workers = Workers()
    workers.ask = lambda *_: Reply(422, {"detail": "the image: no road in it"})
    with serving(workers) as server:
        job = ask(server, "POST", "/locate", PNG, LATER)[1]["jobID"]
        assert wait_for(server, job, "failed")["message"] == "the image: no road in it"
        answer, document = ask(server, "GET", f"/jobs/{job}/results")
        assert (answer.status, document["detail"]) == (422, "the image: no road in it")
        assert not list(server._service.workers.folder.iterdir())  # of what failed nothing is kept on disk


def test_a_job_is_called_off_and_forgotten():
    workers = Workers(places=1)
    workers.goes_on.clear()
    with serving(workers) as server:
        job = ask(server, "POST", "/locate", PNG, LATER)[1]["jobID"]
        assert ask(server, "POST", "/locate", PNG)[0].status == 503
        wait_for(server, job, "running")
        called_off = ask(server, "DELETE", f"/jobs/{job}")[1]
        assert (called_off["status"], called_off["progress"]) == ("dismissed", 50)
        assert ask(server, "GET", f"/jobs/{job}")[0].status == 404
        wait_until(lambda: workers.places._value)
        workers.goes_on.set()
        assert ask(server, "POST", "/locate", PNG)[0].status == 200
        assert not list(server._service.workers.folder.iterdir())


def test_the_latest_answers_are_kept():
    with serving(kept_jobs=2) as server:
        jobs = [finished(server) for _ in range(4)]
        there = [ask(server, "GET", f"/jobs/{job}")[0].status for job in jobs]
        assert there == [404, 404, 200, 200]
        assert len(list(server._service.workers.folder.iterdir())) == 2


def test_nothing_of_a_request_is_kept():
    with serving() as server:
        for body in (PNG, b"no image", PNG + bytes(100_000)):
            ask(server, "POST", "/locate", body)
        assert not list(server._service.workers.folder.iterdir())


def test_other_sites_get_nothing():
    with serving() as server:
        answer, _ = ask(server, "GET", "/health")
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]


# --- the page ---------------------------------------------------------------------------------------------------------

HTML = {"Accept": "text/html,*/*"}


def test_the_page_runs_no_script_but_its_own():
    with serving() as server:
        answer, content = get(server, "/", HTML)
        assert answer.headers["Content-Type"].startswith("text/html")
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert b"<script>" not in content
        assert b"style=" not in content
        for name in ("page.mjs", "map.mjs", "points.mjs", "page.css", "maplibre-gl.mjs", "maplibre-gl-worker.mjs"):
            answer, content = get(server, f"/page/{name}")
            assert (answer.status, bool(content)) == (200, True)
            assert answer.headers["Content-Type"].split(";")[0] in ("text/javascript", "text/css")


@pytest.mark.parametrize("name", ["LICENSE.txt", "__init__.py", "..%2fapp.py", "%2e%2e%2fapp.py", "maplibre", ""])
def test_nothing_else_lies_beside_the_page(name):
    with serving() as server:
        assert get(server, f"/page/{name}")[0].status == 404


def test_the_page_asks_for_the_token_and_takes_it_once():
    with serving(token="open sesame") as server:
        assert get(server, "/", HTML)[0].status == 200
        assert get(server, "/references", HTML)[0].status == 401
        assert ask(server, "POST", "/session", b"guess")[0].status == 401
        assert ask(server, "POST", "/session", b"x" * 5000)[0].status == 413
        assert ask(server, "POST", "/session", b"open sesame", {"Origin": "https://evil.example"})[0].status == 403
        answer, _ = ask(server, "POST", "/session", b"open sesame")
        cookie = answer.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        shown = {"Cookie": cookie.split(";")[0]}
        assert ask(server, "GET", "/jobs/x", headers=shown)[0].status == 404
        for wrong in ("roadgeo=", "roadgeo=open sesame", "roadgeo=0", "a" * 300, 'roadgeo="'):
            assert ask(server, "GET", "/jobs/x", headers={"Cookie": wrong})[0].status == 401


def test_an_image_is_searched_again_with_other_hints():
    workers = Workers()
    with serving(workers) as server:
        body, headers = form((b'name="image"; filename="a.png"', PNG))
        first = finished(server, body, {**headers, **LATER})
        answer, job = ask(server, "POST", f"/jobs/{first}/again?near=1,2,300", b"")
        assert answer.status == 201
        assert urljoin(f"/at/jobs/{first}/again", answer.headers["Location"]) == f"/at/jobs/{job['jobID']}"
        wait_for(server, job["jobID"], "successful")
        assert workers.asked[-1].hints == {"near": (1.0, 2.0, 300.0)}
        assert workers.asked[-1].name == "a.png"
        ask(server, "DELETE", f"/jobs/{first}")
        assert Path(workers.asked[-1].path).read_bytes() == PNG
        assert ask(server, "POST", f"/jobs/{first}/again", b"")[0].status == 404
        assert ask(server, "POST", f"/jobs/{job['jobID']}/again?colour=red", b"")[0].status == 400


@pytest.mark.parametrize("name", ["picture.jpg", "seen.tif", "warped.webp", "view.json.png"])
def test_an_image_stays_as_it_was_sent_whatever_it_is_called(name, town, monkeypatch):
    def locate_query(path, *_, **__):
        return Sighting(REFUSED, RoadMask(np.zeros((40, 60), bool)), probability=SEEN_ROADS).showing(kind="photograph")

    monkeypatch.setattr("roadgeo.running.queries.locate_query", locate_query)
    network, index = town
    workers, references = Workers(), [Reference(index, network)]
    workers.ask = lambda asked, *_: workers.asked.append(asked) or _reply(asked, references)
    image = cv2.imencode(Path(name).suffix, np.full((40, 60, 3), 99, np.uint8))[1].tobytes()
    body, headers = form((b'name="image"; filename="%b"' % name.encode(), image))
    with serving(workers) as server:
        first = finished(server, body, {**headers, **LATER})
        again = ask(server, "POST", f"/jobs/{first}/again", b"")[1]["jobID"]
        wait_for(server, again, "successful")
        assert [Path(asked.path).read_bytes() == image for asked in workers.asked] == [True, True]
        assert get(server, f"/jobs/{again}/picture.jpg")[1][:2] == b"\xff\xd8"


def test_the_host_chooses_no_file():
    workers = Workers()
    with serving(workers) as server:
        job = finished(server)
        own = Path(workers.asked[0].path).parent.with_name("own")
        own.mkdir()
        (own / "kept.pickle.gz").write_bytes(b"ours")
        for host in ("localhost/kept.pickle.gz?", "localhost/kept.pickle.gz#", "localhost"):
            assert b"ours" not in get(server, f"/jobs/{job}/view.json", {"Host": host})[1]


def test_only_files_that_are_offered_may_be_had():
    workers = Workers()
    with serving(workers) as server:
        job = finished(server)
        offered = [item["name"] for item in ask(server, "GET", f"/jobs/{job}/files")[1]["files"]]
        assert {"json", "footprint", "report"} <= set(offered)
        assert "vrt" not in offered
        for name in ("nonesuch", "vrt", "..%2f..%2fetc%2fpasswd", "kept.pickle.gz", "image.png"):
            assert get(server, f"/jobs/{job}/files/{name}")[0].status == 404
        for name in ("picture.jpg", "view.json", "kept.pickle.gz"):
            assert get(server, f"/jobs/{job}/{name}")[0].status == 404


@pytest.mark.parametrize(
    "name", ["../../x.png", "..\\..\\x.png", "/etc/passwd", ".htaccess", "a" * 400 + ".png", "\u202egnp.x"]
)
def test_names_of_senders_lead_nowhere(name):
    workers = Workers()
    body, headers = form((b'name="image"; filename="%b"' % name.encode(), PNG))
    with serving(workers) as server:
        assert ask(server, "POST", "/locate", body, headers)[0].status == 200
        assert Path(workers.asked[0].path).parents[2] == server._service.workers.folder
        assert len(Path(workers.asked[0].path).name) < 60
