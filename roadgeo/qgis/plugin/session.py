"""One run: calling roadgeo, passing on what it says, and loading its results, styled."""

from __future__ import annotations

import json
import shlex
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

from .runner import run
from .settings import NOT_FOUND, locate_executable

__all__ = ["Session"]

#: Exit statuses of roadgeo: all well, and something was not located, which are no errors; an error.
_WELL, _ERROR = (0, 3), 1


class _Styler(QgsProcessingLayerPostProcessorInterface):
    """Gives a layer the style that roadgeo wrote with it, where Processing would pick one at random, and its group."""

    def __init__(self, group: str) -> None:
        super().__init__()
        self.group = group

    def postProcessLayer(self, layer: Any, context: Any, feedback: Any) -> None:  # noqa: ARG002 (QGIS's signature)
        layer.loadDefaultStyle()
        layer.triggerRepaint()
        if self.group:
            _move_to_group(layer, self.group)


def _move_to_group(layer: Any, name: str) -> None:
    """Put a layer that was just added to the project below a group of that name, on top of the others there."""
    root = QgsProject.instance().layerTreeRoot()
    node = root.findLayer(layer.id())
    if node is None:
        return
    group = root.findGroup(name) or root.insertGroup(0, name)
    if node.parent() is not group:
        group.insertChildNode(0, node.clone())
        node.parent().removeChildNode(node)


#: QGIS deletes a styler with its context, but keeps no reference to what Python knows of it.
_STYLERS: list[_Styler] = []


def _new_styler(group: str) -> _Styler:
    _STYLERS[:] = [styler for styler in _STYLERS if not sip.isdeleted(styler)]
    _STYLERS.append(_Styler(group))
    return _STYLERS[-1]


class Session:
    """Calls of the executable on behalf of an algorithm.

    Attributes
    ----------
    documents : list of dict
        The JSON objects that it printed.
    pages : list of Path
        Reports to open when all is done.
    """

    def __init__(self, context: Any, feedback: Any) -> None:
        self.context, self.feedback = context, feedback
        self.documents: list[dict[str, Any]] = []
        self.errors: list[str] = []
        self.pages: list[Path] = []

    def call(self, *arguments: str, some_may_fail: bool = False) -> list[dict[str, Any]]:
        """Run roadgeo with some arguments and return the JSON objects that it printed; none once cancelled.

        Raises
        ------
        QgsProcessingException
            It is not there, or it failed; with `some_may_fail` an error beside results is only shown.
        """
        executable = locate_executable()
        if executable is None:
            raise QgsProcessingException(NOT_FOUND)
        self.feedback.pushCommandInfo(shlex.join([executable, *arguments]))
        status = run([executable, *arguments], self._hear, self.feedback.isCanceled)
        if self.feedback.isCanceled():
            return []
        in_part = some_may_fail and status == _ERROR and self.documents
        if status not in _WELL and not in_part:
            raise QgsProcessingException("\n".join(self.errors) or f"roadgeo ended with status {status}")
        for error in self.errors:
            self.feedback.reportError(error)
        return self.documents

    def _hear(self, stream: str, line: str) -> None:
        """Take one line: results and progress are JSON objects, all else is said to people."""
        document = _parse(line)
        if document is not None and "progress" in document:
            progress = document["progress"]
            self.feedback.setProgress(100.0 * progress["done"] / progress["total"])
            self.feedback.setProgressText(progress["text"])
        elif document is not None and stream == "stdout":
            self.documents.append(document)
        elif line.startswith("Error: "):
            self.errors.append(line[len("Error: ") :])
        elif line.endswith(" ..."):
            self.feedback.setProgressText(line)
        elif line.strip():
            self.feedback.pushInfo(line)

    def show(self, path: Path, title: str, layer: str = "", group: str = "") -> str:
        """Have a result loaded, with its style and in its group, when all is done; return what QGIS opens it by."""
        source = f"{path}|layername={layer}" if layer else str(path)
        project = self.context.project()
        if project is not None and not self.feedback.isCanceled():
            hint = QgsProcessingUtils.LayerHint.Vector if layer else QgsProcessingUtils.LayerHint.Raster
            details = QgsProcessingContext.LayerDetails(title, project, title, hint)
            details.forceName = True
            details.setPostProcessor(_new_styler(group))
            self.context.addLayerToLoadOnCompletion(source, details)
        return source

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
