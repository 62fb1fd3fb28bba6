"""Folders for results."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["make_folder"]


def make_folder(folder: str | os.PathLike[str]) -> None:
    """Make a folder for results, unless it is there, and see that files can be put into it.

    Raises
    ------
    OutputError
        They cannot.
    """
    from roadgeo.errors import OutputError
    from roadgeo.storage.files import writing

    with writing(folder):
        Path(folder).mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write into {folder}: permission denied; choose a folder you may write to")
