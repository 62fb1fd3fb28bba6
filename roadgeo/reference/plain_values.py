"""Plain values (dict, list, str, int, float, bool, None) as bytes of an untrusted file.

They are pickled. Only opcodes that can neither call nor refer back are read, and the unpickler knows no names.
"""

from __future__ import annotations

import io
import pickle
from typing import Any, NoReturn

__all__ = ["MAX_PICKLE", "PlainUnpickler", "dump_plain", "load_plain", "require_plain"]

#: Bytes: far above what any reference needs.
MAX_PICKLE = 1 << 20
_MAX_DEPTH = 16

# Opcodes of a protocol-5 pickle of plain values, written without a memo, by the size of their arguments. None looks
# up a name, calls, or refers back; and without back references what comes out is a tree in proportion to the pickle.
_OPCODES = {
    pickle.PROTO: 1,
    pickle.FRAME: 8,
    pickle.MARK: 0,
    pickle.STOP: 0,
    pickle.EMPTY_DICT: 0,
    pickle.SETITEM: 0,
    pickle.SETITEMS: 0,
    pickle.EMPTY_LIST: 0,
    pickle.APPEND: 0,
    pickle.APPENDS: 0,
    pickle.NONE: 0,
    pickle.NEWTRUE: 0,
    pickle.NEWFALSE: 0,
    pickle.BININT: 4,
    pickle.BININT1: 1,
    pickle.BININT2: 2,
    pickle.BINFLOAT: 8,
}
_SIZED_OPCODES = {pickle.LONG1: 1, pickle.SHORT_BINUNICODE: 1, pickle.BINUNICODE: 4}


class PlainUnpickler(pickle.Unpickler):
    """Unpickler whose allow-list is empty: the second lock behind `_opcode_problem`."""

    def find_class(self, module: str, name: str) -> NoReturn:
        """Refuse every name."""
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")


def require_plain(value: Any) -> None:
    """Refuse what is not made of plain values, or nested too deeply.

    Raises
    ------
    TypeError
        It holds something else.
    """
    pending = [(value, 0)]
    while pending:
        item, depth = pending.pop()
        kind = type(item)
        if depth > _MAX_DEPTH:
            raise TypeError(f"values nest deeper than {_MAX_DEPTH}")
        if kind is dict:
            if not all(type(key) is str for key in item):
                raise TypeError("a dict has a key that is no str")
            pending += [(child, depth + 1) for child in item.values()]
        elif kind is list:
            pending += [(child, depth + 1) for child in item]
        elif kind is int and not -(1 << 63) <= item < 1 << 64:
            raise TypeError("an int has more than 64 bits")
        elif kind not in (str, int, float, bool, type(None)):
            raise TypeError(f"a value is no plain dict, list, str, int, float, bool or None but {kind.__name__}")


def dump_plain(value: dict[str, Any]) -> bytes:
    """Pickle plain values, without a memo.

    Raises
    ------
    TypeError
        They hold something else, or too much.
    """
    require_plain(value)
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer, protocol=5)
    pickler.fast = True
    pickler.dump(value)
    if buffer.tell() > MAX_PICKLE:
        raise TypeError(
            f"an index's plain values are too large: got {buffer.tell()} bytes, expected at most {MAX_PICKLE}"
        )
    return buffer.getvalue()


def _opcode_problem(pickled: bytes) -> str:
    """Walk over a pickle without running it; '' when it holds only plain opcodes and ends with its STOP."""
    at = 0
    while at < len(pickled):
        opcode = pickled[at : at + 1]
        at += 1
        if opcode in _OPCODES:
            at += _OPCODES[opcode]
        elif opcode in _SIZED_OPCODES:
            width = _SIZED_OPCODES[opcode]
            at += width + int.from_bytes(pickled[at : at + width], "little")
        else:
            return f"opcode {opcode!r} is not allowed"
        if opcode == pickle.STOP:
            return "" if at == len(pickled) else "something follows its end"
    return "it is truncated"


def load_plain(pickled: bytes) -> dict[str, Any]:
    """Unpickle plain values of an untrusted file.

    Raises
    ------
    ValueError
        `dump_plain` did not write them.
    """
    problem = _opcode_problem(pickled)
    if problem:
        raise ValueError(f"its pickle is not one that roadgeo writes: {problem}")
    try:
        value = PlainUnpickler(io.BytesIO(pickled)).load()
        require_plain(value)
    except (
        pickle.UnpicklingError,
        TypeError,
        ValueError,
        AttributeError,
        LookupError,
        EOFError,
        OverflowError,
    ) as error:
        raise ValueError(f"its pickle is not one that roadgeo writes: {error}") from error
    if type(value) is not dict:
        raise ValueError("its pickle holds no dict")
    return value
