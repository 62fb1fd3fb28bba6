"""Names of files as they are published, without the folders of their author.

Paths as they were typed stand in `*_location.json` alone, and on the terminal.
"""

from __future__ import annotations

import csv
import io
import os.path
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache

from roadgeo._text import log_of, visible

__all__ = ["bare_command", "bare_name", "bare_names", "name_for_odm", "table_cell", "table_text", "without_folders"]

_LOG = log_of(__name__)

#: The folders of a path from the root on, of Windows too; a URL's are kept.
_FOLDERS = re.compile(r"(?<![\w.:/\\])(?:[A-Za-z]:)?[/\\]+(?:[^/\\\s:;,'\"]+[/\\])+")


def bare_name(path: str) -> str:
    """Return a file's name without its folders, on Windows too."""
    return re.split(r"[/\\]", path.rstrip("/\\"))[-1] or path


def bare_names(paths: Sequence[str]) -> list[str]:
    """Return the names of files; of those that share one also the folders in which they differ."""
    shared = Counter(map(bare_name, paths))
    alike = [path for path in paths if shared[bare_name(path)] > 1]
    try:
        common = os.path.commonpath([os.path.dirname(path) for path in alike]) if alike else ""  # noqa: PTH120 (text)
    except ValueError:  # some from the root on and others not, or on several drives
        return list(map(bare_name, paths))
    return [os.path.relpath(path, common or ".") if shared[bare_name(path)] > 1 else bare_name(path) for path in paths]


@lru_cache(maxsize=1024)  # warned of once
def name_for_odm(name: str) -> str:
    """Return a picture's name for OpenDroneMap's tables, and warn of spaces, which part columns there."""
    if re.search(r"\s", name):
        text = "%s: OpenDroneMap takes no names with spaces: rename the picture, and in what is written"
        _LOG.warning(text, name)
    return visible(name)


def table_cell(text: str) -> str:
    """Return text for a cell of a table: behind an apostrophe where a spreadsheet would compute it as a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def table_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of cells as CSV; control characters in texts are shown."""
    text = io.StringIO()
    shown = ([visible(cell) if isinstance(cell, str) else cell for cell in row] for row in rows)
    csv.writer(text, lineterminator="\n").writerows(shown)
    return text.getvalue()


def without_folders(text: str, path: str = "") -> str:
    """Return a sentence without the folders of a path and of all that are named from the root on."""
    return _FOLDERS.sub("", text.replace(path, bare_name(path)) if path else text)


def bare_command(command: str) -> str:
    """Return a command line whose files have no folders."""
    try:
        words = shlex.split(command)
    except ValueError:  # a quote that does not end
        return without_folders(command)
    return shlex.join(re.sub(r"^(-[\w-]+=)?(.*[/\\].*)$", _bare_word, word, flags=re.DOTALL) for word in words)


def _bare_word(match: re.Match[str]) -> str:
    return (match[1] or "") + bare_name(match[2])
