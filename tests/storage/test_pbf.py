"""osmium is shown no blob that it cannot read."""

import io
import zlib
from contextlib import suppress

import pytest
from google.protobuf.message import DecodeError
from hypothesis import example, given
from hypothesis import strategies as st
from worlds.osm_files import varint

from roadgeo.storage.pbf import _require_text, read_blob

REFUSED = (RuntimeError, DecodeError, zlib.error)


def text(field: int, content: bytes) -> bytes:
    return varint(8 * field + 2) + varint(len(content)) + content


@given(st.binary(max_size=200), st.binary(max_size=300))
def test_a_header_tells_the_size(index: bytes, content: bytes) -> None:
    packed = text(1, content.replace(b"\0", b"1")) if content[:1] != b"\n" else text(1, b"")
    header = text(1, b"OSMData") + text(2, index) + varint(24) + varint(len(packed))
    whole = len(header).to_bytes(4, "big") + header + packed
    with suppress(RuntimeError):  # what is in it is no block
        assert read_blob(io.BytesIO(whole + b"more")) == whole


@given(st.binary(max_size=300))
@example(b"\x18" + b"\x80" * 20 + b"\x01")  # as long a number as the header is takes a second to put together
@example(b"\x18" + b"\xff" * 9 + b"\x01")
def test_any_header_is_taken_or_refused(header: bytes) -> None:
    with suppress(RuntimeError):
        read_blob(io.BytesIO(len(header).to_bytes(4, "big") + header + b"content" * 20))


def blob(*texts: bytes, packed: bool = False, table: int = 1) -> bytes:
    """A blob of a block whose table holds these texts."""
    block = text(table, b"".join(text(1, item) for item in texts)) + text(2, b"\0\0\0")
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
    for item in (content, text(1, content), text(3, zlib.compress(content))):
        with suppress(*REFUSED):
            _require_text(item)
