"""An ONNX file looked at before it runs: what it takes and gives, its metadata, and that it is no more than a network.

Field numbers are those of onnx.proto (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto). Refused are: data in
other files, operators that are not ONNX's own, functions, control flow, random numbers, tensors whose stated size is
not what the file holds, and constants that grow beyond all measure when they are expanded.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from roadgeo.errors import ModelError
from roadgeo.sources.protobuf import WireError, fields, integers

__all__ = ["MAX_BYTES", "OnnxFile", "Port", "read_onnx"]

MAX_BYTES = 512 << 20
_MAX_NODES = 20_000
_MAX_EXPANDED = 1 << 26  # elements that a stated shape may ask for
_MAX_SMALL = 64  # elements of a tensor that may be a shape

_FLOAT, _INT64 = 1, 7
#: Bits of the elements of TensorProto.DataType.
_BITS = {
    1: 32,
    2: 8,
    3: 8,
    4: 16,
    5: 16,
    6: 32,
    7: 64,
    9: 8,
    10: 16,
    11: 64,
    12: 32,
    13: 64,
    16: 16,
    17: 8,
    18: 8,
    19: 8,
    20: 8,
    21: 4,
    22: 4,
    23: 4,
}
_CONTROL = {"If", "Loop", "Scan", "SequenceMap"}
_RANDOM = {"RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike", "Multinomial", "Bernoulli"}
_EXPANDING = {"ConstantOfShape", "Expand", "Tile", "Resize", "Upsample", "Pad"}


@dataclass(frozen=True)
class Port:
    """An input or output. Of its sizes None means any."""

    name: str
    is_float: bool
    shape: tuple[int | None, ...]


@dataclass(frozen=True)
class OnnxFile:
    """What an ONNX file says of itself.

    Attributes
    ----------
    content : bytes
        The file.
    inputs, outputs : tuple of Port
        Without those that have a stored value.
    last : dict of str to str
        For each output, the operator that makes it.
    metadata : dict of str to str
        `metadata_props`.
    """

    content: bytes
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    last: dict[str, str]
    metadata: dict[str, str]


@dataclass
class _Graph:
    """What is gathered of a graph."""

    inputs: list[Port] = field(default_factory=list)
    outputs: list[Port] = field(default_factory=list)
    stored: set[str] = field(default_factory=set)
    shapes: dict[str, list[int]] = field(default_factory=dict)  # small whole-number tensors, by name
    nodes: list[tuple[str, list[str], list[str]]] = field(default_factory=list)  # operator, inputs, outputs


def read_onnx(path: str | os.PathLike[str]) -> OnnxFile:
    """Read an ONNX file and check that it is nothing but a network.

    Raises
    ------
    ModelError
        It is missing, too large, no ONNX, or holds what is listed above.
    """
    name = os.fspath(path)
    file = Path(path)
    if not file.is_file():
        raise ModelError(f"{name}: no such model file; check the path")
    if file.stat().st_size > MAX_BYTES:
        raise ModelError(
            f"{name}: {file.stat().st_size / 1e6:.0f} MB; expected a model of {MAX_BYTES >> 20} MB at most"
        )
    content = file.read_bytes()
    try:
        return _parse(content)
    except (WireError, UnicodeDecodeError) as error:
        raise ModelError(f"{name}: not an ONNX model, or damaged ({error}); export it again") from error
    except _RefusedError as error:
        raise ModelError(f"{name}: {error}") from error


class _RefusedError(Exception):
    """Why a file is refused, and what to do."""


def _parse(content: bytes) -> OnnxFile:
    """Walk a ModelProto."""
    metadata: dict[str, str] = {}
    graphs, has_version = [], False
    for number, value in fields(memoryview(content)):
        if number == 1 and isinstance(value, int):
            has_version = True
        elif number == 7 and isinstance(value, memoryview):
            graphs.append(value)
        elif number == 14 and isinstance(value, memoryview):
            entry = {key: _text(part) for key, part in fields(value) if key in (1, 2)}
            metadata[entry.get(1, "")] = entry.get(2, "")
        elif number in (20, 25):
            what = "training steps" if number == 20 else "functions"
            raise _RefusedError(f"holds {what} of its own; expected a plain network: export it with its parts inlined")
    if not has_version or len(graphs) != 1:
        raise WireError(f"it holds {len(graphs)} graphs")
    graph = _read_graph(graphs[0])
    _check_expansion(graph)
    makers = {output: operator for operator, _, outputs in graph.nodes for output in outputs}
    return OnnxFile(
        content,
        tuple(port for port in graph.inputs if port.name not in graph.stored),
        tuple(graph.outputs),
        {port.name: makers.get(port.name, "") for port in graph.outputs},
        metadata,
    )


def _read_graph(message: memoryview) -> _Graph:
    """Walk a GraphProto."""
    graph = _Graph()
    for number, value in fields(message):
        if not isinstance(value, memoryview):
            continue
        if number == 1:
            _read_node(value, graph)
        elif number == 5:
            name, numbers = _read_tensor(value)
            graph.stored.add(name)
            graph.shapes[name] = numbers
        elif number == 11:
            graph.inputs.append(_read_port(value))
        elif number == 12:
            graph.outputs.append(_read_port(value))
        elif number == 15:
            raise _RefusedError("holds sparse tensors; expected dense ones: export it anew")
    return graph


def _read_node(message: memoryview, graph: _Graph) -> None:
    """Walk a NodeProto."""
    operator = domain = ""
    inputs, outputs, attributes = [], [], []
    for number, value in fields(message):
        if not isinstance(value, memoryview):
            continue
        if number == 1:
            inputs.append(_text(value))
        elif number == 2:
            outputs.append(_text(value))
        elif number == 4:
            operator = _text(value)
        elif number == 5:
            attributes.append(value)
        elif number == 7:
            domain = _text(value)
    if domain not in ("", "ai.onnx"):
        raise _RefusedError(f"uses the operator {domain}.{operator}; expected ONNX's own: export it without others")
    if operator in _CONTROL | _RANDOM:
        what = "control flow" if operator in _CONTROL else "random numbers"
        raise _RefusedError(f"uses {what} ({operator}); expected a plain network: export it anew")
    graph.nodes.append((operator, inputs, outputs))
    if len(graph.nodes) > _MAX_NODES:
        raise _RefusedError(f"has more than {_MAX_NODES:,} operators; expected a network for segmentation")
    for attribute in attributes:
        numbers = _read_attribute(attribute)
        if operator == "Constant" and outputs:
            graph.shapes[outputs[0]] = numbers


def _read_attribute(message: memoryview) -> list[int]:
    """Walk an AttributeProto; return the whole numbers of its tensor or list."""
    numbers: list[int] = []
    for number, value in fields(message):
        if number in (6, 11, 22, 23):
            raise _RefusedError("holds graphs or sparse tensors within operators; expected a plain network")
        if number in (5, 10) and isinstance(value, memoryview):
            numbers = _read_tensor(value)[1]
        elif number == 8 and len(numbers) < _MAX_SMALL:
            numbers += integers(value)
    return numbers


def _read_tensor(message: memoryview) -> tuple[str, list[int]]:
    """Walk a TensorProto, check that it holds what it states; return its name and, if they are few, its integers."""
    name, kind, size, held = "", 0, 1, 0
    raw: memoryview | None = None
    numbers: list[int] = []
    for number, value in fields(message):
        if number in (13, 14) and value != 0:
            raise _RefusedError("keeps data in another file; expected all in one: save it without external data")
        if number == 1:
            for side in integers(value):
                size = size * side if side >= 0 else -1
                if not 0 <= size <= 8 * MAX_BYTES:
                    raise _RefusedError("states a tensor larger than any file; it is damaged or hostile")
        elif number == 2 and isinstance(value, int):
            kind = value
        elif number == 8 and isinstance(value, memoryview):
            name = _text(value)
        elif number == 9 and isinstance(value, memoryview):
            raw, held = value, 8 * len(value)
        elif number in (4, 5, 6, 7, 10, 11):
            held += 8 * len(value) if isinstance(value, memoryview) else 64
            if number == 7 and len(numbers) < _MAX_SMALL:
                numbers += integers(value)
    bits = _BITS.get(kind)
    if bits is None:
        raise _RefusedError(f"holds a tensor of type {kind}; expected numbers")
    # Numbers in `raw_data` take exactly their width; in the lists a varint takes 8 bits or more.
    if (raw is not None and not 0 <= held - size * bits < 8) or (raw is None and size * min(bits, 8) > held):
        raise _RefusedError(f"states {size:,} values of {bits} bits and holds {held:,} bits; it is damaged or hostile")
    if raw is not None and kind == _INT64 and size <= _MAX_SMALL:
        numbers = [int.from_bytes(raw[i : i + 8], "little", signed=True) for i in range(0, len(raw), 8)]
    return name, numbers


def _check_expansion(graph: _Graph) -> None:
    """Refuse constants that are expanded to more than a network needs; what grows from the input is bounded by that."""
    for operator, inputs, _ in graph.nodes:
        if operator not in _EXPANDING:
            continue
        for name in inputs:
            numbers = graph.shapes.get(name, [])
            if math.prod(max(abs(number), 1) for number in numbers) > _MAX_EXPANDED:
                raise _RefusedError(f"expands a tensor to {numbers}; expected less than {_MAX_EXPANDED:,} values")


def _read_port(message: memoryview) -> Port:
    """Walk a ValueInfoProto."""
    name, element = "", 0
    shape: list[int | None] = []
    for number, value in fields(message):
        if not isinstance(value, memoryview):
            continue
        if number == 1:
            name = _text(value)
        elif number == 2:
            for tensor in _messages(value, 1):
                element = next((v for n, v in fields(tensor) if n == 1 and isinstance(v, int)), 0)
                for dims in _messages(tensor, 2):
                    shape += [_read_side(side) for side in _messages(dims, 1)]
    return Port(name, element == _FLOAT, tuple(shape))


def _read_side(message: memoryview) -> int | None:
    sizes = [value for number, value in fields(message) if number == 1 and isinstance(value, int)]
    return sizes[0] if sizes and 0 < sizes[0] < 1 << 31 else None


def _messages(message: memoryview, number: int) -> Iterator[memoryview]:
    return (value for n, value in fields(message) if n == number and isinstance(value, memoryview))


def _text(value: int | memoryview) -> str:
    return bytes(value).decode("utf-8") if isinstance(value, memoryview) else str(value)
