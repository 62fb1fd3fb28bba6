"""One run: calling roadgeo, passing on its messages, and loading its results, styled."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingLayerPostProcessorInterface,
    QgsProcessingUtils,
    QgsProject,
)
from qgis.PyQt import sip
from qgis.PyQt.QtCore import QUrl
from qgis.PyQt.QtGui import QDesktopServices
from qgis.utils import iface

from .runner import in_words_of_qgis, run
from .settings import NOT_FOUND, locate_command, remembered_references

__all__ = ["PICTURE_KEPT", "POINTS_KEPT", "Finding", "Session", "Shelved", "library"]

#: Properties of the layer that shows a footprint: the picture, and its matched intersections, to mend it by hand.
PICTURE_KEPT, POINTS_KEPT = "roadgeo/picture", "roadgeo/points"

#: Exit statuses of roadgeo: all well, and something was not located, which are no errors; an error.
_WELL, _ERROR = (0, 3), 1


@dataclass(frozen=True)
class Shelved:
    """A reference in roadgeo's library: its name, and its files."""

    name: str
    files: tuple[str, ...]


#: Contents of the library, and when they were asked for: the dialog of a batch has many lists of references.
_SHELVED: list[Shelved] = []
_ASKED, _FRESH_S = [-1e9], 5.0


def library(fresh: bool = False) -> list[Shelved]:
    """List the references in roadgeo's library, as its program knows them."""
    command = locate_command()
    if command is not None and (fresh or time.monotonic() - _ASKED[0] > _FRESH_S):
        lines: list[str] = []
        run([*command, "reference", "list", "--json"], lambda _, line: lines.append(line), lambda: False)
        found = [document for document in map(_parse, lines) if document is not None]
        _SHELVED[:] = [
            Shelved(Path(next(iter(one["files"]))).stem, tuple(one["files"])) for one in found if one.get("files")
        ]
        _ASKED[0] = time.monotonic()
    return list(_SHELVED)


@dataclass(frozen=True)
class Finding:
    """The result of a search for a picture, for the message bar.

    Attributes
    ----------
    name, picture, points, page : str
        Name of the picture; the files of it, of its matched intersections and of the report, "" where there is none.
    location : dict
        Output of the program.
    parameters : dict
        Parameters of the algorithm.
    """

    name: str
    picture: str
    points: str
    page: str
    location: dict[str, Any]
    parameters: dict[str, Any]


class _Styler(QgsProcessingLayerPostProcessorInterface):
    """Gives a layer the style that roadgeo wrote with it, where Processing would pick one at random, and its place.

    That is on top, in a group of results where it has a name; or below all (None). `kept` becomes
    custom properties of the layer, which the project keeps.
    """

    def __init__(self, group: str | None, kept: Mapping[str, str]) -> None:
        super().__init__()
        self.group, self.kept = group, dict(kept)

    def postProcessLayer(self, layer: Any, context: Any, feedback: Any) -> None:  # noqa: ARG002 (QGIS's signature)
        layer.loadDefaultStyle()
        layer.triggerRepaint()
        for key, value in self.kept.items():
            layer.setCustomProperty(key, value)
        if self.group != "":
            _move(layer, self.group)


def _move(layer: Any, group: str | None) -> None:
    """Put a layer that was just added on top of a group of the project, which is made; or below all (None)."""
    root = QgsProject.instance().layerTreeRoot()
    node = root.findLayer(layer.id())
    if node is None:
        return
    there = root if group is None else root.findGroup(group) or root.insertGroup(0, group)
    if node.parent() is not there or group is None:
        there.insertChildNode(-1 if group is None else 0, node.clone())
        node.parent().removeChildNode(node)


#: QGIS deletes a styler with its context, but keeps no reference to its Python object.
_STYLERS: list[_Styler] = []


def _new_styler(group: str | None, kept: Mapping[str, str]) -> _Styler:
    _STYLERS[:] = [styler for styler in _STYLERS if not sip.isdeleted(styler)]
    _STYLERS.append(_Styler(group, kept))
    return _STYLERS[-1]


class Session:
    """Calls of the executable on behalf of an algorithm.

    Attributes
    ----------
    documents : list of dict
        The JSON objects that it printed.
    pages : list of Path
        Reports to open when all is done.
    finding : Finding or None
        The result to report then.
    """

    def __init__(self, context: Any, feedback: Any, labels: Mapping[str, str]) -> None:
        self.context, self.feedback, self.labels = context, feedback, labels
        self.documents: list[dict[str, Any]] = []
        self.errors: list[str] = []
        self.pages: list[Path] = []
        self.finding: Finding | None = None
        self._step = ""

    def call(self, *arguments: str, some_may_fail: bool = False) -> list[dict[str, Any]]:
        """Run roadgeo with some arguments and return the JSON objects that it printed; none once cancelled.

        Raises
        ------
        QgsProcessingException
            It is not there, or it failed; with `some_may_fail` an error beside results is only shown.
        """
        command = locate_command()
        if command is None:
            raise QgsProcessingException(NOT_FOUND)
        self.feedback.pushCommandInfo(shlex.join([*command, *arguments]))
        status = run([*command, *arguments], self._hear, self.feedback.isCanceled)
        if self.feedback.isCanceled():
            return []
        in_part = some_may_fail and status == _ERROR and self.documents
        if status not in _WELL and not in_part:
            raise QgsProcessingException("\n".join(self.errors) or f"roadgeo ended with status {status}")
        for error in self.errors:
            self.feedback.reportError(error)
        return self.documents

    def _hear(self, stream: str, line: str) -> None:
        """Take one line: results and progress are JSON objects, all else is for people."""
        document, line = _parse(line), in_words_of_qgis(line, self.labels)
        if document is not None and "progress" in document:
            progress = document["progress"]
            self.feedback.setProgress(100.0 * progress["done"] / progress["total"])
            self._go_on(progress["text"])
        elif document is not None and stream == "stdout":
            self.documents.append(document)
        elif line.startswith("Error: "):
            self.errors.append(line.partition("Error: ")[2])
        elif line.endswith(" ..."):
            self._go_on(line.rpartition(" ...")[0])
        elif line.strip() and not line.startswith(("Usage: ", "Try 'roadgeo ")):
            self.feedback.pushInfo(line)

    def _go_on(self, step: str) -> None:
        """Show the step that runs now, once, for QGIS logs it."""
        if step != self._step:
            self.feedback.setProgressText(step)
        self._step = step

    def show(
        self, path: Path, title: str, layer: str = "", group: str | None = "", kept: Mapping[str, str] | None = None
    ) -> str:
        """Have a result loaded when all is done (see `_Styler`); return the name by which QGIS opens it."""
        source = f"{path}|layername={layer}" if layer else str(path)
        project = self.context.project()
        if project is not None and not self.feedback.isCanceled():
            hint = QgsProcessingUtils.LayerHint.Vector if layer else QgsProcessingUtils.LayerHint.Raster
            details = QgsProcessingContext.LayerDetails(title, project, title, hint)
            details.forceName = True
            details.setPostProcessor(_new_styler(group, kept or {}))
            self.context.addLayerToLoadOnCompletion(source, details)
        return source

    def show_map(self, reference: str) -> None:
        """Have the roads of a reference, named or a file, loaded below all else, where the project has them not yet."""
        files = [reference, *(file for one in library() if one.name == reference for file in one.files)]
        files += [path for path in remembered_references() if Path(path).stem == reference]
        path = next((Path(one) for one in files if one.endswith(".gpkg") and Path(one).is_file()), None)
        project = self.context.project()
        if path is None or project is None:
            return
        shown = {layer.source() for layer in project.mapLayers().values()}
        if f"{path}|layername=roads" not in shown:
            self.show(path, f"{path.stem} roads", "roads", None)

    def tell(self, *command: str) -> list[str]:
        """Run another program, pass on its output, and return its lines.

        Raises
        ------
        QgsProcessingException
            It failed, or was cancelled.
        """
        lines: list[str] = []

        def hear(_: str, line: str) -> None:
            lines.append(line)
            self.feedback.pushInfo(line)

        self.feedback.pushCommandInfo(shlex.join(command))
        try:
            status = run(command, hear, self.feedback.isCanceled)
        except OSError as error:
            raise QgsProcessingException(f"{command[0]} cannot be run: {error}") from error
        if status != 0 or self.feedback.isCanceled():
            last = lines[-1] if lines else f"status {status}"
            raise QgsProcessingException(f"{Path(command[0]).name} failed: {last}")
        return lines

    def open_pages(self) -> None:
        """Show reports in the browser, where there is a window."""
        for page in self.pages if iface is not None else []:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(page)))


def _parse(line: str) -> dict[str, Any] | None:
    if not line.startswith("{"):
        return None
    try:
        document = json.loads(line)
    except ValueError:
        return None
    return document if isinstance(document, dict) else None
