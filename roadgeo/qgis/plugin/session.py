"""One run: calling roadgeo, passing on its messages, and loading its results, styled."""

from __future__ import annotations

import itertools
import shlex
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

from .library import find_reference, parse
from .runner import in_words_of_qgis, run
from .settings import NOT_FOUND, locate_command

__all__ = ["PICTURE_KEPT", "POINTS_KEPT", "Finding", "LayerGroup", "Session"]

#: Properties of the layer that shows a footprint: the picture, and its matched intersections, to mend it by hand.
PICTURE_KEPT, POINTS_KEPT = "roadgeo/picture", "roadgeo/points"

#: Exit statuses of roadgeo: all well, and something was not located, which are no errors; an error.
_WELL, _ERROR = (0, 3), 1


@dataclass(frozen=True)
class Finding:
    """The result of a search for a picture, for the message bar.

    Attributes
    ----------
    name, picture, points, page : str
        Name of the picture; the files of it, of its matched intersections and of the report, "" without one.
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


class LayerGroup:
    """A group of results on top of the project's layers: made with its first layer, under a name that no other has."""

    def __init__(self, name: str) -> None:
        self.name, self._node = name, None

    def node(self, root: Any) -> Any:
        """Return it in the tree of layers."""
        if self._node is None or sip.isdeleted(self._node):
            names = (self.name if k == 1 else f"{self.name} ({k})" for k in itertools.count(1))
            self._node = root.insertGroup(0, next(name for name in names if root.findGroup(name) is None))
        return self._node


class _Styler(QgsProcessingLayerPostProcessorInterface):
    """Gives a layer the style that roadgeo wrote with it, where Processing would pick one at random, and its place.

    A layer goes on top of a group of results; or below all layers (None); or stays where it is (""). `kept` becomes
    custom properties of the layer, which the project keeps.
    """

    def __init__(self, group: LayerGroup | str | None, kept: Mapping[str, str]) -> None:
        super().__init__()
        self.group, self.kept = group, dict(kept)

    def postProcessLayer(self, layer: Any, context: Any, feedback: Any) -> None:  # noqa: ARG002 (QGIS's signature)
        layer.loadDefaultStyle()
        layer.triggerRepaint()
        for key, value in self.kept.items():
            layer.setCustomProperty(key, value)
        root = QgsProject.instance().layerTreeRoot()
        node = root.findLayer(layer.id())
        if self.group == "" or node is None:
            return
        into, place = (self.group.node(root), 0) if isinstance(self.group, LayerGroup) else (root, -1)
        into.insertChildNode(place, node.clone())
        node.parent().removeChildNode(node)


#: QGIS deletes a styler with its context, but keeps no reference to its Python object.
_STYLERS: list[_Styler] = []


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
        document, line = parse(line), in_words_of_qgis(line, self.labels)
        if document is not None and "reason" in document:
            document["reason"] = in_words_of_qgis(document["reason"], self.labels)
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
        self,
        path: Path,
        title: str,
        layer: str = "",
        group: LayerGroup | str | None = "",
        kept: Mapping[str, str] | None = None,
    ) -> str:
        """Have a result loaded when all is done (see `_Styler`); return the name by which QGIS opens it."""
        source = f"{path}|layername={layer}" if layer else str(path)
        project = self.context.project()
        if project is not None and not self.feedback.isCanceled():
            if self._is_shown(source):
                group = ""  # QGIS loads no second one, and this may lie where its user wants it
            hint = QgsProcessingUtils.LayerHint.Vector if layer else QgsProcessingUtils.LayerHint.Raster
            details = QgsProcessingContext.LayerDetails(title, project, title, hint)
            details.forceName = True
            styler = _Styler(group, kept or {})
            _STYLERS[:] = [*(one for one in _STYLERS if not sip.isdeleted(one)), styler]
            details.setPostProcessor(styler)
            self.context.addLayerToLoadOnCompletion(source, details)
        return source

    def show_map(self, value: str) -> None:
        """Have the roads of a reference, named or a file, loaded below all else, where the project has them not yet."""
        reference = find_reference(value)
        if reference.file and not self._is_shown(f"{reference.file}|layername=roads"):
            self.show(Path(reference.file), f"{reference.name} roads", "roads", None)

    def _is_shown(self, source: str) -> bool:
        project = self.context.project()
        return project is not None and source in {layer.source() for layer in project.mapLayers().values()}

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
