"""A panel to mend a place by hand: picture and map side by side, and the control points as a list.

Points are added, moved, switched off and deleted, on the picture or on the map; the fit follows while they move.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsDistanceArea,
    QgsGeometry,
    QgsPointXY,
    QgsProcessingUtils,
    QgsProject,
    QgsRasterLayer,
    QgsWkbTypes,
)
from qgis.gui import QgsRubberBand
from qgis.PyQt.QtCore import Qt
from qgis.PyQt.QtGui import QColor, QKeySequence
from qgis.PyQt.QtWidgets import (
    QDockWidget,
    QFileDialog,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QMenu,
    QPushButton,
    QSplitter,
    QTreeWidget,
    QTreeWidgetItem,
    QVBoxLayout,
    QWidget,
)
from qgis.utils import iface

from .canvases import Side
from .refit import FEWEST, Fit, TiePoint, corners, fit, format_points, place, read_points, rms
from .session import PICTURE_KEPT, POINTS_KEPT
from .window import open_dialog, show_points

__all__ = ["MatchDock"]

#: Colours of a point that is on, off, and chosen in the list, and of the footprint.
_ON, _OFF, _CHOSEN, _FRAME = (QColor(color) for color in ("#1f6fb4", "#9a9a9a", "#e4572e", "#1f6fb4"))


class _Row(QTreeWidgetItem):
    """A row of the list, sorted by the values that it shows."""

    keys: tuple[Any, ...] = (0, 0.0, (0.0, 0.0))

    def __lt__(self, other: Any) -> bool:
        """Whether it comes before another row."""
        column = self.treeWidget().header().sortIndicatorSection()
        return bool(self.keys[column] < other.keys[column])


class MatchDock(QDockWidget):
    """The panel.

    Attributes
    ----------
    matches : list of TiePoint
        The current ones; `found` is the fit through them.
    apart : list of float
        Distance of each, on or off, from where the fit puts it: metres where the CRS is known, else map units.
    rows : list of _Row
        The matches in the list, which may be sorted otherwise.
    adding : bool
        Whether a click adds a point.
    """

    def __init__(self, parent: Any = None) -> None:
        super().__init__("roadgeo: mend a place by hand", parent)
        self.setObjectName("RoadgeoMatches")
        self.matches: list[TiePoint] = []
        self.fitted = Fit(None)
        self.apart: list[float] = []
        self.rows: list[_Row] = []
        self.crs, self.picture, self.size = "", "", (0, 0)
        self._past: list[list[TiePoint]] = []
        self._clicked: dict[str, tuple[float, float]] = {}
        self._filling = False
        self.view, self.canvas = Side("picture", self), Side("map", self)
        self.band = QgsRubberBand(self.canvas, QgsWkbTypes.GeometryType.PolygonGeometry)
        self.band.setStrokeColor(_FRAME)
        self.band.setFillColor(QColor(31, 111, 180, 30))
        self.list = QTreeWidget()
        self.list.setRootIsDecorated(False)
        self.list.setSelectionMode(QTreeWidget.SelectionMode.ExtendedSelection)
        self.list.header().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.list.header().setSectionsClickable(True)
        self.list.header().setSortIndicator(0, Qt.SortOrder.AscendingOrder)
        self.list.header().setSortIndicatorShown(True)
        self.list.header().sortIndicatorChanged.connect(self.list.sortItems)
        self.list.itemChanged.connect(self._switched)
        self.list.itemSelectionChanged.connect(self._paint)
        self.status = QLabel("Open a picture that was located, or any picture to place it by points of your own.")
        self.status.setWordWrap(True)
        self.buttons: dict[str, QPushButton] = {}
        self._lay_out()

    @property
    def adding(self) -> bool:
        """Whether a click adds a point."""
        return bool(self.buttons["Add points"].isChecked())

    def _lay_out(self) -> None:
        actions: dict[str, Callable[[], object]] = {
            "Open...": self.offer,
            "Add points": self._start_adding,
            "Delete": self.delete_chosen,
            "Undo": self.undo,
            "Put on the map...": self.draw,
            "Export...": self.ask_export,
        }
        row = QHBoxLayout()
        for text, does in actions.items():
            self.buttons[text] = QPushButton(text)
            self.buttons[text].clicked.connect(lambda _=False, does=does: does())
            row.addWidget(self.buttons[text])
        row.addStretch(1)
        self.buttons["Add points"].setCheckable(True)
        sides = QSplitter(Qt.Orientation.Horizontal)
        for side in (self.view, self.canvas, self.list):
            sides.addWidget(side)
        self.list.setMinimumWidth(310)
        sides.setSizes([400, 400, 310])
        body = QWidget()
        column = QVBoxLayout(body)
        column.addLayout(row)
        column.addWidget(self.status)
        column.addWidget(sides, 1)
        self.setWidget(body)
        self.refit()

    def keyPressEvent(self, event: Any) -> None:
        """Delete what is selected in the list, or take the last change back."""
        if event.key() == Qt.Key.Key_Delete:
            self.delete_chosen()
        elif event.matches(QKeySequence.StandardKey.Undo):
            self.undo()
        else:
            super().keyPressEvent(event)

    # --- opening ------------------------------------------------------------------------------------------------------

    def _located(self) -> list[tuple[str, str, str]]:
        """List name, picture and points of the pictures located in this project, the current layer first."""
        names = {}
        for layer in [iface.activeLayer(), *QgsProject.instance().layerTreeRoot().layerOrder()]:
            picture, points = (layer.customProperty(key) if layer else "" for key in (PICTURE_KEPT, POINTS_KEPT))
            if picture and Path(picture).is_file():
                names[picture, points] = layer.name()
        return [(name, picture, points if Path(points).is_file() else "") for (picture, points), name in names.items()]

    def open_first(self) -> None:
        """Open what was located last, or the picture of the current layer; without either, offer a choice."""
        layer, located = iface.activeLayer(), self._located()
        if located:
            self.open(*located[0][1:])
        elif not (isinstance(layer, QgsRasterLayer) and Path(layer.source()).is_file() and self.open(layer.source())):
            self.offer()

    def offer(self) -> None:
        """Offer the pictures that were located in this project, and others."""
        menu = QMenu(self)
        for name, picture, points in self._located():
            menu.addAction(name, lambda picture=picture, points=points: self.open(picture, points))
        menu.addSeparator()
        menu.addAction("Another picture...", self.ask_open)
        menu.popup(self.buttons["Open..."].mapToGlobal(self.buttons["Open..."].rect().bottomLeft()))

    def ask_open(self) -> None:
        """Ask for a picture, and for its control points, which it need not have."""
        picture, _ = QFileDialog.getOpenFileName(self, "Picture")
        if picture:
            title = "Its control points, if there are any; else Cancel"
            points, _ = QFileDialog.getOpenFileName(self, title, str(Path(picture).parent), "*.points")
            self.open(picture, points)

    def open(self, picture: str, points: str = "") -> bool:
        """Show a picture and its points; return whether they could be read, and show the error if not."""
        layer = QgsRasterLayer(picture, "picture")
        try:
            crs, matches = read_points(points) if points else ("", [])
        except ValueError as error:
            self.status.setText(str(error))
            return False
        if not layer.isValid():
            self.status.setText(f"{picture} is no picture that can be shown.")
            return False
        self.picture, self.crs = picture, crs or QgsProject.instance().crs().toWkt()
        self.size = (layer.width(), layer.height())
        self._past, self.layer = [], layer
        self.view.show_picture(layer)
        self.canvas.setDestinationCrs(QgsCoordinateReferenceSystem.fromWkt(self.crs))
        self.canvas.setLayers(QgsProject.instance().layerTreeRoot().checkedLayers())
        self._renew(matches)
        self._zoom()
        return True

    def _renew(self, matches: list[TiePoint]) -> None:
        """Take other points."""
        self.matches, self._clicked = list(matches), {}
        for side in (self.view, self.canvas):
            side.renew(len(matches))
        self._filling = True
        self.rows = [_Row() for _ in matches]
        self.list.clear()
        self.list.addTopLevelItems(self.rows)
        self.refit()

    def _zoom(self) -> None:
        """Show all points on the map; without any, the extent of the window's map."""
        if self.matches:
            show_points(self.canvas, [QgsPointXY(match.x, match.y) for match in self.matches])
        else:
            self.canvas.setExtent(iface.mapCanvas().extent())
            self.canvas.refresh()

    # --- changing -----------------------------------------------------------------------------------------------------

    def remember(self) -> None:
        """Keep the points as they are, for `undo`."""
        self._past.append(list(self.matches))
        self.buttons["Undo"].setEnabled(True)

    def undo(self) -> None:
        """Take the last change back."""
        while self._past:
            before = self._past.pop()
            if before != self.matches:
                self._renew(before)
                break
        self.buttons["Undo"].setEnabled(bool(self._past))

    def _start_adding(self) -> None:
        self._clicked = {}
        self._describe()

    def click(self, side: str, u: float, v: float) -> None:
        """Add a point at a spot of the "picture" or the "map".

        On the other side it goes where the fit has it; without a fit the next click there places it.
        """
        self._clicked[side] = (u, v)
        other = "map" if side == "picture" else "picture"
        if self.fitted.matrix is not None and len(self._clicked) == 1:
            matrix = self.fitted.matrix if side == "picture" else np.linalg.inv(self.fitted.matrix)
            self._clicked[other] = tuple(place(matrix, np.array([[u, v]]))[0].tolist())
        if len(self._clicked) == 2:
            self.remember()
            self._renew([*self.matches, TiePoint(*self._clicked["picture"], *self._clicked["map"])])
            self.list.setCurrentItem(self.rows[-1])
        else:
            self.status.setText(f"Now click the same spot on the {other}.")

    def chosen(self) -> set[int]:
        """Return the points that are selected in the list."""
        return {number for number, row in enumerate(self.rows) if row.isSelected()}

    def delete_chosen(self) -> None:
        """Delete the points that are selected in the list."""
        chosen = self.chosen()
        self.remember()
        self._renew([match for number, match in enumerate(self.matches) if number not in chosen])

    def move(self, side: str, number: int, u: float, v: float) -> None:
        """Put a point elsewhere on the "picture" or the "map"."""
        fields = ("column", "row") if side == "picture" else ("x", "y")
        to: dict[str, Any] = dict(zip(fields, (u, v)))  # noqa: B905 (as long as each other)
        self.matches[number] = replace(self.matches[number], **to)
        self.refit()

    def _switched(self, item: Any) -> None:
        """Switch a point on or off, as its row was ticked."""
        if not self._filling:
            number = self.rows.index(item)
            self.remember()
            self.matches[number] = replace(self.matches[number], on=item.checkState(0) == Qt.CheckState.Checked)
            self.refit()

    # --- showing ------------------------------------------------------------------------------------------------------

    def refit(self) -> None:
        """Fit anew, and show it."""
        self.fitted = fit(self.matches)
        self.apart = self._residuals()
        unit = "m" if self._measure() is not None else "map units"
        self.list.setHeaderLabels(["Point", f"Residual ({unit})", "Pixel"])
        self._filling = True
        for number, (row, match, apart) in enumerate(zip(self.rows, self.matches, self.apart)):  # noqa: B905
            row.keys = (number, apart, (match.column, match.row))
            row.setCheckState(0, Qt.CheckState.Checked if match.on else Qt.CheckState.Unchecked)
            residual = f"{apart:.2f}" if math.isfinite(apart) else ""
            for column, text in enumerate((str(number + 1), residual, f"{match.column:.0f}, {match.row:.0f}")):
                row.setText(column, text)
        self._filling = False
        self._describe()
        self._paint()

    def _measure(self) -> Any:
        """Return the object that measures metres in the points' CRS; None where that is not known."""
        crs = QgsCoordinateReferenceSystem.fromWkt(self.crs) if self.crs else QgsCoordinateReferenceSystem()
        if not crs.isValid():
            return None
        measure = QgsDistanceArea()
        measure.setSourceCrs(crs, QgsProject.instance().transformContext())
        measure.setEllipsoid(crs.ellipsoidAcronym() or "WGS84")
        return measure

    def _residuals(self) -> list[float]:
        """Return the distance of each point from where the fit puts it, in metres where they can be measured."""
        measure = self._measure()
        if measure is None or self.fitted.matrix is None:
            return self.fitted.residuals
        fitted = place(self.fitted.matrix, np.array([(match.column, match.row) for match in self.matches]))
        pairs = zip(fitted.tolist(), self.matches)  # noqa: B905 (as long as each other)
        return [measure.measureLine(QgsPointXY(*there), QgsPointXY(match.x, match.y)) for there, match in pairs]

    def _describe(self) -> None:
        used = [apart for match, apart in zip(self.matches, self.apart) if match.on]  # noqa: B905
        text = f"{len(used)} of {len(self.matches)} points"
        if self.adding:
            text = "Click a spot on the picture or on the map; then drag the point to where it belongs."
        elif self.fitted.matrix is None:
            text += f" are on: a fit needs {FEWEST}, not on one line." if self.picture else ""
        elif len(used) == FEWEST:
            text += f": nothing checks them, for {FEWEST} fit any picture exactly"
        else:
            text += f", {rms(used):.2f} {'m' if self._measure() is not None else 'map units'} root mean square"
        if self.picture:
            self.status.setText(text)

    def _paint(self) -> None:
        """Draw points and footprint as they are."""
        chosen = self.chosen()
        for number, match in enumerate(self.matches):
            color = _CHOSEN if number in chosen else _ON if match.on else _OFF
            self.view.put(number, match.column, match.row, color, number in chosen)
            self.canvas.put(number, match.x, match.y, color, number in chosen)
        points = [QgsPointXY(*corner) for corner in self.footprint()]
        self.band.setToGeometry(QgsGeometry.fromPolygonXY([points] if points else []), None)
        self.buttons["Put on the map..."].setEnabled(self.fitted.matrix is not None)
        self.buttons["Delete"].setEnabled(bool(chosen))
        self.buttons["Undo"].setEnabled(bool(self._past))

    def footprint(self) -> list[tuple[float, float]]:
        """Return the picture's corners on the map; none without a fit."""
        if self.fitted.matrix is None:
            return []
        return [(float(x), float(y)) for x, y in place(self.fitted.matrix, corners(*self.size))]

    # --- exporting ----------------------------------------------------------------------------------------------------

    def ask_export(self) -> None:
        """Ask where to write the matches."""
        start = f"{self.picture}.points" if self.picture else ""  # where the Georeferencer looks for them
        path, _ = QFileDialog.getSaveFileName(self, "Write control points", start, "*.points *.tif")
        if path:
            self.export(path)

    def export(self, path: str) -> None:
        """Write the matches as control points; as GeoTIFF, with the picture, where the name ends so."""
        if path.lower().endswith((".tif", ".tiff")):
            from osgeo import gdal  # type: ignore[import-not-found]  # QGIS's own

            points = [gdal.GCP(match.x, match.y, 0.0, match.column, match.row) for match in self.matches if match.on]
            gdal.Translate(
                path, self.picture, GCPs=points, outputSRS=self.crs or None, creationOptions=["COMPRESS=DEFLATE"]
            )
        else:
            Path(path).write_text(format_points(self.crs, self.matches, self.fitted), "utf-8")
        self.status.setText(f"Wrote {path}")

    def draw(self) -> None:
        """Open the dialog that puts the picture on the map by the points as they are."""
        points = QgsProcessingUtils.generateTempFilename(f"{Path(self.picture).name}.points")
        self.export(points)
        self.drawing = open_dialog("placebypoints", {"IMAGE": self.picture, "POINTS": points})
