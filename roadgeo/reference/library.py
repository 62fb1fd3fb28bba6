"""The reference library: references by name, in the user's data folder (or in `ROADGEO_LIBRARY`)."""

from __future__ import annotations

import difflib
import os
import re
import shutil
import unicodedata
from collections.abc import Iterable
from pathlib import Path

from roadgeo.errors import IndexFormatError
from roadgeo.reference.files import ReferencePaths, reference_paths
from roadgeo.reference.network_file import not_a_reference
from roadgeo.reference.remote import fetch_manifest, is_remote
from roadgeo.reference.shards import ENDING, manifest_path
from roadgeo.storage.files import make_folder, writing
from roadgeo.storage.folders import user_dir

__all__ = [
    "library_dir",
    "list_references",
    "make_slug",
    "new_reference",
    "remove_reference",
    "resolve_reference",
    "resolve_references",
    "resolve_whole",
    "shelved_files",
]


def library_dir() -> Path:
    """Folder of the library; it need not exist yet."""
    given = os.environ.get("ROADGEO_LIBRARY")
    if given:
        return Path(given).expanduser()
    return user_dir("Application Support", "XDG_DATA_HOME", ".local/share") / "roadgeo" / "references"


def make_slug(name: str) -> str:
    """Turn a place's name into a file name: "Boston, MA" is `boston-ma`, "São Paulo" is `sao-paulo`."""
    letters = (c for c in unicodedata.normalize("NFKD", name.casefold()) if not unicodedata.combining(c))
    return re.sub(r"[\W_]+", "-", "".join(letters)).strip("-")[:80] or "reference"


def new_reference(name: str) -> Path:
    """Path for a reference of that name in the library, whose folder is made.

    Raises
    ------
    OutputError
        When the folder cannot be made.
    """
    folder = library_dir()
    make_folder(folder)
    return folder / f"{make_slug(name)}.gpkg"


def list_references() -> list[Path]:
    """Every reference in the library, by name; a file without its other half counts, and so do folders of shards."""
    folder = library_dir()
    stems = {file.with_suffix("") for suffix in ("gpkg", "index") for file in folder.glob(f"[!.]*.{suffix}")}
    shards = {path for path in folder.glob(f"[!.]*{ENDING}") if manifest_path(path)}
    return sorted([*(reference_paths(stem).geopackage for stem in stems), *shards])


def resolve_reference(name_or_path: str | os.PathLike[str]) -> Path:
    """Find a reference: a file as given, else one in the library by its name; of a URL, its manifest is fetched.

    Returns
    -------
    Path
        Path of its GeoPackage, which may be absent where the index stands alone; or of its folder of shards.

    Raises
    ------
    IndexFormatError
        When there is neither.
    """
    try:
        name = os.fsdecode(name_or_path)
    except TypeError as error:
        what = type(name_or_path).__name__
        raise IndexFormatError(
            f"{what} is no reference; expected a path, a name, or a reference that is open"
        ) from error
    if not Path(name).name:
        raise IndexFormatError(f"{name!r} names no reference; expected a path such as porto.gpkg, or a name")
    if is_remote(name):
        return fetch_manifest(name)
    for paths in (reference_paths(name), _shelved(name)):
        if paths.geopackage.is_file() or paths.index.is_file():
            return paths.geopackage
    for path in (Path(name), _shelved(name).geopackage.with_suffix("")):
        manifest = manifest_path(path)
        if manifest is not None:
            return manifest.parent
    if Path(name).is_file():
        raise not_a_reference(name)
    names = [path.stem for path in list_references()]
    near = difflib.get_close_matches(make_slug(name), names, n=1)
    hint = f"did you mean {near[0]}?" if near else "`roadgeo reference list` shows the library, `roadgeo index` adds"
    raise IndexFormatError(f"no reference {name!r}, neither as a file nor in {library_dir()}: {hint}")


def resolve_whole(name_or_path: str | os.PathLike[str]) -> Path:
    """Find a reference of one piece (see `resolve_reference`).

    Raises
    ------
    IndexFormatError
        There is no such reference, or it is in shards.
    """
    path = resolve_reference(name_or_path)
    manifest = manifest_path(path) if path.suffix == ENDING else None
    if manifest is not None:
        first = next(path.glob("[!.]*/*.gpkg"), path)
        raise IndexFormatError(f"{path}: is in shards, one piece is needed; name one of them, such as {first}")
    return path


def remove_reference(name: str) -> list[Path]:
    """Delete a reference from the library.

    Returns
    -------
    list of Path
        The files that are gone.

    Raises
    ------
    IndexFormatError
        When the library has no reference of that name.
    OutputError
        When a file cannot be deleted.
    """
    files = shelved_files(name)
    for file in files:
        with writing(file):
            shutil.rmtree(file) if file.is_dir() else file.unlink()
    return files


def shelved_files(name: str) -> list[Path]:
    """Return the files of a reference in the library, or its folder of shards.

    Raises
    ------
    IndexFormatError
        The library has no reference of that name.
    """
    paths = _shelved(name)
    files = [file for file in (paths.index, paths.geopackage) if file.is_file()]
    shards = paths.geopackage.with_suffix(ENDING)
    if manifest_path(shards):
        files.append(shards)
    if not files:
        raise IndexFormatError(f"no reference {name!r} in {library_dir()}; `roadgeo reference list` shows all")
    return files


def _shelved(name: str) -> ReferencePaths:
    """Return where the library keeps a reference of that name; a file's suffix may stand behind it."""
    return reference_paths(
        library_dir() / make_slug(name.removesuffix(".gpkg").removesuffix(".index").removesuffix(ENDING))
    )


def resolve_references(names: Iterable[str]) -> list[Path]:
    """Return the files of references by path or name; none named: all of the library.

    Raises
    ------
    IndexFormatError
        A reference is missing, or the library is empty.
    """
    paths = [resolve_reference(name) for name in names] or list_references()
    if not paths:
        raise IndexFormatError(
            f"the library in {library_dir()} is empty and no --reference was given; build one with `roadgeo index`"
        )
    return paths
