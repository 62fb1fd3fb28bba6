"""The wire format of Protocol Buffers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roadgeo.sources.protobuf import WireError, fields


@pytest.mark.slow
@given(st.binary(max_size=200))
def test_any_bytes_are_fields_within_them_or_refused(content: bytes) -> None:
    try:
        found = list(fields(memoryview(content)))
    except WireError:
        return
    assert sum(len(value) for _, value in found if isinstance(value, memoryview)) <= len(content)


def test_a_number_that_never_ends_is_refused() -> None:
    with pytest.raises(WireError, match="cut short"):
        list(fields(memoryview(b"\x80" * 1000)))
