"""Messages of Protocol Buffers, of which a few fields are looked at before another library reads the whole."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

__all__ = ["Schema", "message_types"]

#: Messages by name; of each the fields, which may all be repeated, by name, number and type: another message's name.
Schema = tuple[tuple[str, tuple[tuple[str, int, str], ...]], ...]


@cache
def message_types(schema: Schema) -> Mapping[str, Any]:
    """Return the classes of messages; other fields are passed over."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    described = descriptor_pb2.FieldDescriptorProto
    plain = {"int64": described.TYPE_INT64, "bytes": described.TYPE_BYTES}
    file = descriptor_pb2.FileDescriptorProto(name="roadgeo.proto", package="roadgeo")
    for name, fields in schema:
        message = file.message_type.add(name=name)
        for field, number, kind in fields:
            added = message.field.add(name=field, number=number, label=described.LABEL_REPEATED)
            added.type = plain.get(kind, described.TYPE_MESSAGE)
            if kind not in plain:
                added.type_name = f".roadgeo.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"roadgeo.{name}")) for name, _ in schema}
