"""Which masks a batch locates, and under which names their results go."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from roadgeo._text import log_of, visible
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.registry import JSON, is_result, result_endings
from roadgeo.running.probability_files import ENDING, is_ours

__all__ = ["SUFFIXES", "VIDEOS", "Task", "find_masks", "in_natural_order", "name_tasks"]

_LOG = log_of(__name__)

#: Suffixes of the files that a folder is searched for, as `storage.rasters` reads them.
SUFFIXES = (
    *(".tif", ".tiff", ".jpg", ".jpeg", ".jpe", ".jfif", ".jp2", ".j2k", ".webp", ".png", ".bmp", ".gif"),
    *(".pgm", ".ppm", ".pnm", ".pbm", ".pam", ".pfm", ".vrt", ".img", ".npy"),
    *(".j2c", ".jpc", ".jpf", ".jpx", ".dib", ".btf", ".tf8", ".gtiff"),
)
#: Suffixes of videos as cameras, phones and links write them, of which `track` takes frames.
VIDEOS = (
    *(".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mpg", ".mpeg", ".ts", ".webm", ".wmv", ".mts", ".m2ts", ".m2t", ".mod"),
    *(".tod", ".vob", ".3gp", ".3gpp", ".3g2", ".flv", ".f4v", ".lrv", ".insv", ".360", ".asf", ".ogv", ".ogm", ".mxf"),
    *(".dv", ".m1v", ".m2v", ".mpv", ".h264", ".264", ".avc", ".h265", ".265", ".hevc", ".ivf", ".av1", ".mjpeg"),
    *(".mjpg", ".y4m", ".nut", ".divx", ".xvid", ".rm", ".rmvb"),
    *(".qt", ".mpe", ".mp4v", ".trp", ".wtv", ".gxf", ".amv"),
)
#: Files that lie beside pictures, and that nobody expects to be pictures: world files, side files, indexes, text.
_BESIDE = re.compile(
    r"\.(\w{1,4}wx?|wldx?|prj|qpj|xml|xmp|ovr|msk|aux|rrd|qml|qgs|qgz|index|txt|md|csv|tsv|json|html?|log|ya?ml|toml|srt)"
)

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


def find_masks(arguments: Sequence[str], recursive: bool = False, suffixes: tuple[str, ...] = SUFFIXES) -> list[str]:
    """Expand folders (their images, not our own results) and patterns, which not every shell expands; keep the rest.

    Numbers in names count as numbers: frame_2 comes before frame_10. Images in folders within folders are found with
    `recursive`; else a message mentions them. Another mentions what is passed over: other formats, videos.
    """
    masks: list[str] = []
    for argument in arguments:
        if Path(argument).is_dir():
            masks += _images_in(Path(argument), recursive, suffixes)
        elif glob.has_magic(argument) and not Path(argument).exists():
            names = glob.glob(argument, recursive=True)  # noqa: PTH207 (patterns may be absolute)
            masks += _in_order(names) or [argument]
        else:
            masks.append(argument)
    return masks


def in_natural_order(name: str, decimals: bool = True) -> list[str | tuple[int, str]]:
    """Return a key by which names are sorted as people count: numbers within them by their values.

    One point between two numbers makes a decimal, where `decimals` is true; more of them part a date or a version.
    """
    number = r"((?<![\d.])\d+\.\d+(?!\.?\d)|\d+)" if decimals else r"(\d+)"
    parts = [part.partition(".") if k % 2 else part for k, part in enumerate(re.split(number, name))]
    return [part if isinstance(part, str) else (int(part[0]), part[2]) for part in parts]


def _in_order(names: Iterable[str]) -> list[str]:
    """Sort names, and print a line where decimals in them may mean something else."""
    ordered = sorted(names, key=in_natural_order)
    whole = sorted(ordered, key=partial(in_natural_order, decimals=False))
    if ordered != whole:
        first = next(k for k, (one, other) in enumerate(zip(ordered, whole, strict=True)) if one != other)
        _LOG.warning(
            "numbers in names are read as decimals: %s comes before %s; where digits after the point are whole numbers "
            "(of nanoseconds, say), give them as many digits each",
            Path(ordered[first]).name,
            Path(whole[first]).name,
        )
    return ordered


def _images_in(folder: Path, recursive: bool, suffixes: tuple[str, ...]) -> list[str]:
    """Return the images of a folder, and of all within it, but for results; mention what is passed over."""
    endings, names = result_endings(), [name for name in _walk(folder) if not Path(name).name.startswith(".")]
    here = [name for name in names if recursive or Path(name).parent == folder]
    images = [name for name in names if _is_mask(Path(name), endings, suffixes)]
    unread = Counter(_suffix(name) for name in {*here} - {*images} if not _is_beside(Path(name), endings))
    if unread:
        listed = ", ".join(f"{n} {suffix}" for suffix, n in sorted(unread.items()))
        hint = "formats that are not read from a folder; convert them, or give them by name"
        if unread.keys() & {*VIDEOS} - {*suffixes}:
            hint = "of videos take frames, or follow them with `roadgeo track`"
        _LOG.warning("%s: passed over: %s: %s", folder, listed, hint)
    beyond = [] if recursive else [name for name in images if Path(name).parent != folder]
    if beyond:
        _LOG.warning(
            "%s: images in folders within it, such as %s, are passed over; --recursive takes them too",
            folder,
            Path(beyond[0]).relative_to(folder),
        )
    return [name for name in images if recursive or Path(name).parent == folder]


def _walk(folder: Path) -> list[str]:
    """Return all files of a folder and of those within it, but for hidden ones."""
    paths = []
    for root, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        paths += [str(Path(root, name)) for name in names]
    return _in_order(paths)


def _suffix(name: str) -> str:
    return Path(name).suffix.lower() or "without a suffix"


def _is_beside(path: Path, endings: tuple[str, ...]) -> bool:
    """Whether a file is a result, a reference, or lies beside others; or it is a mask that we wrote."""
    is_reference = path.suffix == ".gpkg" and path.with_suffix(".index").exists()
    is_mask = path.suffix.lower() in SUFFIXES
    return is_mask or is_reference or is_result(path.name, endings) or bool(_BESIDE.fullmatch(path.suffix.lower()))


def _is_mask(path: Path, endings: tuple[str, ...], suffixes: tuple[str, ...]) -> bool:
    if path.suffix.lower() not in suffixes or is_result(path.name, endings):
        return False
    return not (path.name.endswith(ENDING) and is_ours(path))


def name_tasks(masks: Sequence[str], out_dir: str | os.PathLike[str] | None = None) -> list[Task]:
    """Give each mask the stem of its own name; those that would share one get more of their path, until none does.

    So do masks whose results would replace another picture's in a folder.

    So a stem depends on the other masks only where names meet, and then on the mask's path, not on the others' order.
    """
    choices = [_stems(mask, n) for n, mask in enumerate(masks)]
    used = [0] * len(masks)
    while True:
        stems = [stems[level] for stems, level in zip(choices, used, strict=True)]
        taken = Counter(stem.casefold() for stem in stems)  # one name to file systems that ignore case
        shared = [
            n
            for n, stem in enumerate(stems)
            if used[n] < len(choices[n]) - 1 and (taken[stem.casefold()] > 1 or _is_anothers(out_dir, stem, masks[n]))
        ]
        if not shared:
            return [Task(mask, stem) for mask, stem in zip(masks, stems, strict=True)]
        for n in shared:
            used[n] += 1


def _is_anothers(out_dir: str | os.PathLike[str] | None, stem: str, mask: str) -> bool:
    """Whether a folder holds a result of that stem of a picture that is not this one by its path, as far as known."""
    if out_dir is None:
        return False
    try:
        document = json.loads(output_paths(out_dir, stem).of(JSON).read_text(encoding="utf-8"))
        query = str(document["query"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return False
    theirs, ours = ([part for part in Path(name).parts if part != ".."] for name in (query, Task(mask, stem).query))
    n = min(len(theirs), len(ours))  # paths may be relative to different folders
    return theirs[-n:] != ours[-n:]


def _stems(mask: str, n: int) -> list[str]:
    """Return longer and longer stems for the n-th mask: its name, its folder, its format, its path, its number."""
    page = re.match(r"GTIFF_DIR:(\d+):", mask)
    path = Path(mask[page.end() :] if page else mask).absolute()
    path = path.with_stem(f"{path.stem}_page{page[1]}") if page else path
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
