"""Messages of Protocol Buffers, of which a few fields are looked at before another library reads the whole."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

__all__ = ["message_types"]


@cache
def message_types(schema: str) -> Mapping[str, Any]:
    """Return the classes of messages by name; other fields are passed over.

    Parameters
    ----------
    schema : str
        A line for each message: its name, and of each field, which may be repeated, `name:number` for bytes or
        `name:number:type` for int64 or another message.
    """
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    described = descriptor_pb2.FieldDescriptorProto
    plain = {"int64": described.TYPE_INT64, "": described.TYPE_BYTES}
    file = descriptor_pb2.FileDescriptorProto(name="roadgeo.proto", package="roadgeo")
    for name, *fields in map(str.split, schema.strip().splitlines()):
        message = file.message_type.add(name=name)
        for field, number, kind in (f"{field}:".split(":")[:3] for field in fields):
            added = message.field.add(name=field, number=int(number), label=described.LABEL_REPEATED)
            added.type = plain.get(kind, described.TYPE_MESSAGE)
            if kind not in plain:
                added.type_name = f".roadgeo.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        one.name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"roadgeo.{one.name}"))
        for one in file.message_type
    }
