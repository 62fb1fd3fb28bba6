"""The wire format of Protocol Buffers: fields of a message, read without its schema.

Enough to look at the text of a PBF file before osmium does: a message is walked in place, and fields are never copied.
https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

from collections.abc import Iterator

__all__ = ["Field", "WireError", "fields"]

#: A field: its number, and a varint's value or the bytes of a nested message, string or packed list.
Field = tuple[int, "int | memoryview"]

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5


class WireError(ValueError):
    """The bytes are no protobuf message."""


def fields(message: memoryview) -> Iterator[Field]:
    """Walk the fields of a message in order.

    Raises
    ------
    WireError
        It is cut short, or not in this format.
    """
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        if kind == VARINT:
            value, at = _varint(message, at)
            yield number, value
            continue
        if kind == BYTES:
            size, at = _varint(message, at)
        elif kind in (FIXED64, FIXED32):
            size = 8 if kind == FIXED64 else 4
        else:
            raise WireError(f"field {number} is of the unknown kind {kind}")
        if number == 0 or at + size > len(message):
            raise WireError(f"field {number} reaches beyond its message")
        yield number, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return a varint and the position after it."""
    value = shift = 0
    while at < len(message) and shift < 70:
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, at
        shift += 7
    raise WireError("a number is cut short")
