"""The files that a command may open, by its arguments: it is fenced in before it reads anything (`storage.fence`)."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from roadgeo.cli.printing import echo, is_set
from roadgeo.storage.gdal import allowed_drivers

__all__ = ["OWN_PROCESS", "enter_fence", "fence_of", "reference_files"]

#: The object that click's contexts hold where this process runs a command, and nothing besides.
OWN_PROCESS = "own process"

#: Parameters that name references; folders for results; and files or folders of which something may be made.
_REFERENCES, _RESULTS = ("references", "reference", "rebuild"), ("out_dir", "out")
#: Commands that go on from their earlier results: their folder is theirs.
_GOES_ON = ("evaluate", "simulate")
#: Parameters that name plugins, and those for which a network is reached.
_PLUGINS, _REACHING = ("plugin", "segmenter", "products"), ("place", "around", "polygon", "mavlink", "scheduler")
#: Where locks of several processes lie.
_SHARED_MEMORY = "/dev/shm"  # noqa: S108


def enter_fence(command: str, given: Mapping[str, Any], allowed: Iterable[str]) -> None:
    """Fence this process in for a command; where the system cannot do that, print a line with --verbose.

    Parameters
    ----------
    given : mapping
        The command's parameters.
    allowed : iterable of str
        Further files and folders that may be read.
    """
    from roadgeo.storage.fence import abi_version

    if not abi_version():
        if is_set("verbose"):
            said = (
                "No fence: this system has no Landlock (Linux 5.13 and later); what a file names elsewhere is opened."
            )
            echo(said, err=True)
        return
    if not os.isatty(0):  # a file may name the standard input: who waits there for more has no end
        with Path(os.devnull).open("rb") as nothing:
            os.dup2(nothing.fileno(), 0)
    fence_of(command, given, allowed).enter()


def fence_of(command: str, given: Mapping[str, Any], allowed: Iterable[str]) -> Any:
    """Return the fence of a command."""
    from roadgeo.reference.library import library_dir
    from roadgeo.storage.fence import Fence

    library = library_dir()
    is_shelved = command == "index" and not (given["out"] or given["rebuild"])
    write = [str(library)] if is_shelved or library.is_dir() else []
    if given.get("jobs", 1) > 1 or given.get("engine") == "dask" or given.get("scheduler"):
        write.append(_SHARED_MEMORY)
        allowed = [*allowed, "/proc"] if given.get("engine") or given.get("scheduler") else allowed  # Dask looks there
    plugins = _of_plugins(given) if any(given.get(name) for name in _PLUGINS) else []
    read, results = [*allowed, *plugins, *_named(given)], list[str]()
    for reference in _listed(given, _REFERENCES):
        files, folders = reference_files(reference, is_rebuilt=bool(given.get("rebuild")))
        read, write = [*read, *files], [*write, *folders]
    if out := given.get("out_dir"):
        (write if command in _GOES_ON else results).append(os.fspath(out))
        read += _earlier(out, bool(given.get("skip_existing")))
    elif given.get("as_map"):
        results.append(os.curdir)
    if out := given.get("out"):
        read.append(out)
        (write if given.get("shards") is not None else results).append(_target(out, given))
    if given.get("in_place"):
        write += _named({"images": given["images"]})
    kept = [path for folder in results for path in Path(folder).glob("*_mask.tif") if not path.is_symlink()]
    read += map(str, kept)  # of photographs, which are made anew
    return Fence(tuple(read), tuple(dict.fromkeys(results)), tuple(write), _reaches(given, bool(plugins)))


def reference_files(name: str, is_rebuilt: bool = False) -> tuple[list[str], list[str]]:
    """Return the files and folders of a reference, and its folder where its index has to be built."""
    from roadgeo.reference.files import reference_paths
    from roadgeo.reference.index_file import FORMAT_VERSION, read_format_version
    from roadgeo.reference.remote import is_remote

    if is_remote(name):
        return [], []
    paths = reference_paths(name)
    there = (Path(name), Path(f"{name}.shards"), paths.geopackage, paths.index)
    files = [os.fspath(path) for path in there if path.exists()]
    is_new = paths.index.is_file() and read_format_version(paths.index) >= FORMAT_VERSION
    to_build = paths.geopackage.is_file() and (is_rebuilt or not is_new)
    return files, [os.fspath(paths.geopackage.parent)] if to_build else []


def _listed(given: Mapping[str, Any], names: Iterable[str]) -> list[str]:
    """Return the values of parameters that may be lists."""
    values = (given.get(name) or () for name in names)
    return [os.fspath(each) for value in values for each in ((value,) if isinstance(value, str) else value)]


def _named(given: Mapping[str, Any]) -> list[str]:
    """Return all files and folders that values name; behind a colon, too, as of `--source files:roads.geojson`."""
    texts = [text for name, value in given.items() if name not in _RESULTS for text in _texts(value)]
    texts += [text.partition(":")[2] for text in texts if ":" in text]
    paths = []
    for text in texts:
        if os.path.lexists(text):
            paths.append(text)
        elif glob.has_magic(text):
            paths += glob.glob(text, recursive=True)  # noqa: PTH207 - as `running.tasks` reads it
    if (table := given.get("queries")) is not None and not table.is_dir():
        paths.append(os.fspath(table.parent))  # its masks lie beside it
    return paths


def _texts(value: Any) -> Iterator[str]:
    """Yield the texts in a value, for paths are texts."""
    if isinstance(value, str | Path):
        yield os.fspath(value)
    elif isinstance(value, tuple | list):
        for each in value:
            yield from _texts(each)


def _target(out: str, given: Mapping[str, Any]) -> str:
    """Return the folder that `--out` of `roadgeo index` is, or lies in."""
    path = Path(out)
    if given.get("shards") is not None and path.suffix not in (".gpkg", ".index"):
        return os.fspath(path if path.suffix == ".shards" else path.with_name(f"{path.name}.shards"))
    return os.fspath(path.parent)


def _earlier(out: str, skip_existing: bool) -> list[str]:
    """Return results of earlier runs that are read: whose picture they are of, and whether they still hold."""
    from roadgeo.outputs.registry import JSON
    from roadgeo.running.probability_files import ENDING

    endings = (JSON.ending, ENDING) if skip_existing else (JSON.ending,)
    files = Path(out).iterdir() if Path(out).is_dir() else ()
    return [os.fspath(file) for file in files if file.name.endswith(endings)]


def _of_plugins(given: Mapping[str, Any]) -> list[str]:
    """Return the files or folders of the plugins of other packages that are asked for."""
    from importlib.util import find_spec

    from roadgeo.plugins import GROUPS, find_plugins, package_of

    asked = {text.partition(":")[0] for name in _PLUGINS for text in _texts(given.get(name))}
    plugins = [find_plugins(group)[name] for group in GROUPS for name in asked & find_plugins(group).keys()]
    specs = [find_spec(plugin.module.partition(".")[0]) for plugin in plugins if package_of(plugin) != "roadgeo"]
    return [path for spec in specs if spec for path in (spec.submodule_search_locations or [spec.origin or ""])]


def _reaches(given: Mapping[str, Any], plugins: bool) -> bool:
    """Whether a command makes connections."""
    texts = [text for value in given.values() for text in _texts(value)]
    asked = any(given.get(name) for name in _REACHING) or given.get("engine") == "dask"
    fetched = given.get("bbox") and not given.get("roads")
    remote = any("://" in text or text.startswith("/vsi") for text in texts)
    allowed = os.environ.get("PROJ_NETWORK") == "ON" or bool(allowed_drivers())
    return bool(asked or fetched or remote or allowed or plugins)
