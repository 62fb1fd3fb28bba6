"""The window of QGIS: dialogs of algorithms, messages with buttons, and the extent of its map."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import processing
from qgis.core import QgsCoordinateReferenceSystem, QgsCoordinateTransform, QgsPointXY, QgsProject, QgsRectangle
from qgis.PyQt import sip
from qgis.PyQt.QtCore import QTimer
from qgis.PyQt.QtWidgets import QPushButton
from qgis.utils import iface

from .library import LONLAT

__all__ = ["OPEN", "keep", "open_dialog", "push", "run_dialog", "show_points", "to_map", "zoom"]

#: Dialogs that are open, which Python would let go of; and the message under each title.
OPEN: list[Any] = []
_SAID: dict[str, Any] = {}


def open_dialog(algorithm: str, parameters: dict[str, Any]) -> Any:
    """Open the dialog of an algorithm with some values filled in, beside what the window shows."""
    dialog = processing.createAlgorithmDialog(f"roadgeo:{algorithm}", parameters)
    keep(dialog)
    return dialog


def run_dialog(algorithm: str, parameters: dict[str, Any]) -> None:
    """Run an algorithm in its dialog, which closes where all went well: the result is on the map."""
    dialog = open_dialog(algorithm, parameters)
    dialog.algorithmFinished.connect(lambda well, _: QTimer.singleShot(0, dialog.close) if well else None)
    dialog.runButton().click()


def keep(dialog: Any) -> None:
    """Show a dialog, and keep it for as long as it is open."""
    dialog.show()
    OPEN[:] = [one for one in [*OPEN, dialog] if not sip.isdeleted(one) and one.isVisible()]


def push(title: str, text: str, offered: dict[str, Any], level: Any, lasts_s: int = 0) -> Any:
    """Put a message with buttons into the window's message bar, and return it; 0 seconds: until it is closed.

    It takes the place of the message that had this title.
    """
    before = _SAID.get(title)
    if before is not None and not sip.isdeleted(before):
        iface.messageBar().popWidget(before)
    message = iface.messageBar().createMessage(title, text)
    message.setToolTip(text)
    for label, does in offered.items():
        button = QPushButton(label)
        button.clicked.connect(lambda _=False, does=does: does())
        message.layout().addWidget(button)
    _SAID[title] = iface.messageBar().pushWidget(message, level, lasts_s)
    return _SAID[title]


def zoom(lonlat: Iterable[Iterable[float]], scale: float = 1.3) -> None:
    """Show points of longitude and latitude on the window's map."""
    show_points(iface.mapCanvas(), [to_map(*point) for point in lonlat], scale)


def show_points(canvas: Any, points: Iterable[Any], scale: float = 1.3) -> None:
    """Show points in a canvas's own CRS on it, with some ground around them."""
    extent = QgsRectangle()
    extent.setMinimal()
    for point in points:
        extent.combineExtentWith(point)
    extent.scale(scale)
    canvas.setExtent(extent)
    canvas.refresh()


def to_map(lon: float, lat: float) -> Any:
    """Return a longitude and latitude as a point in the CRS of the window's map."""
    crs = iface.mapCanvas().mapSettings().destinationCrs()
    transform = QgsCoordinateTransform(QgsCoordinateReferenceSystem(LONLAT), crs, QgsProject.instance())
    return transform.transform(QgsPointXY(lon, lat))
