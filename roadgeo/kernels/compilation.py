"""Kernels are compiled once per machine; their code is kept in the user's cache folder, never in the package."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba import njit

from roadgeo._folders import cache_dir, private_temporary_dir, writable
from roadgeo._version import __version__

__all__ = ["kernel", "kernel_folder"]

_Function = TypeVar("_Function", bound=Callable[..., Any])


@lru_cache(maxsize=1)
def kernel_folder() -> Path:
    """Return the folder of the kernels' machine code, a temporary one where the user's cache folder cannot be written.

    It is named after all that the code depends on: numba looks at the file of a kernel only, not at those of the
    kernels that it calls.
    """
    digest = hashlib.sha256(f"{numba.__version__} {platform.machine()} {platform.python_version()}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    name = f"kernels-{__version__}-{digest.hexdigest()[:16]}"
    try:
        folder = cache_dir() / name
    except RuntimeError:  # no home
        return private_temporary_dir() / name
    return folder if writable(folder) else private_temporary_dir() / name


def kernel(**options: Any) -> Callable[[_Function], _Function]:
    """Compile a function on its first call, and keep its machine code in `kernel_folder`."""

    def decorate(function: _Function) -> _Function:
        # The setting is read when a function is decorated; it is put back, for it is everyone's.
        config: Any = numba.config
        kept = config.CACHE_DIR
        config.CACHE_DIR = os.environ.get("NUMBA_CACHE_DIR") or str(kernel_folder())
        try:
            compiled: _Function = njit(cache=True, **options)(function)
            return compiled
        finally:
            config.CACHE_DIR = kept

    return decorate
