"""Which masks a batch locates, and under which names their results go."""

from __future__ import annotations

import glob
import hashlib
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from roadgeo.outputs.registry import is_result
from roadgeo.running.probability_files import ENDING, is_ours

__all__ = ["SUFFIXES", "Task", "find_masks", "name_tasks"]

#: What a folder is searched for.
SUFFIXES = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".jp2", ".bmp", ".pgm", ".webp", ".vrt", ".img", ".npy")


@dataclass(frozen=True)
class Task:
    """One mask, and the stem of its results' names."""

    mask: str
    stem: str


def find_masks(arguments: Sequence[str]) -> list[str]:
    """Expand folders (their images, not our own results) and patterns, which not every shell expands; keep the rest."""
    found: list[str] = []
    for argument in arguments:
        if Path(argument).is_dir():
            found += sorted(str(path) for path in Path(argument).iterdir() if _is_mask(path))
        elif glob.has_magic(argument) and not Path(argument).exists():
            found += sorted(glob.glob(argument, recursive=True)) or [argument]  # noqa: PTH207 (patterns may be absolute)
        else:
            found.append(argument)
    return found


def _is_mask(path: Path) -> bool:
    if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or is_result(path.name):
        return False
    return not (path.name.endswith(ENDING) and is_ours(path))


def name_tasks(masks: Sequence[str]) -> list[Task]:
    """Give each mask the stem of its own name; those that would share one get more of their path, until none does.

    So a stem depends on the other masks only where names meet, and then on the mask's path, not on the others' order.
    """
    known = [_stems(mask, n) for n, mask in enumerate(masks)]
    used = [0] * len(masks)
    while True:
        stems = [stems[level] for stems, level in zip(known, used, strict=True)]
        taken = Counter(stem.casefold() for stem in stems)  # one name to file systems that do not tell cases apart
        shared = [n for n, stem in enumerate(stems) if taken[stem.casefold()] > 1 and used[n] < len(known[n]) - 1]
        if not shared:
            return [Task(mask, stem) for mask, stem in zip(masks, stems, strict=True)]
        for n in shared:
            used[n] += 1


def _stems(mask: str, n: int) -> list[str]:
    """Return longer and longer stems for the n-th mask: its name, its folder, its format, its path, its number."""
    path = Path(mask).absolute()
    folder = f"{path.parent.name}_{path.stem}"
    format_ = f"{folder}_{path.suffix.lower().removeprefix('.')}"
    whole = f"{format_}_{hashlib.blake2b(os.fsencode(path), digest_size=4).hexdigest()}"
    return [path.stem, folder, format_, whole, f"{whole}_{n + 1}"]
