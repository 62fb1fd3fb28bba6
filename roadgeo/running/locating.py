"""The work on one mask: it is read, located, written and described. Errors of a mask are caught here."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._progress import Say
from roadgeo._text import log_of
from roadgeo.errors import MaskError, Reason, RoadgeoError, is_of_memory, name_package
from roadgeo.geometry.frame import Frame
from roadgeo.outputs.registry import JSON, REPORT
from roadgeo.running.options import BatchOptions, ReadOptions
from roadgeo.running.pool import Lost
from roadgeo.running.probability_files import is_ours, keep_probability, probability_path
from roadgeo.running.tasks import Task
from roadgeo.storage.fence import remedy
from roadgeo.storage.rasters import require_there

if TYPE_CHECKING:
    from roadgeo.geometry.mask import RoadMask
    from roadgeo.location import Location, Status
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.reference.opening import AnyReference
    from roadgeo.running.passes import Locate, Sighting
    from roadgeo.workflows import LocateOptions

__all__ = ["Locating", "Outcome", "Question", "changed_options"]

_LOG = log_of(__name__)


@dataclass(frozen=True)
class Outcome:
    """The result of one mask.

    Attributes
    ----------
    document : dict
        Its JSON object.
    files, removed : tuple of str
        Written now, and removed because they showed a place that no longer holds.
    photo : tuple of (str, float) or None
        The photograph that was drawn, and its width in widths of the mask.
    earlier : bool
        An earlier run found it; nothing was done now.
    faults : tuple of str
        Errors of outputs of other packages; all other files are written.
    """

    status: Status
    document: dict[str, Any]
    files: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    photo: tuple[str, float] | None = None
    earlier: bool = False
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class Locating:
    """The work for every mask; travels to other processes."""

    references: tuple[str, ...]
    out_dir: str
    options: BatchOptions
    say: Say

    @property
    def outputs(self) -> OutputOptions:
        """The files to write."""
        return self.options.outputs

    def prepare(self) -> Callable[[Task], Outcome]:
        """Open the references."""
        question = self.ask()
        return lambda task: self.do(task, question)

    def ask(self) -> Question:
        """Open the references, and collect the question that every mask is asked."""
        started = perf_counter()
        from roadgeo.reference.opening import open_references

        references = open_references(self.references)
        return Question(references, perf_counter() - started, self._changes())

    def give_up(self, task: Task, lost: Lost) -> Outcome:
        """Make the outcome of a mask that could not be worked on."""
        return self.failed(task, Reason.FAULT, lost.said)

    def failed(self, task: Task, code: Reason, reason: str) -> Outcome:
        """Describe a failure with the keys of every other result."""
        from roadgeo.location import Location

        location = Location(
            task.query, "error", reason, options=self._changes(), command=self._command(task), reason_code=code
        )
        return Outcome("error", location.to_dict())

    def _command(self, task: Task) -> str:
        """Return the command line that makes one result again."""
        if not self.options.command:
            return ""
        photo = self.options.images.get(task.mask)
        drawn = [f"--image={photo}"] if photo else []
        return shlex.join(["roadgeo", "locate", task.query, *drawn, *self.options.command])

    def _changes(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, as plain values for the JSON."""
        usual = BatchOptions()
        reading = replace(self.options.reading, threads=ReadOptions.threads)
        return {
            **changed_options(replace(self.options.search, truths=(), threads=1), usual.search),
            **changed_options(reading, usual.reading),
            **{name: value for name in ("exif", "dem") if (value := getattr(self.options, name))},
            **changed_options(self.outputs.image, usual.outputs.image),
        }

    def do(self, task: Task, question: Question, how: Locate | None = None) -> Outcome:
        """Locate one mask and write its results; the one place where what goes wrong with a mask is caught."""
        try:
            return self.earlier(task, question) or self._locate(task, question, how)
        except RoadgeoError as error:
            return self.failed(task, error.code, str(error))
        except UnicodeEncodeError:  # libraries take no other names
            reason = f"{task.query}: its name is no text, or the picture's; rename it"
            return self.failed(task, Reason.INVALID, reason)
        except Exception as error:  # whatever libraries raise: cv2.error, errors of GDAL, of plugins ...
            if os.environ.get("ROADGEO_TRACEBACK"):
                raise
            if is_of_memory(error):
                reason = f"{task.query}: more memory is needed than there is; reduce it or cut it up"
                return self.failed(task, Reason.MEMORY, reason)
            missing = name_package(error) if isinstance(error, ModuleNotFoundError) else None
            if missing is not None:
                return self.failed(task, Reason.INVALID, f"{task.query}: {missing}")
            what = " ".join(f"{type(error).__name__}: {error}{remedy(str(error))}".split())
            reason = f"{task.query}: {what}; this is a fault of roadgeo, please report it"
            return self.failed(task, Reason.FAULT, reason)

    def earlier(self, task: Task, question: Question) -> Outcome | None:
        """Return the result of an earlier run, if it is whole, the answer to the same question, and younger than it.

        None too where results of before are not to be kept.
        """
        if not self.options.skip_existing:
            return None
        from roadgeo.location import SCHEMA
        from roadgeo.outputs.location_files import wanted_outputs
        from roadgeo.outputs.paths import output_paths

        paths = output_paths(self.out_dir, task.stem)
        try:
            document = json.loads(paths.of(JSON).read_text(encoding="utf-8"))
            if paths.of(JSON).stat().st_mtime < Path(task.mask).stat().st_mtime:
                return None
        except (OSError, ValueError, RecursionError):
            return None
        if not isinstance(document, dict) or (document.get("schema"), document.get("query")) != (SCHEMA, task.query):
            return None
        status, photo = document.get("status"), self.options.photo(task, is_ours(probability_path(paths)))
        if status not in {"located", "ambiguous", "not_located", "chosen"} or not question.same(document):
            return None
        wanted = wanted_outputs(
            self.outputs.products, status in ("located", "chosen"), bool(photo), bool(document.get("camera"))
        )
        files = [paths.of(output, Path(photo or task.mask).name) for output in wanted]
        whole = all(path.is_file() and path.stat().st_size for path in files)
        return Outcome(status, document, earlier=True) if whole else None

    def _locate(self, task: Task, question: Question, how: Locate | None) -> Outcome:
        from roadgeo.outputs.location_files import write_location
        from roadgeo.outputs.paths import output_paths
        from roadgeo.outputs.registry import EXPLANATION
        from roadgeo.reference.opening import digest_of
        from roadgeo.running.choosing import take_place
        from roadgeo.running.queries import locate_query
        from roadgeo.workflows import explain, locate

        started = perf_counter()
        how = how or partial(explain if EXPLANATION.name in self.outputs.products else locate, say=self.say)
        options = self.search_options(task)
        paths, reading, sighting = output_paths(self.out_dir, task.stem), self.options.reading, None
        if self.options.taken is not None:
            sighting = self._take(task, question, options)
        if sighting is None:
            sighting = locate_query(task.mask, question.references, options, reading, how=how, say=self.say)
            if self.options.taken is not None:
                sighting = sighting.answering(take_place(sighting.location, self.options.taken, options))
        location, mask, explanation = sighting.location, sighting.mask, sighting.explanation
        # the clock of the search knows its own steps only: the rest was reading
        spent = location.seconds
        reading_s = perf_counter() - started - spent.vectorize - spent.match - spent.refine
        location = replace(
            _on_ground(location.spending(open=question.seconds, read=max(reading_s, 0.0)), self.options.dem),
            query=task.query,
            options=question.options,
            command=self._command(task),
            reference_digest=digest_of(question.references, location.reference),
        )
        photo = self.options.photo(task, sighting.of_photograph)
        explanation = explanation and replace(explanation, location=location)
        kept = keep_probability(sighting.probability, paths)
        indexes = [reference.index_of(location) for reference in question.references]
        outputs = self.outputs if mask.roads.any() else _without_views(self.outputs)
        written = write_location(location, mask, paths, outputs, photo, indexes, explanation)
        return Outcome(
            location.status,
            written.location.to_dict(),
            tuple(map(str, (*written.files, *kept))),
            tuple(map(str, written.removed)),
            (photo, _scale(photo, mask)) if photo and location.on_map else None,
            faults=tuple(written.faults),
        )

    def _take(self, task: Task, question: Question, options: LocateOptions) -> Sighting | None:
        """Take a place of the last answer for an image; None, with a warning, where there is no such answer."""
        from roadgeo.outputs.location_document import read_answer
        from roadgeo.outputs.paths import output_paths
        from roadgeo.running.choosing import take_again
        from roadgeo.sources.georeference import read_stated

        paths, taken = output_paths(self.out_dir, task.stem), self.options.taken
        try:
            answer = read_answer(paths.of(JSON))
        except MaskError:
            answer = None
        if answer is None or answer.query != task.query or not answer.places or taken is None:
            require_there(task.mask)
            _LOG.warning("%s: no earlier answer lies in %s: searching first", task.query, self.out_dir)
            return None
        kept = probability_path(paths)
        sighting = take_again(answer, taken, task.mask, kept, question.references, self.options.reading, options)
        return sighting.showing(stated=read_stated(task.mask).middle)

    def search_options(self, task: Task) -> LocateOptions:
        """Return the options, with the hints that the image's camera states where they were asked for."""
        if not self.options.exif:
            return self.options.search
        from roadgeo.matching.hints import apply_hints
        from roadgeo.sources.camera import read_stated

        stated = read_stated(self.options.exif, task.mask, self.options.images.get(task.mask))
        return apply_hints(self.options.search, stated)


def _without_views(outputs: OutputOptions) -> OutputOptions:
    """Leave out the views of a mask's roads: it has no roads."""
    from roadgeo.outputs.registry import EXPLANATION, EXPLANATION_PICTURE

    views = {REPORT.name, EXPLANATION.name, EXPLANATION_PICTURE.name}
    return replace(outputs, products=tuple(name for name in outputs.products if name not in views))


@dataclass(frozen=True)
class Question:
    """The question that every mask of a batch is asked: references and options; `seconds` were spent to open them."""

    references: list[AnyReference]
    seconds: float
    options: dict[str, Any]

    def same(self, document: Mapping[str, Any]) -> bool:
        """Whether an earlier result answers the same question; without a question in it, it does."""
        options, digest = document.get("options"), document.get("reference_digest")
        same_maps = digest is None or set(digest.split(", ")) <= {reference.digest for reference in self.references}
        return same_maps and (options is None or options == self.options)


def changed_options(options: Any, usual: Any) -> dict[str, Any]:
    """Return the fields of options that differ from the usual ones as plain values; of nested ones likewise."""
    changed = _changed(dataclasses.asdict(options), dataclasses.asdict(usual))
    plain: dict[str, Any] = json.loads(json.dumps(changed, default=repr))
    return plain


def _changed(values: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    changed = {name: value for name, value in values.items() if value != usual.get(name)}
    return {
        name: _changed(value, usual[name]) if isinstance(value, dict) and isinstance(usual.get(name), dict) else value
        for name, value in changed.items()
    }


def _on_ground(location: Location, dem: str) -> Location:
    """Return an answer with the height of the ground in its frame, where a terrain model knows that."""
    place = location.place
    if not dem or place is None:
        return location
    from roadgeo.sources.elevation import ground_heights

    heights = ground_heights(dem, place.to_crs(Frame(*place.size).grid(7, 0.05)), place.crs)
    finite = heights[np.isfinite(heights)]
    if not len(finite):
        return location
    placed = replace(place, ground_m=(float(finite.mean()), float(finite.std())))
    return replace(location, places=(placed, *location.places[1:]))


def _scale(picture: str, mask: RoadMask) -> float:
    """How many times the mask's width a picture's is."""
    from roadgeo.storage.rasters import raster_size

    return round(raster_size(picture)[0] / mask.shape[1], 3)
