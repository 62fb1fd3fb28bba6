"""The places at which a picture may lie: looked at on the map, until one is taken, or searched for again."""

from __future__ import annotations

from typing import Any

from qgis.core import QgsDistanceArea, QgsPointXY
from qgis.gui import QgsVertexMarker
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
from .window import open_dialog, to_map, zoom

__all__ = ["PlacesDialog"]

_COLUMNS = ("Latitude, longitude", "Map", "From the first", "How likely")


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
        self.list = QTreeWidget()
        self.list.setHeaderLabels(_COLUMNS)
        self.list.setRootIsDecorated(False)
        self.list.header().setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        for place in self.places:
            away = f"{_measure(self.places[0], place) / 1000:.1f} km"
            texts = [f"{place.lat:.5f}, {place.lon:.5f}", place.map, away, _compare(self.places[0], place)]
            self.list.addTopLevelItem(QTreeWidgetItem(texts))
        self.list.currentItemChanged.connect(self._look)
        self.list.doubleClicked.connect(self.choose)
        advice = QLabel(
            f"{finding.location['reason']}\nSelect a place to see it on the map. Where you know it to be right, "
            "take it: the picture is drawn there, as chosen by you. Or have the picture located near the place, with "
            "less of the map to search."
        )
        advice.setWordWrap(True)
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        self.taking = buttons.addButton("Take it", QDialogButtonBox.ButtonRole.AcceptRole)
        self.taking.clicked.connect(self.take)
        self.button = buttons.addButton("Locate it here...", QDialogButtonBox.ButtonRole.ActionRole)
        self.button.clicked.connect(self.choose)
        buttons.rejected.connect(self.reject)
        column = QVBoxLayout(self)
        for widget in (advice, self.list, buttons):
            column.addWidget(widget)
        self.resize(680, 320)
        self.finished.connect(self._clear)
        self.list.setCurrentItem(self.list.topLevelItem(0))

    def _number(self) -> int:
        """Return the number of the selected place, from 0."""
        return int(self.list.indexOfTopLevelItem(self.list.currentItem()))

    def _look(self) -> None:
        """Show the selected place, as much around it as the picture covers."""
        chosen = self.places[self._number()]
        self.taking.setEnabled(bool(chosen.footprint))
        for place, marker in zip(self.places, self.markers):  # noqa: B905 (as long as each other)
            marker.setColor(QColor("#e4572e" if place is chosen else "#1f6fb4"))
        around = [(chosen.lon + side, chosen.lat + side) for side in (-0.01, 0.01)]
        zoom(chosen.footprint or around, 2.0)

    def take(self) -> None:
        """Have the picture drawn at the selected place, by the same search."""
        open_dialog(self.algorithm, {**self.finding.parameters, "TAKE": self._number() + 1}).runButton().click()
        self.accept()

    def choose(self) -> None:
        """Open the dialog again, to search near the selected place alone."""
        chosen = self.places[self._number()]
        others = [_measure(chosen, place) for place in self.places if place is not chosen]
        near = {
            "NEAR": f"{chosen.lon!r},{chosen.lat!r} [{LONLAT}]",
            "NEAR_RADIUS": min([1000.0, *(distance / 3 for distance in others)]),
        }
        open_dialog(self.algorithm, {**self.finding.parameters, **near})
        self.accept()

    def _clear(self) -> None:
        for marker in self.markers:
            iface.mapCanvas().scene().removeItem(marker)


def _mark(place: ListedPlace) -> Any:
    marker = QgsVertexMarker(iface.mapCanvas())
    marker.setCenter(to_map(place.lon, place.lat))
    marker.setIconType(QgsVertexMarker.IconType.ICON_CIRCLE)
    marker.setIconSize(16)
    marker.setPenWidth(4)
    return marker


def _measure(place: ListedPlace, other: ListedPlace) -> float:
    """Return the distance of two places, metres."""
    measure = QgsDistanceArea()
    measure.setEllipsoid("WGS84")
    return float(measure.measureLine(QgsPointXY(place.lon, place.lat), QgsPointXY(other.lon, other.lat)))


def _compare(best: ListedPlace, place: ListedPlace) -> str:
    """Return how likely a place is beside the best, rounded as a person would."""
    if place is best:
        return "best"
    if place.less < 0.2:
        return "as likely"
    return "a million times less, or more" if place.less > 6 else f"{float(f'{10**place.less:.1g}'):,.0f} times less"
