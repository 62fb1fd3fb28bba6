"""Which masks a batch locates, and under which names their results go."""

from __future__ import annotations

import glob
import hashlib
import logging
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from roadgeo._text import visible
from roadgeo.outputs.registry import is_result, result_endings
from roadgeo.running.probability_files import ENDING, is_ours

__all__ = ["SUFFIXES", "Task", "find_masks", "name_tasks"]

_LOG = logging.getLogger(__name__)

#: Suffixes of the files that a folder is searched for.
SUFFIXES = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".jp2", ".bmp", ".pgm", ".webp", ".vrt", ".img", ".npy")


#: File systems take names of 255 bytes; outputs, and their temporary names, need the rest.
_MAX_STEM_BYTES = 180


@dataclass(frozen=True)
class Task:
    """One mask, and the stem of its results' names."""

    mask: str
    stem: str

    @property
    def query(self) -> str:
        """Name of the mask in results: its path, with bytes that are no text as escapes."""
        return os.fsencode(self.mask).decode(errors="backslashreplace")


def find_masks(arguments: Sequence[str], recursive: bool = False) -> list[str]:
    """Expand folders (their images, not our own results) and patterns, which not every shell expands; keep the rest.

    Images in folders within folders are found with `recursive`; else a message mentions them.
    """
    found: list[str] = []
    for argument in arguments:
        if Path(argument).is_dir():
            endings = result_endings()
            found += sorted(str(path) for path in _images_in(Path(argument), endings, recursive))
            if not recursive:
                _tell_passed_over(Path(argument), endings)
        elif glob.has_magic(argument) and not Path(argument).exists():
            found += sorted(glob.glob(argument, recursive=True)) or [argument]  # noqa: PTH207 (patterns may be absolute)
        else:
            found.append(argument)
    return found


def _images_in(folder: Path, endings: tuple[str, ...], recursive: bool) -> Iterator[Path]:
    """Yield the images of a folder, and of all within it, but for results, whose names have such endings."""
    for root, folders, names in os.walk(folder):
        folders[:] = [name for name in sorted(folders) if recursive and not name.startswith(".")]
        yield from (path for path in (Path(root, name) for name in sorted(names)) if _is_mask(path, endings))


def _tell_passed_over(folder: Path, endings: tuple[str, ...]) -> None:
    """Mention images in folders within a folder."""
    first = next((path for path in _images_in(folder, endings, recursive=True) if path.parent != folder), None)
    if first is not None:
        _LOG.warning(
            "%s: images in folders within it, such as %s, are passed over; --recursive takes them too",
            *(visible(str(one)) for one in (folder, first.relative_to(folder))),
        )


def _is_mask(path: Path, endings: tuple[str, ...]) -> bool:
    if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or is_result(path.name, endings):
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
        taken = Counter(stem.casefold() for stem in stems)  # one name to file systems that ignore case
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
    whole = f"{format_}_{_digest(os.fspath(path))}"
    return [_shortened(stem) for stem in (path.stem, folder, format_, whole, f"{whole}_{n + 1}")]


def _shortened(stem: str) -> str:
    """Leave room for the ending of a stem; a digest distinguishes names that differ later on or are no text."""
    name = os.fsencode(stem)
    if len(name) <= _MAX_STEM_BYTES and visible(stem) == stem:
        return stem
    name = "".join(letter if visible(letter) == letter else "_" for letter in stem).encode()
    kept = name[: _MAX_STEM_BYTES - 9].decode(errors="ignore")
    return f"{kept}_{_digest(stem)}"


def _digest(text: str) -> str:
    return hashlib.blake2b(os.fsencode(text), digest_size=4).hexdigest()
