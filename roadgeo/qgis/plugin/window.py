"""The window of QGIS: dialogs of algorithms, messages with buttons, and the extent of its map."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import processing
from qgis.core import QgsCoordinateReferenceSystem, QgsCoordinateTransform, QgsPointXY, QgsProject, QgsRectangle
from qgis.PyQt import sip
from qgis.PyQt.QtWidgets import QPushButton
from qgis.utils import iface

from .library import LONLAT

__all__ = ["OPEN", "keep", "open_dialog", "push", "show_points", "to_map", "zoom"]

#: Dialogs that are open, which Python would let go of.
OPEN: list[Any] = []


def open_dialog(algorithm: str, parameters: dict[str, Any]) -> Any:
    """Open the dialog of an algorithm with some values filled in, beside what the window shows."""
    dialog = processing.createAlgorithmDialog(f"roadgeo:{algorithm}", parameters)
    keep(dialog)
    return dialog


def keep(dialog: Any) -> None:
    """Show a dialog, and keep it for as long as it is open."""
    dialog.show()
    OPEN[:] = [one for one in [*OPEN, dialog] if not sip.isdeleted(one) and one.isVisible()]


def push(title: str, text: str, offered: dict[str, Any], level: Any, lasts_s: int = 0) -> Any:
    """Put a message with buttons into the window's message bar, and return it; 0 seconds: until it is closed."""
    message = iface.messageBar().createMessage(title, text)
    message.setToolTip(text)
    for label, does in offered.items():
        button = QPushButton(label)
        button.clicked.connect(lambda _=False, does=does: does())
        message.layout().addWidget(button)
    return iface.messageBar().pushWidget(message, level, lasts_s)


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
