"""SQLite files of strangers: only plain tables are read, in an amount of work that their size accounts for.

A view may be an endless query, a generated column or a default value may be a thousand times larger than the file, and
pages may be shared between branches of a tree until its rows never end.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

__all__ = ["opened", "table_problem"]

_MAX_DEFAULT = 100  # characters: a default is added to every row without being stored in it
_STEP = 10_000
_STEPS, _STEPS_PER_BYTE = 20_000_000, 20  # of SQLite's machine; a row of a table takes about one for each of its bytes


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a file read-only, for queries of bounded cost. Errors found by SQLite are `sqlite3.Error`."""
    # Immutable: no lock or journal file appears beside a file that lies in a read-only folder. But while QGIS edits it,
    # the latest state lies in the journal beside it, which an immutable file would not have.
    state = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{state}", uri=True)) as database:
        try:
            _guard(database, path)
            yield database
        except UnicodeDecodeError as error:  # of a message that quotes the file
            raise sqlite3.DatabaseError("its schema is no text") from error


def _guard(database: sqlite3.Connection, path: Path) -> None:
    """Bound what queries on a file may cost: values no larger than it, and steps in proportion to it."""
    size = sum(file.stat().st_size for file in (path, path.with_name(f"{path.name}-wal")) if file.exists())
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(size, 1_000_000), 1_000_000_000))
    left = (_STEPS + _STEPS_PER_BYTE * size) // _STEP

    def spend() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    database.set_progress_handler(spend, _STEP)
    database.execute("PRAGMA trusted_schema = OFF")  # the file's own schema calls no unsafe function


def table_problem(database: sqlite3.Connection, name: str) -> str:
    """Return why a name is no plain table with stored columns; "" where it is one."""
    row = database.execute(
        "SELECT type, sql FROM sqlite_master WHERE lower(name) = lower(?) AND type IN ('table', 'view')", (name,)
    ).fetchone()
    if row is None:
        return f"has no layer '{name}'"
    kind, sql = row
    if kind != "table" or str(sql).split()[:2][-1].upper() == "VIRTUAL":
        return f"'{name}' is a {'view' if kind == 'view' else 'virtual table'}, expected a table"
    columns = database.execute("SELECT name, dflt_value, hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
    for column, default, hidden in columns:
        if hidden or len(str(default)) > _MAX_DEFAULT:
            return f"column '{column}' of '{name}' is computed, expected stored values"
    return ""
