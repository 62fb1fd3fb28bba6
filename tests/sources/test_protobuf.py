"""The wire format of Protocol Buffers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roadgeo.sources.protobuf import WireError, fields, integers


@pytest.mark.slow
@given(st.binary(max_size=200))
def test_any_bytes_are_fields_within_them_or_refused(content: bytes) -> None:
    try:
        found = list(fields(memoryview(content)))
    except WireError:
        return
    assert sum(len(value) for _, value in found if isinstance(value, memoryview)) <= len(content)


@given(st.lists(st.integers(-(2**63), 2**63 - 1), max_size=20))
def test_packed_integers_come_back(numbers: list[int]) -> None:
    packed = bytearray()
    for number in numbers:
        left = number % 2**64
        while left > 127:
            packed.append(left & 127 | 128)
            left >>= 7
        packed.append(left)
    assert integers(memoryview(packed)) == numbers


def test_a_number_that_never_ends_is_refused() -> None:
    with pytest.raises(WireError, match="cut short"):
        list(fields(memoryview(b"\x80" * 1000)))
