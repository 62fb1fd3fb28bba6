"""The places at which a picture may lie: looked at on the map, until one is taken, or searched for again."""

from __future__ import annotations

from typing import Any

from qgis.core import QgsDistanceArea, QgsGeometry, QgsPointXY, QgsWkbTypes
from qgis.gui import QgsRubberBand, QgsVertexMarker
from qgis.PyQt.QtGui import QColor
from qgis.PyQt.QtWidgets import (
    QDialog,
    QDialogButtonBox,
    QHeaderView,
    QLabel,
    QTreeWidget,
    QTreeWidgetItem,
    QVBoxLayout,
)
from qgis.utils import iface

from .library import LONLAT, ListedPlace, list_places
from .session import Finding
from .window import run_dialog, to_map, zoom

__all__ = ["PlacesDialog"]

_COLUMNS = ("Score", "Map", "Latitude, longitude", "From the first")


class PlacesDialog(QDialog):
    """The places, the best first.

    Attributes
    ----------
    places : list of ListedPlace
    """

    def __init__(self, algorithm: str, finding: Finding) -> None:
        super().__init__(iface.mainWindow())
        self.setWindowTitle(f"Where is {finding.name}?")
        self.algorithm, self.finding = algorithm, finding
        self.places = list_places(finding.location)
        self.markers = [_mark(place) for place in self.places]
        self.bands = [_outline(place) for place in self.places]
        self.list = QTreeWidget()
        self.list.setHeaderLabels(_COLUMNS)
        self.list.setRootIsDecorated(False)
        self.list.header().setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        for place in self.places:
            first = self.places[0]
            away = f"{_measure(first, place) / 1000:.1f} km" if place.map == first.map else ""
            score = f"{round(place.score, 1) + 0.0:.1f}"  # no "-0.0"
            texts = [score, place.map, f"{place.lat:.5f}, {place.lon:.5f}", away]
            self.list.addTopLevelItem(QTreeWidgetItem(texts))
        self.list.currentItemChanged.connect(self._look)
        self.list.doubleClicked.connect(self.choose)
        advice = QLabel(
            f"{finding.location['reason']}\nSelect a place to see it on the map. Where you know it to be right, "
            "take it: the picture is drawn there, as chosen by you. Or have the picture located near the place alone."
        )
        advice.setWordWrap(True)
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        self.taking = buttons.addButton("Take it", QDialogButtonBox.ButtonRole.AcceptRole)
        self.taking.clicked.connect(self.take)
        self.button = buttons.addButton("Locate it here", QDialogButtonBox.ButtonRole.ActionRole)
        self.button.clicked.connect(self.choose)
        buttons.rejected.connect(self.reject)
        column = QVBoxLayout(self)
        for widget in (advice, self.list, buttons):
            column.addWidget(widget)
        self.resize(680, 320)
        if self.parentWidget() is not None:
            corner = self.parentWidget().geometry().bottomLeft()
            self.move(corner.x(), corner.y() - 360)  # beside the middle of the map, to which places are brought
        self.finished.connect(self._clear)
        self.list.setCurrentItem(self.list.topLevelItem(0))

    def _number(self) -> int:
        """Return the number of the selected place, from 0."""
        return int(self.list.indexOfTopLevelItem(self.list.currentItem()))

    def _look(self) -> None:
        """Show the selected place, as much around it as the picture covers."""
        chosen = self.places[self._number()]
        self.taking.setEnabled(bool(chosen.footprint))
        for place, *shapes in zip(self.places, self.markers, self.bands):  # noqa: B905 (as long as each other)
            for shape in shapes:
                shape.setColor(QColor("#e4572e" if place is chosen else "#1f6fb4"))
        around = [(chosen.lon + side, chosen.lat + side) for side in (-0.01, 0.01)]
        zoom(chosen.footprint or around, 2.0)

    def take(self) -> None:
        """Have the picture drawn at the selected place, by the same search."""
        run_dialog(self.algorithm, {**self.finding.parameters, "TAKE": self._number() + 1})
        self.accept()

    def choose(self) -> None:
        """Search again, near the selected place alone."""
        chosen = self.places[self._number()]
        others = [_measure(chosen, place) for place in self.places if place is not chosen]
        near = {
            "NEAR": f"{chosen.lon!r},{chosen.lat!r} [{LONLAT}]",
            "NEAR_RADIUS": min([1000.0, *(distance / 3 for distance in others)]),
            "NEAR_STATED": False,
        }
        run_dialog(self.algorithm, {**self.finding.parameters, **near})
        self.accept()

    def _clear(self) -> None:
        for marker in [*self.markers, *self.bands]:
            iface.mapCanvas().scene().removeItem(marker)


def _mark(place: ListedPlace) -> Any:
    marker = QgsVertexMarker(iface.mapCanvas())
    marker.setCenter(to_map(place.lon, place.lat))
    marker.setIconType(QgsVertexMarker.IconType.ICON_CIRCLE)
    marker.setIconSize(16)
    marker.setPenWidth(4)
    return marker


def _outline(place: ListedPlace) -> Any:
    band = QgsRubberBand(iface.mapCanvas(), QgsWkbTypes.GeometryType.LineGeometry)
    band.setWidth(2)
    ring = [to_map(*corner) for corner in [*place.footprint, *place.footprint[:1]]]
    band.setToGeometry(QgsGeometry.fromPolylineXY(ring), None)
    return band


def _measure(place: ListedPlace, other: ListedPlace) -> float:
    """Return the distance of two places, metres."""
    measure = QgsDistanceArea()
    measure.setEllipsoid("WGS84")
    return float(measure.measureLine(QgsPointXY(place.lon, place.lat), QgsPointXY(other.lon, other.lat)))
