"""Where a result leaves: every file that is asked for, all or none, the JSON last."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from roadgeo.errors import CrsError, MaskError, OutputError, RoadgeoError
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.paths import OutputPaths
from roadgeo.outputs.registry import ALWAYS, JSON, REGISTRY, STYLE, Output, find_outputs
from roadgeo.outputs.subject import Subject
from roadgeo.storage.files import replacing

__all__ = ["OutputOptions", "Written", "wanted_outputs", "write_json", "write_location"]


@dataclass(frozen=True)
class OutputOptions:
    """The files to write for a mask.

    Attributes
    ----------
    image : ImageOptions
        How the picture, or without one the mask, is drawn on the map; masks always with the nearest value.
    products : tuple of str
        Further outputs by name: in `outputs.registry`, or a plugin's.
    """

    image: ImageOptions = field(default_factory=ImageOptions)
    products: tuple[str, ...] = ()


class Written(NamedTuple):
    """The result of `write_location`.

    Attributes
    ----------
    location : Location
        With `seconds.write` set.
    files, removed : list of Path
        Files of this run, the JSON first, and outdated files of an earlier run.
    faults : list of str
        Failures of outputs of other packages; everything else is written.
    """

    location: Location
    files: list[Path]
    removed: list[Path]
    faults: list[str]


def wanted_outputs(names: Iterable[str], on_map: bool, has_photo: bool, has_camera: bool = True) -> list[Output]:
    """Return the outputs of a mask: the usual ones, then those asked for, where their requirements are met.

    Raises
    ------
    PluginError
        There is no such output.
    """
    wanted = (output for output in (*ALWAYS, *find_outputs(names)) if output.suits(on_map, has_camera))
    return [output for output in wanted if not (output is STYLE and has_photo)]


def write_location(
    location: Location,
    mask: RoadMask,
    paths: OutputPaths,
    options: OutputOptions | None = None,
    picture: str | os.PathLike[str] | None = None,
    indexes: Sequence[ReferenceIndex] = (),
    explanation: Explanation | None = None,
) -> Written:
    """Write the outputs of a location, all files or none; if a picture cannot be drawn, the JSON alone.

    Files of an earlier run under these names that show a place are removed where no place is known now, so that stale
    results are not mistaken for this run's.

    Parameters
    ----------
    picture : path, optional
        The photograph that the mask was made of: drawn on the map instead of the mask.
    indexes : sequence of ReferenceIndex, optional
        The maps that were searched; pictures of the result and its report show the one that it lies on.
    explanation : Explanation, optional
        For the outputs that show it.

    Raises
    ------
    OutputError
        A file cannot be written; then none is.
    MaskError
        The picture cannot be read or shows another frame than the mask; the place is written all the same.
    CrsError
        The target CRS is unknown or not made for this place; the place is written all the same.
    PluginError
        There is no such output.
    """
    started = perf_counter()
    options = options or OutputOptions()
    photo = None if picture is None else Path(picture)
    subject = Subject(location, mask, paths, options.image, photo, indexes, explanation)
    wanted = wanted_outputs(options.products, location.on_map, photo is not None, location.camera is not None)
    targets = {output: paths.of(output, subject.picture.name) for output in wanted}
    try:
        with ExitStack() as files:
            # Entered first, renamed last: whoever sees the JSON finds the other files whole.
            report = files.enter_context(replacing(targets.pop(JSON), sync=False))
            faults = []
            for output, path in list(targets.items()):
                fault = _write(output, path, subject, files)
                if fault:
                    faults.append(fault)
                    del targets[output]
            removed = list(_remove(_stale(subject, wanted, options.products)))
            if photo is not None:  # an earlier mask's style would colour the photograph
                removed += _remove([paths.of(STYLE)])
            location = location.spending(write=perf_counter() - started)
            write_json(report, replace(subject, location=location))
    except (CrsError, MaskError) as error:
        outdated = {*REGISTRY.values(), *wanted} - {JSON}
        list(_remove([subject.paths.of(output, subject.picture.name) for output in outdated]))
        with replacing(paths.json, sync=False) as report:
            write_json(report, subject)
        raise type(error)(f"{error}; what was found is in {paths.json}") from error
    return Written(location, [paths.json, *targets.values()], removed, faults)


def _write(output: Output, path: Path, subject: Subject, files: ExitStack) -> str:
    """Write one output, which appears with the others; the error of another package's output is returned instead."""
    if output in REGISTRY.values():
        output.write(files.enter_context(replacing(path, sync=False)), subject)
        return ""
    own = ExitStack()
    file = own.enter_context(replacing(path, sync=False))
    try:
        output.write(file, subject)
        file.stat()
    except Exception as error:
        with suppress(Exception):
            own.__exit__(type(error), error, error.__traceback__)
        whose = f"the output {output.name!r} of {output.write.__module__}"
        text = str(error) if isinstance(error, RoadgeoError) else f"{type(error).__name__}: {error}; inform its makers"
        return f"{subject.location.query}: {whose} failed: {' '.join(text.split())}; all else is written"
    files.enter_context(own)
    return ""


def write_json(path: Path, subject: Subject) -> None:
    """Write `Location.to_dict`."""
    path.write_text(json.dumps(subject.location.to_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _stale(subject: Subject, written: Sequence[Output], names: Iterable[str]) -> list[Path]:
    """List outdated files of an earlier run, which show a place or a camera."""
    outputs = dict.fromkeys([*REGISTRY.values(), *find_outputs(names)])
    if subject.location.on_map:
        outputs = dict.fromkeys(output for output in outputs if output.needs_camera and subject.location.camera is None)
    return [subject.paths.of(output, subject.picture.name) for output in outputs if output not in written]


def _remove(paths: Iterable[Path]) -> Iterator[Path]:
    """Delete files, and return those that existed."""
    for path in paths:
        try:
            path.unlink()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise OutputError(
                f"cannot remove {path}, an earlier result that no longer holds: {error.strerror}; remove it yourself"
            ) from error
        yield path
