"""Process groups of programs that tests start."""

import os
import time
from contextlib import suppress
from pathlib import Path

__all__ = ["is_gone"]

PROC = Path("/proc")


def is_gone(group: int, within_s: float = 10.0) -> bool:
    """Whether every process of a group ends within a time; that it has ended may be told to nobody (in a container)."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        if PROC.is_dir() and all(state == "Z" for state in states(group)):
            return True
        time.sleep(0.02)
    return False


def states(group: int) -> list[str]:
    """Return a letter for each process of a group, as Linux has it; Z has ended."""
    found = []
    for path in PROC.glob("[0-9]*/stat"):
        with suppress(OSError):  # ended meanwhile
            state, _, its_group = path.read_text().rpartition(")")[2].split()[:3]
            found += [state] if int(its_group) == group else []
    return found
