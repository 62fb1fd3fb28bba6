"""Process groups of programs that tests start."""

import os
import time

__all__ = ["is_gone"]


def is_gone(group: int, within_s: float = 10.0) -> bool:
    """Whether every process of a group ends within a time."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False
