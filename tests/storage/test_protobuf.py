"""Messages of Protocol Buffers: the fields that are asked for, whatever else they hold."""

import pytest
from google.protobuf.message import DecodeError

from roadgeo.storage.protobuf import message_types

MESSAGES = message_types("Outer inner:1:Inner number:2:int64\n Inner text:3")


def test_fields_are_told_and_others_passed_over() -> None:
    message = MESSAGES["Outer"].FromString(b"\x0a\x03\x1a\x01x\x10\x07\x10\x08\x4a\x02no")
    assert list(message.number) == [7, 8]
    assert message.inner[0].text == [b"x"]


def test_a_number_that_never_ends_is_refused() -> None:
    with pytest.raises(DecodeError):
        MESSAGES["Outer"].FromString(b"\x80" * 1000)
