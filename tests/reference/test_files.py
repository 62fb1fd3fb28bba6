import errno
import json
import os
import random
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference.test_network_file import editing
from worlds.networks import IndexParts, grid_network, parts, two_networks

from roadgeo.errors import IndexFormatError, OutputError
from roadgeo.reference import plain_values
from roadgeo.reference.files import (
    open_reference,
    rebuild_index,
    reference_digest,
    reference_freshness,
    reference_paths,
    write_reference,
)
from roadgeo.reference.index_file import FORMAT_VERSION, read_manifest
from roadgeo.reference.inspection import check_reference, describe_reference
from roadgeo.reference.network_file import network_digest, read_network, write_network
from roadgeo.roads.network import RoadNetwork, as_stored


def never(network: RoadNetwork) -> IndexParts:
    """Build nothing: where nothing may be built."""
    raise AssertionError("built again")


@pytest.fixture
def network() -> RoadNetwork:
    return as_stored(grid_network())


@pytest.fixture
def path(tmp_path: Path, network: RoadNetwork) -> Path:
    return write_reference(tmp_path / "grid.gpkg", network, parts(network)).geopackage


# --- naming -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["a/st.louis.gpkg", "a/st.louis.index", "a/st.louis", "a/st.louis.GPKG"])
def test_either_file_or_the_stem_names_both(given: str) -> None:
    paths = reference_paths(given)
    assert (paths.geopackage, paths.index) == (Path("a/st.louis.gpkg"), Path("a/st.louis.index"))


# --- opening ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["grid.gpkg", "grid.index", "grid"])
def test_what_is_written_is_opened(path: Path, network: RoadNetwork, given: str) -> None:
    assert sorted(file.name for file in path.parent.iterdir()) == ["grid.gpkg", "grid.index"]
    assert reference_freshness(path) == "fresh"
    meta, arrays = open_reference(path.parent / given, never)
    assert meta == parts(network)[0]
    np.testing.assert_array_equal(arrays["xy"], network.intersections.xy)
    assert not arrays["xy"].flags.writeable


def test_a_missing_index_is_built_again_and_kept(path: Path, network: RoadNetwork) -> None:
    before = path.with_suffix(".index").read_bytes()
    path.with_suffix(".index").unlink()
    assert reference_freshness(path) == "no index"
    with pytest.raises(IndexFormatError, match="no index at"):
        open_reference(path)
    open_reference(path, parts)
    assert path.with_suffix(".index").read_bytes() == before
    assert open_reference(path, never)[0] == parts(network)[0]


def test_an_index_alone_serves(path: Path, network: RoadNetwork) -> None:
    path.unlink()
    assert reference_freshness(path) == "no GeoPackage"
    assert open_reference(path, never)[0] == parts(network)[0]


def set_version(index: Path, version: int) -> bytes:
    """Give an index another format version; return what it was."""
    raw = index.read_bytes()
    index.write_bytes(raw[:16] + struct.pack("<I", version) + raw[20:])
    return raw


def test_an_index_of_an_earlier_format_is_built_again(path: Path, network: RoadNetwork) -> None:
    index = path.with_suffix(".index")
    raw = set_version(index, 0)
    assert reference_freshness(path) == "old format"
    assert describe_reference(path)["counts"]["intersections"] == len(network.intersections)
    with pytest.raises(IndexFormatError, match="format version 0"):
        open_reference(path)
    assert reference_digest(path) == ""  # in a folder that cannot be written it stays as it is
    assert open_reference(path, parts)[0] == parts(network)[0]
    assert index.read_bytes() == raw


def test_an_index_of_a_later_format_is_refused(path: Path) -> None:
    index = path.with_suffix(".index")
    set_version(index, 99)
    with pytest.raises(
        IndexFormatError,
        match=rf"format version 99.*reads version {FORMAT_VERSION}; use a later .*--rebuild \S*grid\.gpkg$",
    ):
        open_reference(path, never)
    assert index.read_bytes()[16:20] == struct.pack("<I", 99)  # that roadgeo may want it


def test_an_old_index_alone_says_what_is_missing(path: Path) -> None:
    set_version(path.with_suffix(".index"), 0)
    path.unlink()
    with pytest.raises(IndexFormatError, match=r"format version 0.*put grid\.gpkg beside it"):
        open_reference(path, parts)


@pytest.mark.parametrize("damage", [b"", b"nonsense", struct.pack("<I", 99)], ids=["empty", "damaged", "later"])
def test_an_index_is_built_again_on_request_whatever_there_was(path: Path, network: RoadNetwork, damage: bytes) -> None:
    index = path.with_suffix(".index")
    raw = index.read_bytes()
    index.write_bytes(raw[:16] + damage + raw[16 + len(damage) :] if damage else b"")
    with pytest.raises(IndexFormatError):
        open_reference(path, never)
    rebuild_index(path, parts)
    assert index.read_bytes() == raw
    assert open_reference(path, never)[0] == parts(network)[0]
    path.unlink()
    with pytest.raises(IndexFormatError, match=r"no such file: .*grid\.gpkg"):
        rebuild_index(path, parts)


def test_an_edited_geopackage_makes_the_index_stale(path: Path) -> None:
    with editing(path) as database:
        database.execute("DELETE FROM intersections WHERE fid = 1")
    assert reference_freshness(path) == "stale"
    with pytest.raises(
        IndexFormatError, match=r"grid\.index is stale: .* grid\.gpkg .*: roadgeo index --rebuild \S*grid\.gpkg$"
    ):
        open_reference(path, never)
    path.with_suffix(".index").unlink()
    assert (
        open_reference(path, parts)[0]["n"]
        == read_manifest(path.with_suffix(".index"))["about"]["counts"]["intersections"]
    )


def test_a_style_stored_by_qgis_leaves_it_fresh(path: Path) -> None:
    with editing(path) as database:
        database.execute("INSERT INTO layer_styles (f_table_name, styleName) VALUES ('roads', 'mine')")
    assert reference_freshness(path) == "fresh"


def test_another_reference_s_index_is_stale(path: Path, tmp_path: Path) -> None:
    other = as_stored(grid_network(seed=1))
    path.unlink()
    write_network(path, other)
    assert reference_freshness(path) == "stale"


def test_nothing_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(IndexFormatError, match=r"no reference .*none.*roadgeo index"):
        open_reference(tmp_path / "none", parts)
    assert "no reference" in check_reference(tmp_path / "none")[0]


@pytest.mark.parametrize("content", [b"", b"text", b"SQLite format 3\0" + bytes(5000)])
def test_a_damaged_geopackage_is_named(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    for call in (open_reference, describe_reference):
        with pytest.raises(IndexFormatError, match=r"grid\.gpkg"):
            call(path)
    path.with_suffix(".index").unlink()
    with pytest.raises(IndexFormatError, match=r"grid\.gpkg"):
        open_reference(path, never)


def test_a_read_only_folder_costs_time_only(path: Path, network: RoadNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    path.with_suffix(".index").unlink()

    def refuse(self: Path, *_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert open_reference(path, parts)[0] == parts(network)[0]
    assert not path.with_suffix(".index").exists()
    with pytest.raises(OutputError, match=r"grid\.index: read-only file system; choose a folder you may write to"):
        write_reference(path, network, parts(network))


def test_a_rebuild_never_replaces_what_another_wrote_meanwhile(path: Path, network: RoadNetwork) -> None:
    path.with_suffix(".index").unlink()
    newer = as_stored(grid_network(seed=7))

    def slow(old: RoadNetwork) -> IndexParts:
        write_reference(path, newer, parts(newer))
        return parts(old)

    assert open_reference(path, slow)[0] == parts(network)[0]
    assert reference_freshness(path) == "fresh"
    assert network_digest(read_network(path)) == network_digest(newer)


# --- writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moment", [0, 1, 2])
def test_the_reference_is_whole_at_every_moment(
    path: Path, network: RoadNetwork, monkeypatch: pytest.MonkeyPatch, moment: int
) -> None:
    """A writer that dies before, between and after its two renames."""
    newer = as_stored(grid_network(seed=7))
    rename, calls = Path.replace, []

    def die(staged: Path, target: Path) -> None:
        if len(calls) == moment:
            raise KeyboardInterrupt
        calls.append(target)
        rename(staged, target)

    monkeypatch.setattr(Path, "replace", die)
    if moment < 2:
        with pytest.raises(KeyboardInterrupt):
            write_reference(path, newer, parts(newer))
    else:
        write_reference(path, newer, parts(newer))
    monkeypatch.undo()
    expected = network if moment == 0 else newer
    np.testing.assert_array_equal(open_reference(path, parts)[1]["xy"], expected.intersections.xy)
    assert sorted(file.name for file in path.parent.iterdir()) == ["grid.gpkg", "grid.index"]


def test_readers_keep_the_reference_they_opened(path: Path, network: RoadNetwork) -> None:
    _, arrays = open_reference(path)
    newer = as_stored(grid_network(seed=7))
    write_reference(path, newer, parts(newer))
    np.testing.assert_array_equal(arrays["xy"], network.intersections.xy)
    np.testing.assert_array_equal(open_reference(path)[1]["xy"], newer.intersections.xy)


WRITER = """
import sys
from pathlib import Path
from roadgeo.reference.files import write_reference
from worlds.networks import parts, two_networks
networks = two_networks()
while True:
    for network in networks:
        write_reference(Path(sys.argv[1]), network, parts(network))
        print("written", flush=True)
"""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Have another process replace one reference by another again and again; it is killed in the end."""
    command = [sys.executable, "-c", WRITER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        yield
        writer.kill()


def test_readers_are_not_disturbed_by_a_writer(tmp_path: Path) -> None:
    """Every opening gives one whole reference."""
    path = tmp_path / "REF.gpkg"
    known = [network.intersections.xy for network in two_networks()]
    n_opened = {len(xy): 0 for xy in known}
    with writing(path):
        end = time.monotonic() + 2
        while time.monotonic() < end:
            meta, arrays = open_reference(path, parts)
            assert any(np.array_equal(arrays["xy"], xy) for xy in known)
            n_opened[meta["n"]] += 1
    assert min(n_opened.values()) > 0


def test_an_index_that_is_stale_for_a_moment_is_waited_for(path: Path) -> None:
    """A reader that met no index built the old one's, and a busy writer has yet to replace it."""
    older = reference_paths(path).index.read_bytes()
    newer = as_stored(grid_network(seed=7))
    write_reference(path, newer, parts(newer))
    index = reference_paths(path).index
    whole = index.read_bytes()
    index.write_bytes(older)

    def publish() -> None:
        time.sleep(0.1)
        aside = index.with_suffix(".new")
        aside.write_bytes(whole)
        aside.replace(index)

    with ThreadPoolExecutor(1) as writer:
        writer.submit(publish)
        np.testing.assert_array_equal(open_reference(path)[1]["xy"], newer.intersections.xy)


def test_an_index_that_comes_and_goes_while_it_is_opened(
    tmp_path: Path, network: RoadNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A writer publishes the index of one reference and takes it away for the next: the files look untouched."""
    path = tmp_path / "grid.gpkg"
    write_network(path, network)

    def read_and_lose(file: Path) -> RoadNetwork:
        monkeypatch.undo()
        raise IndexFormatError(f"{file} was replaced while it was read; try again")

    monkeypatch.setattr("roadgeo.reference.files.read_network", read_and_lose)
    np.testing.assert_array_equal(open_reference(path, parts)[1]["xy"], network.intersections.xy)


def test_a_name_is_needed_by_nobody(tmp_path: Path, network: RoadNetwork) -> None:
    bare = replace(network, meta={})
    write_reference(tmp_path / "bare", bare, ({}, {}))
    assert describe_reference(tmp_path / "bare")["name"] == "bare"


def test_killed_writers_leave_a_whole_reference(tmp_path: Path) -> None:
    """With its own index or with none; the next writer clears away what they left."""
    path, rng, networks = tmp_path / "REF.gpkg", random.Random(1), two_networks()
    for _ in range(4):
        with writing(path):
            time.sleep(rng.uniform(0, 0.15))
        network = read_network(path)
        assert network_digest(network) in map(network_digest, networks)
        assert open_reference(path, parts)[0] == parts(network)[0]
    write_reference(path, networks[0], parts(networks[0]))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["REF.gpkg", "REF.index"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs resource limits")
@pytest.mark.parametrize("limit", [1000, 60_000, 200_000])
def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path, network: RoadNetwork, limit: int) -> None:
    """A limit on the size of files stands in for a full disk: it strikes the GeoPackage first, or the index."""
    write_reference(tmp_path / "grid.gpkg", network, parts(network))
    code = (
        "import resource, sys, numpy as np\n"
        "from worlds.networks import grid_network\n"
        "from roadgeo.errors import OutputError\n"
        "from roadgeo.roads.network import as_stored\n"
        "from roadgeo.reference.files import write_reference\n"
        "network = as_stored(grid_network(seed=3))\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)\n"
        "try:\n"
        "    write_reference(sys.argv[1], network, ({}, {'big': np.zeros(100_000)}))\n"
        "except OutputError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", code, str(tmp_path / "grid.gpkg"), str(limit)],  # -B: or modules are cut off
        check=True, capture_output=True, text=True, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    assert done.stdout.startswith(f"cannot write {tmp_path / 'grid.gpkg'}: "), done.stderr
    assert done.stdout.count("\n") == 1
    assert sorted(file.name for file in tmp_path.iterdir()) == ["grid.gpkg", "grid.index"]
    assert open_reference(tmp_path / "grid.gpkg", never)[0] == parts(network)[0]


# --- describing -------------------------------------------------------------------------------------------------------


def test_description(path: Path, network: RoadNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_values, "PlainUnpickler", None)
    found = describe_reference(path)
    assert json.loads(json.dumps(found)) == found
    assert found["name"] == "Grid, MA"
    assert found["freshness"] == "fresh"
    assert found["files"] == {str(f): f.stat().st_size for f in (path, path.with_suffix(".index"))}
    assert found["crs"] == "EPSG:32619"
    assert found["counts"] == {"intersections": len(network.intersections), "roads": 31, "nodes": 20}
    assert found["memory_bytes"] == network.intersections.xy.nbytes
    assert found["road_km"] == pytest.approx(network.graph.edge_lengths().sum() / 1000)
    assert found["intersections_per_km2"] == pytest.approx(len(network.intersections) / found["area_km2"])
    assert found["meta"] == network.meta
    assert found["index"] == {"n": len(network.intersections)}
    low, high = np.array(found["extent"][:2]), np.array(found["extent"][2:])
    assert (low >= np.array(network.plane.origin) - 100).all()
    assert (high <= np.array(network.plane.origin) + 700).all()


def test_description_without_an_index(path: Path, network: RoadNetwork) -> None:
    path.with_suffix(".index").unlink()
    found = describe_reference(path)
    assert (found["freshness"], found["meta"]) == ("no index", network.meta)
    assert found["counts"] == {"intersections": len(network.intersections), "roads": 31}


# --- checking ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound() -> Iterator[tuple[RoadNetwork, IndexParts]]:
    from roadgeo.matching.index import build_index

    network = as_stored(grid_network(8, 8))
    index = build_index(network)
    return network, (dict(index.meta), index.arrays())


@pytest.fixture
def checked(tmp_path: Path, sound: tuple[RoadNetwork, IndexParts]) -> Path:
    return write_reference(tmp_path / "grid.gpkg", *sound).geopackage


def test_a_sound_reference_has_no_problems(checked: Path) -> None:
    assert check_reference(checked) == []
    checked.with_suffix(".index").rename(checked.parent / "kept")
    assert check_reference(checked) == []
    (checked.parent / "kept").rename(checked.with_suffix(".index"))
    checked.unlink()
    assert check_reference(checked) == []


def test_damage_of_either_file_is_found(checked: Path) -> None:
    index = checked.with_suffix(".index")
    raw = bytearray(index.read_bytes())
    raw[-70] ^= 1
    index.write_bytes(raw)
    assert "damaged" in check_reference(checked)[0]
    raw = bytearray(checked.read_bytes())
    raw[len(raw) // 2 : len(raw) // 2 + 4096] = bytes(4096)
    checked.write_bytes(raw)
    assert any("grid.gpkg" in problem for problem in check_reference(checked))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("neighbours", lambda a: a + 1000, "out of range"),
        ("table_entries", lambda a: a | np.uint64(0xFFFF << 48), "out of range"),
        ("source", lambda a: a * 0, "array 'source' is not what the GeoPackage gives"),
        ("xy", lambda a: a + 0.25, "array 'xy' is not what the GeoPackage gives"),
        ("segments", lambda a: a + 0.25, "array 'segments' is not what the GeoPackage gives"),
    ],
)
def test_an_index_that_cannot_be_used_is_found(
    tmp_path: Path, sound: tuple[RoadNetwork, IndexParts], name: str, change: Any, message: str
) -> None:
    network, (meta, arrays) = sound
    paths = write_reference(tmp_path / "grid", network, (meta, arrays | {name: change(arrays[name])}))
    problems = check_reference(paths.geopackage)
    assert len(problems) == 1
    assert message in problems[0]


@pytest.mark.parametrize("options", [None, {}, {"n_neighbours": 10**9}, {"simplify_m": "x"}, {"else": 1}])
def test_options_that_nobody_wrote_are_found(
    tmp_path: Path, sound: tuple[RoadNetwork, IndexParts], options: dict[str, Any] | None
) -> None:
    network, (meta, arrays) = sound
    stored = meta["index_options"] | options if options else options
    paths = write_reference(tmp_path / "grid", network, (meta | {"index_options": stored}, arrays))
    (problem,) = check_reference(paths.geopackage)
    assert "its options differ from its GeoPackage's" in problem


def test_a_stale_index_and_an_unnoticed_edit_are_found(checked: Path) -> None:
    with editing(checked) as database:
        database.execute("UPDATE intersections SET residual_m = 3")
        digest = database.execute("SELECT value FROM roadgeo_meta WHERE key = 'roadgeo.digest'").fetchone()
        assert digest == ("null",)
    assert any("stale" in problem for problem in check_reference(checked))
    with editing(checked) as database:  # as if the triggers had not been there
        about = read_manifest(checked.with_suffix(".index"))["about"]
        database.execute("UPDATE roadgeo_meta SET value = ? WHERE key = 'roadgeo.digest'", (f'"{about["network"]}"',))
    assert reference_freshness(checked) == "fresh"
    problems = check_reference(checked)
    assert any("differ from their stored digest" in problem for problem in problems)
    assert any("stale" in problem for problem in problems)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("options", '{"index": {"n_neighbours": 99}}', "index.n_neighbours is 99"),
        ("roadgeo.crs", '"EPSG:1"', "EPSG:1"),
        (None, "", "at least 3 are needed"),
    ],
)
@pytest.mark.parametrize("index_too", [False, True])
def test_what_cannot_be_searched_is_not_sound(
    checked: Path, key: str | None, value: str, message: str, index_too: bool
) -> None:
    """A check passed over what `locate` stumbled on."""
    with editing(checked) as database:
        if key is None:
            database.execute("DELETE FROM intersections WHERE fid > 2")
        else:
            database.execute("INSERT OR REPLACE INTO roadgeo_meta (key, value) VALUES (?, ?)", (key, value))
    if not index_too:
        checked.with_suffix(".index").unlink()
    problems = check_reference(checked)
    assert any(message in problem and str(checked) in problem for problem in problems), problems
