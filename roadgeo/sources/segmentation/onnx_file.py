"""An ONNX file, looked at before it runs and then opened by onnxruntime.

Refused before: data in other files, operators that are not ONNX's own, functions, control flow, random numbers. While a
model is loaded and runs, onnxruntime holds sizes against what is stored; memory and time are bounded.
"""

from __future__ import annotations

import contextlib
import gzip
import importlib.util
import os
import threading
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from roadgeo._arrays import AnyArray
from roadgeo.errors import ModelError, how_to_install
from roadgeo.storage.memory import bounded
from roadgeo.storage.protobuf import message_types

__all__ = ["OnnxModel", "Port", "open_onnx"]

#: A packed model may unpack to this many bytes, and beyond them to a multiple of its size: numbers hardly shrink, and
#: two bytes of a message take 60 of memory when they are looked at.
_FREE, _TIMES = 16 << 20, 4
_MAX_PARTS = 20_000  # operators, and tensors
_MAX_MEMORY = 4 << 30  # bytes of all open models, with their working memory
_MAX_SECONDS = 600.0  # of one tile

_RANDOM = {"RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike", "Multinomial", "Bernoulli"}
#: Operators on text, of which a few numbers make any amount.
_TEXT = {"StringConcat", "StringNormalizer", "StringSplit", "RegexFullMatch", "TfIdfVectorizer"}
_ORT = b"ORTM"  # where the file of another format has it, which onnxruntime would read instead
_STRING = 8  # of TensorProto.DataType

#: The checked parts of a file (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto).
_SCHEMA = """
    Model version:1:int64 graph:7:Graph function:25
    Graph node:1:Node stored:5:Tensor sparse:15
    Node output:2 operator:4 attribute:5:Attribute domain:7
    Attribute name:1 number:3:int64 tensor:5:Tensor tensors:10:Tensor graph:6 graphs:11 sparse:22 sparses:23
    Tensor kind:2:int64 external:13 location:14:int64
"""


class Port(NamedTuple):
    """An input or output.

    Attributes
    ----------
    name : str
    kind : str
        Type of its values, as NumPy calls it: "float32", "uint8" ...
    shape : tuple
        Its sizes; None means any, () is an unknown shape.
    """

    name: str
    kind: str
    shape: tuple[int | None, ...]


@dataclass(frozen=True)
class OnnxModel:
    """An open model.

    Attributes
    ----------
    path : str
    inputs, outputs : tuple of Port
    last : dict of str to str
        For each output, the operator that makes it.
    metadata : dict of str to str
        `metadata_props`.
    """

    path: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    last: dict[str, str]
    metadata: dict[str, str]
    _session: Any = field(repr=False)

    def run(self, output: str, values: AnyArray) -> AnyArray:
        """Return an output for the values of the only input.

        Raises
        ------
        ModelError
            It fails, or needs too much memory or time.
        """
        options = _without_telemetry().RunOptions()
        options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")  # a search follows
        watch = threading.Timer(_MAX_SECONDS, setattr, (options, "terminate", True))
        watch.daemon = True
        watch.start()
        try:
            (given,) = self._session.run([output], {self.inputs[0].name: values}, options)
        except Exception as error:  # onnxruntime raises classes of its own, one for each status
            raise ModelError(
                f"{Path(self.path).name}: fails while it runs ({_reason(error)}); is it made for RGB pictures?"
            ) from error
        finally:
            watch.cancel()
        result: AnyArray = given
        return result


def open_onnx(path: str | os.PathLike[str], threads: int = 1) -> OnnxModel:
    """Check that an ONNX file, which may be compressed (`.gz`), is nothing but a network, and open it.

    The number of threads is fixed, so that results are the same on every run.

    Raises
    ------
    ModelError
        onnxruntime is missing; the file is missing, no ONNX, takes too much memory, or holds what is listed above.
    """
    if importlib.util.find_spec("onnxruntime") is None:
        raise ModelError(f"to find the roads in a photograph onnxruntime is needed: {how_to_install('onnxruntime')}")
    name, file = os.fspath(path), Path(path)
    if not file.is_file():
        raise ModelError(f"{name}: no such model file; check the path")
    most = _FREE + _TIMES * file.stat().st_size
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as opened:
            content = opened.read(most + 1)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ModelError(f"{name}: cannot be unpacked ({error}); copy it again") from error
    if len(content) > most:
        raise ModelError(f"{name}: unpacks to more than {_TIMES} times its size; unpack it yourself if you trust it")
    try:
        model = _require_network(content)
    except ModelError as error:
        raise ModelError(f"{name}: {error}") from error
    last = {
        _text(output): _text(name) for node in model.graph[0].node for output in node.output for name in node.operator
    }
    del model  # as large as the file
    try:
        with bounded(name, ModelError):
            session = _open_session(content, threads)
        inputs, outputs = (tuple(map(_port, some)) for some in (session.get_inputs(), session.get_outputs()))
        metadata = dict(session.get_modelmeta().custom_metadata_map)
    except ModelError:
        raise
    except Exception as error:  # as above
        raise ModelError(
            f"{name}: cannot be loaded ({_reason(error)}); is it damaged, or made for a newer version?"
        ) from error
    return OnnxModel(name, inputs, outputs, last, metadata, session)


def _require_network(content: bytes) -> Any:
    """Look through a ModelProto, and return it."""
    from google.protobuf.message import DecodeError

    if content[4:8] == _ORT:
        raise ModelError("in onnxruntime's own format, which cannot be looked at; export it as ONNX")
    try:
        model = message_types(_SCHEMA)["Model"].FromString(content)
    except DecodeError as error:
        raise ModelError("not an ONNX model, or damaged; export it again") from error
    if not model.version or len(model.graph) != 1:
        raise ModelError(f"not an ONNX model, or damaged: it holds {len(model.graph)} graphs; export it again")
    if model.function:
        raise ModelError("holds functions of its own; expected a plain network: export it with its parts inlined")
    (graph,) = model.graph
    if graph.sparse:
        raise ModelError("holds sparse tensors; expected dense ones: export it anew")
    if max(len(graph.node), len(graph.stored)) > _MAX_PARTS:
        raise ModelError(f"has more than {_MAX_PARTS:,} operators or tensors; expected a network for segmentation")
    _require_numbers(graph.stored)
    for node in graph.node:
        _require_plain(node)
    return model


def _require_plain(node: Any) -> None:
    """Refuse an operator that is not ONNX's own, or does more than to compute."""
    operator = "".join(map(_text, node.operator))
    for domain in map(_text, node.domain):
        if domain not in ("", "ai.onnx"):
            raise ModelError(f"uses the operator {domain}.{operator}; expected ONNX's own: export it without others")
    held = node.attribute
    to_text = any(attribute.name == [b"to"] and _STRING in attribute.number for attribute in held)
    uses = {
        "random numbers": operator in _RANDOM,
        "control flow": len(node.operator) > 1 or any(attribute.graph or attribute.graphs for attribute in held),
        "text": operator in _TEXT or (operator == "Cast" and to_text),
        "sparse tensors": any(attribute.sparse or attribute.sparses for attribute in held),
    }
    for what, is_used in uses.items():
        if is_used:
            raise ModelError(f"uses {what} ({operator}); expected a plain network for pictures: export it anew")
    _require_numbers(tensor for attribute in held for tensor in (*attribute.tensor, *attribute.tensors))


def _require_numbers(tensors: Iterable[Any]) -> None:
    """Refuse tensors that lie in another file, or hold text."""
    for tensor in tensors:
        if tensor.external or any(tensor.location):
            raise ModelError("keeps data in another file; expected all in one: save it without external data")
        if _STRING in tensor.kind:
            raise ModelError("holds a tensor of text; expected numbers")


def _without_telemetry() -> Any:
    """Return onnxruntime with its telemetry off: else it keeps an identifier of the device, and sends a report."""
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read while it is imported
    import onnxruntime

    onnxruntime.disable_telemetry_events()  # where the program that uses roadgeo has imported it before
    return onnxruntime


def _open_session(content: bytes, threads: int) -> Any:
    onnxruntime = _without_telemetry()
    _limit_memory()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # errors are raised, and need not be printed too
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads leave the core to others
    options.add_session_config_entry("session.use_env_allocators", "1")  # set by `_limit_memory`
    options.add_session_config_entry("session.load_model_format", "ONNX")  # as checked, whatever else it may be
    # Constants that operators make are made while the model runs, when memory is bounded.
    return onnxruntime.InferenceSession(
        content, options, ["CPUExecutionProvider"], disabled_optimizers=["ConstantFolding"], enable_fallback=0
    )


@cache
def _limit_memory() -> None:
    """Have all models of this process allocate from one arena of a limited size."""
    onnxruntime = _without_telemetry()
    where = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    with contextlib.suppress(Exception):  # a program that uses onnxruntime itself made an arena before
        onnxruntime.create_and_register_allocator(where, onnxruntime.OrtArenaCfg(_MAX_MEMORY, -1, -1, -1))


def _port(port: Any) -> Port:
    """Translate onnxruntime's description of an input or output: tensor(float16), [1, 3, "height", None]."""
    kind = str(port.type).removeprefix("tensor(").removesuffix(")")
    kind = {"float": "float32", "double": "float64"}.get(kind, kind)
    shape = tuple(side if isinstance(side, int) and side > 0 else None for side in port.shape)
    return Port(port.name, kind, shape)


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace")


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
