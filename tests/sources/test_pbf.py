"""How large a blob of a PBF file is, by the header before it; and that osmium is shown no text that it cannot read."""

import zlib
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from roadgeo.errors import RoadSourceError
from roadgeo.sources.pbf import _blob_size, _require_text
from roadgeo.sources.roads import read_roads


def varint(number: int) -> bytes:
    parts = [number >> shift & 127 for shift in range(0, max(number.bit_length(), 1), 7)]
    return bytes([*(part | 128 for part in parts[:-1]), parts[-1]])


def text(field: int, content: bytes) -> bytes:
    return varint(8 * field + 2) + varint(len(content)) + content


@given(st.integers(0, 2**31 - 1), st.binary(max_size=200))
def test_a_header_tells_the_size(size: int, index: bytes) -> None:
    assert _blob_size(text(1, b"OSMData") + text(2, index) + varint(24) + varint(size)) == size


@given(st.binary(max_size=300))
@example(b"\x18" + b"\x80" * 20 + b"\x01")  # as long a number as the header is takes a second to put together
def test_any_header_tells_a_number_of_ten_bytes_at_most(header: bytes) -> None:
    assert -1 <= _blob_size(header) < 1 << 70


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
    with pytest.raises(RuntimeError):
        _require_text(content)


@given(st.binary(max_size=60))
def test_any_blob_is_taken_or_refused(content: bytes) -> None:
    for one in (content, text(1, content), text(3, zlib.compress(content))):
        with suppress(RuntimeError):
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
