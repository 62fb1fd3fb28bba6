"""Shards in a store: fetched when they are searched, once, checked, and kept."""

import contextlib
import functools
import http.server
import shutil

import pytest
from support.loopback import serving
from worlds.scenes import random_network

from roadgeo.errors import IndexFormatError
from roadgeo.location import Location
from roadgeo.matching.index import build_index
from roadgeo.reference import remote
from roadgeo.reference.files import reference_digest
from roadgeo.reference.library import resolve_reference
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference, open_whole
from roadgeo.reference.shards import Manifest, ShardEntry, write_manifest
from roadgeo.roads.network import as_stored

fsspec = pytest.importorskip("fsspec")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with a manifest and one shard."""
    folder = tmp_path_factory.mktemp("built") / "town.shards"
    (folder / "00ff").mkdir(parents=True)
    network = as_stored(random_network(1, 1500.0))
    reference = Reference(build_index(network), network)
    reference.save(folder / "00ff" / "a.gpkg")
    index, digest = reference.index, reference_digest(folder / "00ff" / "a.gpkg")
    size = sum(file.stat().st_size for file in (folder / "00ff").iterdir())
    entry = ShardEntry(
        "a", (-180, -90, 180, 90), (-180, -90, 180, 90), index.plane.crs, len(index), len(index), 1.0, size, digest
    )
    write_manifest(folder, Manifest("town", "00ff", index.plane.crs, 3000.0, {}, (entry,)))
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def in_memory(built, monkeypatch):
    monkeypatch.setattr(remote, "_PROTOCOLS", (*remote._PROTOCOLS, "memory"))
    files = fsspec.filesystem("memory")
    files.put(str(built), "/bucket/town.shards", recursive=True)
    yield files
    files.rm("/bucket", recursive=True)


URL = "memory://bucket/town.shards"


def test_a_shard_is_fetched_once_when_it_is_opened(in_memory, built, cache):
    reference = open_reference(URL)
    assert not list(cache.rglob("*.index"))
    index = reference.parts[0].open()
    assert len(index) == len(open_reference(built).parts[0].open())
    in_memory.rm("/bucket/town.shards/00ff", recursive=True)
    assert len(open_reference(f"{URL}/manifest.json").parts[0].open()) == len(index)
    assert len(list(cache.rglob("*.index"))) == 1
    assert not list(cache.rglob("*.tmp"))
    assert reference.index_of(Location("q", "not_located", "")) is index


def test_a_name_that_is_a_url_resolves_to_what_stands_for_it(in_memory):
    folder = resolve_reference(URL)
    assert folder.name.endswith("town.shards")
    assert open_reference(folder).parts[0].open().name == "town 1"


def test_what_was_damaged_here_is_fetched_again(in_memory, cache):
    open_reference(URL).parts[0].open()
    (index,) = cache.rglob("*.index")
    index.write_bytes(index.read_bytes()[:-100])
    assert len(open_reference(URL).parts[0].open()) > 90


def test_another_shard_in_its_place_is_refused(in_memory, built, tmp_path):
    network = as_stored(random_network(2, 1500.0))
    Reference(build_index(network), network).save(tmp_path / "other.gpkg")
    in_memory.put(str(tmp_path / "other.index"), "/bucket/town.shards/00ff/a.index")
    with pytest.raises(IndexFormatError, match="not the shard that the manifest names"):
        open_reference(URL).parts[0].open()


@pytest.mark.parametrize("kind", ["index", "gpkg"])
def test_another_shard_that_takes_its_place_while_it_is_opened_is_refused(built, tmp_path, monkeypatch, kind):
    shutil.copytree(built, tmp_path / "town.shards")
    network = as_stored(random_network(2, 1500.0))
    Reference(build_index(network), network).save(tmp_path / "a.gpkg")
    shard = open_reference(tmp_path / "town.shards").parts[0]

    def swap(path):
        for ending in ("gpkg", "index"):
            shard.path.with_suffix(f".{ending}").unlink()
        shutil.copy(tmp_path / f"a.{kind}", shard.path.with_suffix(f".{kind}"))
        return open_whole(path)

    monkeypatch.setattr("roadgeo.reference.reference.open_whole", swap)
    with pytest.raises(IndexFormatError, match="not the shard that the manifest names"):
        shard.open()


@pytest.mark.parametrize("tells", [True, False])
def test_no_more_is_fetched_than_the_manifest_tells(built, tmp_path, cache, tells):
    shutil.copytree(built, tmp_path / "www" / "town.shards")
    size = sum(file.stat().st_size for file in (built / "00ff").iterdir())

    class Endless(_Quiet):
        def do_GET(self):
            if not self.path.endswith(".index"):
                super().do_GET()
                return
            self.send_response(200)
            if tells:
                self.send_header("Content-Length", str(1 << 40))
            self.end_headers()
            with contextlib.suppress(OSError):
                for _ in range(1 << 10):
                    self.wfile.write(bytes(1 << 20))

    refused = pytest.raises(IndexFormatError, match=r"is larger than the [0-9,]+ bytes in the manifest")
    with _serving(functools.partial(Endless, directory=str(tmp_path / "www"))) as port, refused:
        open_reference(f"http://127.0.0.1:{port}/town.shards").parts[0].open()
    assert sum(file.stat().st_size for file in cache.rglob("*") if file.is_file()) < size


def test_what_is_not_there_is_an_error_on_one_line(in_memory, cache):
    with pytest.raises(IndexFormatError, match="cannot be fetched") as error:
        open_reference("memory://bucket/none.shards")
    assert "\n" not in str(error.value)
    assert not list(cache.rglob("manifest.json"))


@pytest.mark.parametrize(
    "url",
    [
        "nothing://at/all",
        "file:///etc/town.shards",
        "reference://town.shards",
        "simplecache::https://host/town.shards",
        "https://host/town.zip::reference://town.shards",
        "github://someone:town@main/town.shards",
    ],
)
def test_other_protocols_are_refused_before_they_are_asked(url, cache, monkeypatch):
    monkeypatch.setattr(fsspec, "filesystem", lambda *_, **__: pytest.fail("asked"))
    with pytest.raises(IndexFormatError, match="expected a folder of shards at https, http, s3, gs or az"):
        open_reference(url)
    assert not list(cache.rglob("manifest.json"))


def test_a_folder_of_a_stranger_has_nothing_fetched(in_memory, built, tmp_path):
    theirs = tmp_path / "town.shards"
    theirs.mkdir()
    shutil.copy(built / "manifest.json", theirs)
    (theirs / "source.txt").write_text(URL)
    with pytest.raises(IndexFormatError, match="no reference"):
        open_reference(theirs).parts[0].open()
    assert not list(theirs.rglob("*.index"))


def test_a_web_server_will_do(built, tmp_path):
    shutil.copytree(built, tmp_path / "www" / "town.shards")
    with _serving(functools.partial(_Quiet, directory=str(tmp_path / "www"))) as port:
        assert len(open_reference(f"http://127.0.0.1:{port}/town.shards").parts[0].open()) > 90


def test_a_redirect_within_a_server_is_followed_and_none_to_another(built, tmp_path):
    shutil.copytree(built, tmp_path / "www" / "town.shards")
    asked = []

    class Redirecting(_Quiet):
        def do_GET(self):
            asked.append(self.path)
            if not self.path.startswith(("/moved", "/elsewhere")):
                super().do_GET()
                return
            self.send_response(302)
            host = "127.0.0.1" if self.path.startswith("/moved") else "localhost"
            self.send_header("Location", f"http://{host}:{self.server.server_port}/town.shards/manifest.json")
            self.end_headers()

    with _serving(functools.partial(Redirecting, directory=str(tmp_path / "www"))) as port:
        assert open_reference(f"http://127.0.0.1:{port}/moved").name == "town"
        asked.clear()
        with pytest.raises(IndexFormatError, match=r"redirected to http://localhost.*expected https"):
            open_reference(f"http://127.0.0.1:{port}/elsewhere")
        assert asked == ["/elsewhere/manifest.json"]


@contextlib.contextmanager
def _serving(handler):
    """Serve on this machine; yield the port."""
    pytest.importorskip("aiohttp")
    with serving(handler) as server:
        yield server.server_port


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass
