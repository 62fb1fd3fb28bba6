"""How large a blob of a PBF file is, by the header before it."""

from hypothesis import example, given
from hypothesis import strategies as st

from roadgeo.sources.pbf import _blob_size


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
