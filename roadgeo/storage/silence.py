"""Keeping C libraries quiet: libpng and libjpeg print their warnings on standard error themselves."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["silenced"]

_LOCK = threading.Lock()
_STDERR = 2


@contextmanager
def silenced() -> Iterator[None]:
    """Lead the process's standard error nowhere for as long as a C library decodes something.

    One thread at a time: two that restored it in the wrong order would lose it for good.
    """
    with _LOCK:
        try:
            kept = os.dup(_STDERR)
        except OSError:  # closed: whoever started us wants to hear nothing
            yield
            return
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, _STDERR)
            os.close(nowhere)
            yield
        finally:
            os.dup2(kept, _STDERR)
            os.close(kept)
