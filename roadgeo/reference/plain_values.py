"""Plain values (dict, list, str, int, float, bool, None) as bytes of an untrusted file.

They are pickled. Only opcodes that can neither call nor refer back are read, and the unpickler knows no names.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from typing import Any, NoReturn

__all__ = ["PlainUnpickler", "dump_plain", "load_plain", "require_plain"]

_MAX_DEPTH = 16

#: Opcodes of a protocol-5 pickle of plain values, written without a memo. None looks up a name, calls, or refers back;
#: and without back references what comes out is a tree in proportion to the pickle.
_OPCODES = {
    *("PROTO", "FRAME", "MARK", "STOP", "EMPTY_DICT", "SETITEM", "SETITEMS", "EMPTY_LIST", "APPEND", "APPENDS", "NONE"),
    *("NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "BINFLOAT", "LONG1", "SHORT_BINUNICODE", "BINUNICODE"),
}


class PlainUnpickler(pickle.Unpickler):
    """Unpickler whose allow-list is empty: the second lock behind `_require_opcodes`."""

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
        They hold something else.
    """
    require_plain(value)
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer, protocol=5)
    pickler.fast = True
    pickler.dump(value)
    return buffer.getvalue()


def _require_opcodes(pickled: bytes) -> None:
    """Walk over a pickle without running it; raise `ValueError` unless all is plain opcodes and it ends with STOP."""
    end = 0
    for opcode, _, at in pickletools.genops(pickled):
        if opcode.name not in _OPCODES:
            raise ValueError(f"opcode {opcode.name} is not allowed")
        end = int(at or 0) + 1
    if end < len(pickled):
        raise ValueError("something follows its end")


def load_plain(pickled: bytes) -> dict[str, Any]:
    """Unpickle plain values of an untrusted file.

    Raises
    ------
    ValueError
        `dump_plain` did not write them.
    """
    try:
        _require_opcodes(pickled)
        value = PlainUnpickler(io.BytesIO(pickled)).load()
        require_plain(value)
    except (pickle.PickleError, TypeError, ValueError, AttributeError, LookupError, EOFError, OverflowError) as error:
        raise ValueError(f"its pickle is not one that roadgeo writes: {error}") from error
    if type(value) is not dict:
        raise ValueError("its pickle holds no dict")
    return value
