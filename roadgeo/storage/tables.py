"""Text and tables that other programs wrote: in UTF-8 or UTF-16, with commas, semicolons or tabs between columns."""

from __future__ import annotations

import csv
import io
import os
import re
from pathlib import Path

from roadgeo.errors import RoadSourceError

__all__ = ["decode", "read_rows", "read_text"]

_DECIMAL_COMMA = re.compile(r"\s*[-+]?\d*,\d+(?:[eE][-+]?\d+)?\s*")


def decode(stored: bytes, errors: str = "strict") -> str:
    """Return text in UTF-8, or in UTF-16 where it begins with that byte order mark."""
    return stored.decode("utf-16" if stored[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", errors)


def read_text(path: str | os.PathLike[str], expected: str) -> str:
    """Return the text of a file.

    Raises
    ------
    RoadSourceError
        It cannot be read, or is no text.
    """
    try:
        return decode(Path(path).read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        cause = error.strerror if isinstance(error, OSError) else error
        raise RoadSourceError(f"cannot read {path}: {cause}; expected {expected}") from error


def read_rows(text: str) -> list[dict[str, str]]:
    """Return the rows of a table by its columns' names; decimal commas, between other separators, as points.

    Raises
    ------
    csv.Error
        It is no table.
    """
    head = text.partition("\n")[0]
    separator = max(",;\t", key=head.count)
    rows = list(csv.DictReader(io.StringIO(text, newline=""), delimiter=separator))
    if separator == ",":
        return rows
    return [
        {
            name: value.replace(",", ".") if isinstance(value, str) and _DECIMAL_COMMA.fullmatch(value) else value
            for name, value in row.items()
        }
        for row in rows
    ]
