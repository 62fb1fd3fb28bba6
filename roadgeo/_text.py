"""Text that came from strangers (names of files, of references, in files), made fit to be shown; times in it."""

from __future__ import annotations

import html
import logging
import numbers
import re
from collections.abc import Sequence
from datetime import UTC, datetime

__all__ = ["counted", "in_html", "listed", "log_of", "read_moment", "visible"]

#: Control characters; those that turn the direction of text; line separators; bytes of names that are no text.
_UNSEEN = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def visible(text: str, *, lines: bool = False) -> str:
    r"""Write characters that a terminal obeys instead of showing them as escapes: "\x1b".

    Line ends and tabs become spaces, unless `lines` are to stay.
    """
    if lines:
        return "".join(
            part if part in ("\n", "\t") else _UNSEEN.sub(_escape, part) for part in re.split("([\n\t])", text)
        )
    return _UNSEEN.sub(_escape, re.sub("[\r\n\t]+", " ", text))


def in_html(text: str) -> str:
    """Return text for a page, or for other XML: as it is shown, with characters that would be markup."""
    return html.escape(visible(text, lines=True))


def counted(number: int, noun: str) -> str:
    """Return a count with its noun: "1 road", "2,649 roads"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def listed(names: Sequence[str], most: int = 8) -> str:
    """Return names for a message: "a, b and 3 more"."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def log_of(module: str) -> logging.Logger:
    """Return a module's log; texts in its lines are written as `visible` does."""
    log = logging.getLogger(module)
    log.addFilter(_show)
    return log


def _show(record: logging.LogRecord) -> bool:
    if isinstance(record.args, tuple):
        record.args = tuple(arg if isinstance(arg, numbers.Number) else visible(str(arg)) for arg in record.args)
    return True


def _escape(match: re.Match[str]) -> str:
    return match[0].encode("unicode_escape", "surrogatepass").decode("ascii")


def read_moment(text: str) -> datetime:
    """Read a time; UTC unless it has another zone."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ValueError(f"got {text!r}, expected a time such as 2024-05-01T09:30:00Z") from error
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
