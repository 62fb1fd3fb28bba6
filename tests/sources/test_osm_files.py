"""OpenStreetMap files of every shape give the same streets; osmium is shown no blob that it cannot read."""

import gzip
import io
import zlib
from contextlib import suppress
from pathlib import Path

import pytest
import shapely
from google.protobuf.message import DecodeError
from hypothesis import example, given
from hypothesis import strategies as st
from worlds.fenway import elements, streets
from worlds.osm_files import o5m, osm_texts, overpass_answers

from roadgeo.errors import RoadSourceError
from roadgeo.sources.osm_files import _read_blob, _require_text
from roadgeo.sources.roads import read_roads
from roadgeo.sources.streams import read_lines

REFUSED = (RuntimeError, DecodeError, zlib.error)


def varint(number: int) -> bytes:
    parts = [number >> shift & 127 for shift in range(0, max(number.bit_length(), 1), 7)]
    return bytes([*(part | 128 for part in parts[:-1]), parts[-1]])


def text(field: int, content: bytes) -> bytes:
    return varint(8 * field + 2) + varint(len(content)) + content


@given(st.binary(max_size=200), st.binary(max_size=300))
def test_a_header_tells_the_size(index: bytes, content: bytes) -> None:
    packed = text(1, content.replace(b"\0", b"1")) if content[:1] != b"\n" else text(1, b"")
    header = text(1, b"OSMData") + text(2, index) + varint(24) + varint(len(packed))
    whole = len(header).to_bytes(4, "big") + header + packed
    with suppress(RuntimeError):  # what is in it is no block
        assert _read_blob(io.BytesIO(whole + b"more")) == whole


@given(st.binary(max_size=300))
@example(b"\x18" + b"\x80" * 20 + b"\x01")  # as long a number as the header is takes a second to put together
@example(b"\x18" + b"\xff" * 9 + b"\x01")
def test_any_header_is_taken_or_refused(header: bytes) -> None:
    with suppress(RuntimeError):
        _read_blob(io.BytesIO(len(header).to_bytes(4, "big") + header + b"content" * 20))


def blob(*texts: bytes, packed: bool = False, table: int = 1) -> bytes:
    """A blob of a block whose table holds these texts."""
    block = text(table, b"".join(text(1, one) for one in texts)) + text(2, b"\0\0\0")
    return text(3, zlib.compress(block)) if packed else text(1, block)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("texts", [(), (b"",), (b"", b"highway", b"Gr\xc3\xbcn"), (b"", b"", b"name", b"")])
def test_texts_without_a_zero_byte_are_read(texts: tuple[bytes, ...], packed: bool) -> None:
    _require_text(blob(*texts, packed=packed))


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("texts", [(b"\0",), (b"", b"p\0imary"), (b"", b"", b"\n\0"), (b"", b"a" * 200, b"b\0")])
def test_a_zero_byte_in_a_text_is_refused(texts: tuple[bytes, ...], packed: bool) -> None:
    with pytest.raises(RuntimeError, match="a text in it holds a zero byte"):
        _require_text(blob(*texts, packed=packed))


@pytest.mark.parametrize(
    "content",
    [
        blob(b"", packed=True) + blob(b"p\0imary", packed=True),  # osmium reads the last
        text(6, b"lz4"),
        b"",
        text(3, b"no zlib"),
        text(1, b"\x0a\x7f"),
        b"\xff",
    ],
)
def test_a_blob_that_cannot_be_looked_at_is_refused(content: bytes) -> None:
    with pytest.raises(REFUSED):
        _require_text(content)


@given(st.binary(max_size=60))
def test_any_blob_is_taken_or_refused(content: bytes) -> None:
    for one in (content, text(1, content), text(3, zlib.compress(content))):
        with suppress(*REFUSED):
            _require_text(one)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not tell what files are open")
def test_a_damaged_header_leaves_no_file_open(tmp_path: Path) -> None:
    path = tmp_path / "roads.osm.pbf"
    header = text(1, b"OSMHeader") + varint(24) + varint(8)
    path.write_bytes(len(header).to_bytes(4, "big") + header + text(1, b"\x0a\x04abc"))
    counts = []
    for _ in range(4):
        with pytest.raises(RoadSourceError):
            read_roads(path)
        counts.append(len(list(Path("/proc/self/fd").iterdir())))
    assert counts[1] == counts[-1]


# --- files of every shape ---------------------------------------------------------------------------------------------


def right() -> tuple[list[bytes], list[str]]:
    lines, highway, _ = streets()
    found = sorted(zip(shapely.to_wkb(shapely.set_precision(lines, 1e-6)), highway, strict=True))
    return [line for line, _ in found], [kind for _, kind in found]


def read(path: Path) -> tuple[list[bytes], list[str]]:
    found = read_lines(path)
    shapes = shapely.to_wkb(shapely.set_precision(found.lines, 1e-6))
    pairs = sorted(zip(shapes, found.highway, strict=True))
    return [line for line, _ in pairs], [kind for _, kind in pairs]


@pytest.mark.parametrize("what", osm_texts())
@pytest.mark.parametrize("ending", [".osm", ".osm.gz", ".osh"])
def test_files_of_every_shape_give_the_same_streets(tmp_path: Path, what: str, ending: str) -> None:
    path, content = tmp_path / f"roads{ending}", osm_texts()[what].encode()
    path.write_bytes(gzip.compress(content) if ending.endswith("gz") else content)
    assert read(path) == right()


@pytest.mark.parametrize("what", [one for one in osm_texts() if one not in ("deleted in JOSM", "places without ids")])
def test_pbf_files_of_every_shape(tmp_path: Path, what: str) -> None:
    import osmium

    path = tmp_path / ("roads.osh.pbf" if what.startswith(("history", "no longer", "deleted")) else "roads.osm.pbf")
    low = ",locations_on_ways=true" if what == "places in ways" else ""
    file = osmium.io.File(str(path), f"osh.pbf{low}" if ".osh" in path.name else f"pbf{low}")
    with osmium.SimpleWriter(file) as writer:
        for entity in osmium.FileProcessor(osmium.io.FileBuffer(osm_texts()[what].encode(), "osm")):
            writer.add(entity)
    assert read(path) == right()


def test_o5m(tmp_path: Path) -> None:
    (tmp_path / "roads.o5m").write_bytes(o5m())
    assert read(tmp_path / "roads.o5m") == right()


@pytest.mark.parametrize("what", overpass_answers())
def test_answers_of_overpass(tmp_path: Path, what: str) -> None:
    path = tmp_path / "roads.json"
    path.write_text(overpass_answers()[what])
    assert read(path) == right()


def test_ways_without_places_are_counted_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "roads.osm"
    ways = osm_texts()["nodes first"].splitlines()
    path.write_text("\n".join(row for row in ways if not row.startswith("<node")))
    with pytest.raises(RoadSourceError, match="the nodes of its ways are not in it: export them too"):
        read_roads(path)
    lost = set(elements()[1][0]["nodes"])
    path.write_text("\n".join(row for row in ways if not any(f'<node id="{n}"' in row for n in lost)))
    read_roads(path)
    assert "are ways whose nodes are not in the file" in caplog.text


@pytest.mark.parametrize("text", ['{"elements": 3}', '{"elements": [3, {"type": "way"}]}', '{"elements": [', "{}"])
def test_other_answers_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(RoadSourceError, match=r"a\.json"):
        read_roads(tmp_path / "a.json")
