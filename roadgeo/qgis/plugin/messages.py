"""The result of a search in the window's message bar, with buttons to zoom, to choose a place, or to mend it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import processing
from qgis.core import (
    Qgis,
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsDistanceArea,
    QgsPointXY,
    QgsProject,
    QgsRectangle,
)
from qgis.gui import QgsVertexMarker
from qgis.PyQt import sip
from qgis.PyQt.QtCore import QTimer, QUrl
from qgis.PyQt.QtGui import QColor, QDesktopServices
from qgis.PyQt.QtWidgets import (
    QDialog,
    QDialogButtonBox,
    QHeaderView,
    QLabel,
    QPushButton,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
)
from qgis.utils import iface, plugins

from .session import Finding

__all__ = ["PlacesDialog", "open_dialog", "push", "tell", "tell_ready"]

_LONLAT = "EPSG:4326"

#: QGIS reports itself that a task is complete; our message should lie above that.
_AFTER_MS = 400

#: Dialogs that are open, which Python would let go of.
_OPEN: list[Any] = []


def open_dialog(algorithm: str, parameters: dict[str, Any]) -> Any:
    """Open the dialog of an algorithm with some values filled in, beside what the window shows."""
    dialog = processing.createAlgorithmDialog(f"roadgeo:{algorithm}", parameters)
    keep(dialog)
    return dialog


def keep(dialog: Any) -> None:
    """Show a dialog, and keep it for as long as it is open."""
    dialog.show()
    _OPEN[:] = [one for one in [*_OPEN, dialog] if not sip.isdeleted(one) and one.isVisible()]


def push(title: str, text: str, offered: list[tuple[str, Any]], level: Any, lasts_s: int = 0) -> Any:
    """Put a message with buttons into the window's message bar, and return it; 0 seconds: until it is closed."""
    message = iface.messageBar().createMessage(title, text)
    for label, does in offered:
        button = QPushButton(label)
        button.clicked.connect(lambda _=False, does=does: does())
        message.layout().addWidget(button)
    return iface.messageBar().pushWidget(message, level, lasts_s)


def tell_ready(version: str) -> None:
    """Report that the program is set up, in place of the question that asked for it, with what comes next."""
    offered = [("Build road reference...", lambda: open_dialog("buildreference", {}))]
    _menu().forget_question()
    QTimer.singleShot(
        _AFTER_MS, lambda: push("roadgeo", f"Version {version} is set up.", offered, Qgis.MessageLevel.Success)
    )


def tell(algorithm: str, finding: Finding) -> None:
    """Report a result in the window's message bar, with buttons for the next step."""
    location = finding.location
    if location["status"] == "located":
        text = f"located, {location['gsd_m']:.2g} m per pixel, up is {location['rotation_deg'] % 360.0:.0f}° from north"
        level, offered = Qgis.MessageLevel.Success, [("Zoom to it", lambda: zoom(location["footprint_lonlat"]))]
        if finding.points:
            offered.append(("Mend by hand", lambda: _mend(finding)))
    else:
        text, level, offered = location["reason"], Qgis.MessageLevel.Warning, []
        if location["alternatives"] and location["center"]:
            offered.append(("Choose the place...", lambda: keep(PlacesDialog(algorithm, finding))))
        elif location["footprint_lonlat"]:  # a place that is known along one direction only
            offered.append(("Zoom to it", lambda: zoom(location["footprint_lonlat"])))
    if finding.page:
        page = QUrl.fromLocalFile(finding.page)
        offered.append(("Report", lambda: QDesktopServices.openUrl(page)))
    lasts_s = 0 if level == Qgis.MessageLevel.Warning else 20
    QTimer.singleShot(_AFTER_MS, lambda: push(finding.name, text, offered, level, lasts_s))


def _menu() -> Any:
    return plugins[Path(__file__).parent.name].menu


def _mend(finding: Finding) -> None:
    _menu().mend(finding.picture, finding.points)


def zoom(lonlat: list[list[float]], scale: float = 1.3) -> None:
    """Show points of longitude and latitude on the window's map."""
    canvas, extent = iface.mapCanvas(), QgsRectangle()
    extent.setMinimal()
    for there in _to_map(lonlat):
        extent.combineExtentWith(there)
    extent.scale(scale)
    canvas.setExtent(extent)
    canvas.refresh()


def _to_map(lonlat: list[list[float]]) -> list[Any]:
    """Return points of longitude and latitude in the CRS of the window's map."""
    to = iface.mapCanvas().mapSettings().destinationCrs()
    transform = QgsCoordinateTransform(QgsCoordinateReferenceSystem(_LONLAT), to, QgsProject.instance())
    return [transform.transform(QgsPointXY(*one)) for one in lonlat]


class PlacesDialog(QDialog):
    """The places that a picture may lie at: looked at on the map, one is chosen, and searched again near it alone.

    Attributes
    ----------
    places : list of tuple
        Longitude, latitude, and log10 odds or None; the best first.
    """

    def __init__(self, algorithm: str, finding: Finding) -> None:
        super().__init__(iface.mainWindow())
        self.setWindowTitle(f"Where is {finding.name}?")
        self.algorithm, self.finding = algorithm, finding
        location = finding.location
        best = {"center": location["center"], "log10_odds": location["log10_odds"]}
        found = [best, *location["alternatives"]]
        self.places = [(one["center"]["lon"], one["center"]["lat"], one["log10_odds"]) for one in found]
        self.markers = [self._mark(place) for place in self.places]
        self.table = QTableWidget(len(self.places), 3)
        self.table.setHorizontalHeaderLabels(["Latitude, longitude", "From the first", "How likely"])
        self.table.horizontalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        self.table.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        self.table.setSelectionMode(QTableWidget.SelectionMode.SingleSelection)
        self.table.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
        for row, place in enumerate(self.places):
            for column, text in enumerate(self._describe(place)):
                self.table.setItem(row, column, QTableWidgetItem(text))
        self.table.itemSelectionChanged.connect(self._look)
        self.table.doubleClicked.connect(self.choose)
        told = QLabel(
            f"{location['reason']}\nSelect a place to see it on the map; locate the picture where you know it is."
        )
        told.setWordWrap(True)
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        self.button = buttons.addButton("Locate it here...", QDialogButtonBox.ButtonRole.AcceptRole)
        self.button.clicked.connect(self.choose)
        buttons.rejected.connect(self.reject)
        column = QVBoxLayout()
        for one in (told, self.table, buttons):
            column.addWidget(one)
        self.setLayout(column)
        self.resize(640, 320)
        self.finished.connect(self._clear)
        self.table.selectRow(0)

    def _mark(self, place: tuple[float, float, float | None]) -> Any:
        marker = QgsVertexMarker(iface.mapCanvas())
        marker.setCenter(*_to_map([list(place[:2])]))
        marker.setIconType(QgsVertexMarker.IconType.ICON_CIRCLE)
        marker.setIconSize(16)
        marker.setPenWidth(4)
        return marker

    def _describe(self, place: tuple[float, float, float | None]) -> list[str]:
        lon, lat, odds = place
        apart = self._apart(place, self.places[0])
        best = self.places[0][2]
        less = None if odds is None or best is None else best - odds
        likely = (
            "" if less is None else "best" if place is self.places[0] else f"{10.0 ** min(less, 9.0):,.3g} times less"
        )
        return [f"{lat:.5f}, {lon:.5f}", f"{apart / 1000:.1f} km", likely]

    def _apart(self, one: tuple[float, float, float | None], other: tuple[float, float, float | None]) -> float:
        measure = QgsDistanceArea()
        measure.setEllipsoid("WGS84")
        return float(measure.measureLine(QgsPointXY(*one[:2]), QgsPointXY(*other[:2])))

    def _chosen(self) -> int:
        return max(int(self.table.currentRow()), 0)

    def _look(self) -> None:
        """Show the selected place, as much around it as the picture covers."""
        chosen = self._chosen()
        for row, marker in enumerate(self.markers):
            marker.setColor(QColor("#e4572e" if row == chosen else "#1f6fb4"))
        corners = self.finding.location["footprint_lonlat"] or [self.places[chosen][:2]]
        lon, lat = (self.places[chosen][k] - self.places[0][k] for k in (0, 1))
        zoom([[one[0] + lon, one[1] + lat] for one in corners], 2.0)

    def choose(self) -> None:
        """Open the dialog again, to search near the selected place alone."""
        chosen = self._chosen()
        place = self.places[chosen]
        others = [self._apart(place, one) for row, one in enumerate(self.places) if row != chosen]
        near = {
            "NEAR": f"{place[0]!r},{place[1]!r} [{_LONLAT}]",
            "NEAR_RADIUS": min([1000.0, *(d / 3 for d in others)]),
        }
        open_dialog(self.algorithm, {**self.finding.parameters, **near})
        self.accept()

    def _clear(self) -> None:
        for marker in self.markers:
            iface.mapCanvas().scene().removeItem(marker)
