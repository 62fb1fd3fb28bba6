"""A panel to mend a place by hand: picture and map side by side, and the matched intersections as a list.

A match is switched off in the list, or dragged, on the picture or on the map; the fit follows at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from qgis.core import QgsCoordinateReferenceSystem, QgsGeometry, QgsPointXY, QgsProject, QgsRectangle, QgsWkbTypes
from qgis.gui import QgsMapCanvas, QgsMapTool, QgsRubberBand, QgsVertexMarker
from qgis.PyQt.QtCore import QCoreApplication, QRectF, Qt
from qgis.PyQt.QtGui import QBrush, QColor, QPen, QPixmap
from qgis.PyQt.QtWidgets import (
    QDockWidget,
    QFileDialog,
    QGraphicsEllipseItem,
    QGraphicsScene,
    QGraphicsView,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSplitter,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from .refit import FEWEST, Fit, Match, fit, format_points, place, read_points

__all__ = ["MatchDock"]

#: Colours of a match that is on, off, and chosen in the list; of the footprint; and how near a click must be, pixels.
_ON, _OFF, _CHOSEN, _FRAME, _NEAR = "#1f6fb4", "#9a9a9a", "#e4572e", "#1f6fb4", 12.0


def _tr(text: str) -> str:
    return str(QCoreApplication.translate("roadgeo", text))


class _Dot(QGraphicsEllipseItem):
    """A match on the picture, which can be dragged; as large on the screen however large the picture is."""

    def __init__(self, number: int, moved: Callable[[int, float, float], None]) -> None:
        super().__init__(QRectF(-6.0, -6.0, 12.0, 12.0))
        self._number, self._moved = number, moved
        self.setFlag(QGraphicsEllipseItem.GraphicsItemFlag.ItemIsMovable)
        self.setFlag(QGraphicsEllipseItem.GraphicsItemFlag.ItemIgnoresTransformations)

    def mouseReleaseEvent(self, event: Any) -> None:
        """Tell where it was dropped."""
        super().mouseReleaseEvent(event)
        self._moved(self._number, self.pos().x(), self.pos().y())


class _DragTool(QgsMapTool):
    """Drags the match on the map that is pressed upon; elsewhere it moves the map."""

    def __init__(self, canvas: Any, dock: MatchDock) -> None:
        super().__init__(canvas)
        self._dock, self._held = dock, -1

    def canvasPressEvent(self, event: Any) -> None:
        """Take the match under the pointer."""
        self._held = self._dock.nearest_on_map(event.pos())

    def canvasMoveEvent(self, event: Any) -> None:
        """Show where the match would lie."""
        if self._held >= 0:
            self._dock.markers[self._held].setCenter(self.toMapCoordinates(event.pos()))

    def canvasReleaseEvent(self, event: Any) -> None:
        """Leave the match there."""
        there = self.toMapCoordinates(event.pos())
        if self._held >= 0:
            self._dock.move_on_map(self._held, there.x(), there.y())
        else:
            self.canvas().setCenter(there)
            self.canvas().refresh()
        self._held = -1


class MatchDock(QDockWidget):
    """The panel.

    Attributes
    ----------
    matches : list of Match
        As they are now; `found` is what goes through them.
    """

    def __init__(self, parent: Any = None) -> None:
        super().__init__(_tr("roadgeo: matched intersections"), parent)
        self.setObjectName("RoadgeoMatches")
        self.matches: list[Match] = []
        self.found = Fit(None)
        self.crs = ""
        self.picture = ""
        self.dots: list[_Dot] = []
        self.markers: list[Any] = []
        self._filling = False
        self.scene = QGraphicsScene(self)
        self.view = QGraphicsView(self.scene)
        self.canvas = QgsMapCanvas()
        self.canvas.setCanvasColor(QColor("#ffffff"))
        self.band = QgsRubberBand(self.canvas, QgsWkbTypes.GeometryType.PolygonGeometry)
        self.band.setStrokeColor(QColor(_FRAME))
        self.band.setFillColor(QColor(31, 111, 180, 30))
        self.tool = _DragTool(self.canvas, self)
        self.canvas.setMapTool(self.tool)
        self.table = QTableWidget(0, 3)
        self.table.setHorizontalHeaderLabels([_tr("Match"), _tr("Residual"), _tr("Pixel")])
        self.table.itemChanged.connect(self._switched)
        self.table.itemSelectionChanged.connect(self._paint)
        self.said = QLabel(_tr("Open a picture and its matches (roadgeo locate --also match-points)."))
        self._lay_out()

    def _lay_out(self) -> None:
        buttons = QHBoxLayout()
        for text, does in ((_tr("Open..."), self.ask_open), (_tr("Export..."), self.ask_export)):
            button = QPushButton(text)
            button.clicked.connect(does)
            buttons.addWidget(button)
        buttons.addWidget(self.said, 1)
        sides = QSplitter(Qt.Orientation.Horizontal)
        for side in (self.view, self.canvas, self.table):
            sides.addWidget(side)
        sides.setSizes([420, 420, 260])
        body, column = QWidget(), QVBoxLayout()
        column.addLayout(buttons)
        column.addWidget(sides, 1)
        body.setLayout(column)
        self.setWidget(body)

    # --- opening ------------------------------------------------------------------------------------------------------

    def ask_open(self) -> None:
        """Ask for a picture and for its matches."""
        picture, _ = QFileDialog.getOpenFileName(self, _tr("Picture that was located"))
        points, _ = QFileDialog.getOpenFileName(self, _tr("Its matches"), str(Path(picture).parent), "*.points")
        if picture and points:
            self.open(picture, points)

    def open(self, picture: str, points: str) -> bool:
        """Show a picture and its matches; say what is wrong with them, and return whether that was nothing."""
        shown = QPixmap(picture)
        try:
            crs, matches = read_points(points)
        except ValueError as error:
            self.said.setText(str(error))
            return False
        if shown.isNull():
            self.said.setText(_tr("{} is no picture that can be shown.").format(picture))
            return False
        self.picture, self.crs, self.matches = picture, crs, matches
        self.scene.clear()
        self.scene.addPixmap(shown)
        self.view.fitInView(self.scene.itemsBoundingRect(), Qt.AspectRatioMode.KeepAspectRatio)
        self.canvas.setDestinationCrs(QgsCoordinateReferenceSystem.fromWkt(crs))
        self.canvas.setLayers(QgsProject.instance().layerTreeRoot().checkedLayers())
        for marker in self.markers:
            self.canvas.scene().removeItem(marker)
        self.dots = [_Dot(k, self.move_on_picture) for k in range(len(matches))]
        for dot in self.dots:
            self.scene.addItem(dot)
        self.markers = [QgsVertexMarker(self.canvas) for _ in matches]
        self._fill_table()
        self.refit()
        self._zoom()
        return True

    def _fill_table(self) -> None:
        self._filling = True
        self.table.setRowCount(len(self.matches))
        for k, one in enumerate(self.matches):
            name = QTableWidgetItem(str(k + 1))
            name.setFlags(name.flags() | Qt.ItemFlag.ItemIsUserCheckable)
            name.setCheckState(Qt.CheckState.Checked if one.on else Qt.CheckState.Unchecked)
            for column, item in enumerate((name, QTableWidgetItem(), QTableWidgetItem())):
                item.setFlags(item.flags() & ~Qt.ItemFlag.ItemIsEditable)
                self.table.setItem(k, column, item)
        self._filling = False

    def _zoom(self) -> None:
        """Show all matches on the map."""
        if self.matches:
            extent = QgsRectangle()
            extent.setMinimal()
            for one in self.matches:
                extent.combineExtentWith(one.x, one.y)
            extent.scale(1.3)
            self.canvas.setExtent(extent)
            self.canvas.refresh()

    # --- changing -----------------------------------------------------------------------------------------------------

    def switch(self, number: int, on: bool) -> None:
        """Switch a match on or off."""
        self.matches[number] = replace(self.matches[number], on=on)
        self.refit()

    def move_on_picture(self, number: int, column: float, row: float) -> None:
        """Put a match elsewhere on the picture."""
        self.matches[number] = replace(self.matches[number], column=column, row=row)
        self.refit()

    def move_on_map(self, number: int, x: float, y: float) -> None:
        """Put a match elsewhere on the map."""
        self.matches[number] = replace(self.matches[number], x=x, y=y)
        self.refit()

    def nearest_on_map(self, pixel: Any) -> int:
        """Return the match under a pixel of the map; -1 for none."""
        to_pixels = self.canvas.getCoordinateTransform()
        apart = []
        for one in self.matches:
            there = to_pixels.transform(QgsPointXY(one.x, one.y))
            apart.append(math.hypot(there.x() - pixel.x(), there.y() - pixel.y()))
        best = min(range(len(apart)), key=apart.__getitem__, default=-1)
        return best if best >= 0 and apart[best] <= _NEAR else -1

    def _switched(self, item: Any) -> None:
        if not self._filling and item.column() == 0:
            self.switch(item.row(), item.checkState() == Qt.CheckState.Checked)

    def refit(self) -> None:
        """Fit anew, and show it."""
        self.found = fit(self.matches)
        self._filling = True
        for k, (one, apart) in enumerate(zip(self.matches, self.found.residuals)):  # noqa: B905 (as long as each other)
            state = Qt.CheckState.Checked if one.on else Qt.CheckState.Unchecked
            self.table.item(k, 0).setCheckState(state)
            self.table.item(k, 1).setText(f"{apart:.2f}" if math.isfinite(apart) else "")
            self.table.item(k, 2).setText(f"{one.column:.1f}, {one.row:.1f}")
        self._filling = False
        n = sum(one.on for one in self.matches)
        if self.found.matrix is None:
            self.said.setText(_tr("{} of {} matches are on: a fit needs {}, not on one line.").format(
                n, len(self.matches), FEWEST
            ))  # fmt: skip
        else:
            used = [apart for one, apart in zip(self.matches, self.found.residuals) if one.on]  # noqa: B905
            rms = math.sqrt(sum(apart * apart for apart in used) / len(used))
            self.said.setText(_tr("{} of {} matches, {:.2f} root mean square").format(n, len(self.matches), rms))
        self._paint()

    def _paint(self) -> None:
        """Draw matches and footprint as they are."""
        chosen = {index.row() for index in self.table.selectedIndexes()}
        for k, (one, dot, marker) in enumerate(zip(self.matches, self.dots, self.markers)):  # noqa: B905
            color = QColor(_CHOSEN if k in chosen else _ON if one.on else _OFF)
            dot.setPos(one.column, one.row)
            dot.setZValue(1.0 if k in chosen else 0.0)  # of dots that overlap, the chosen one is dragged
            dot.setPen(QPen(QColor("#ffffff"), 1.0))
            dot.setBrush(QBrush(color))
            marker.setCenter(QgsPointXY(one.x, one.y))
            marker.setColor(color)
            marker.setIconType(QgsVertexMarker.IconType.ICON_CIRCLE)
            marker.setIconSize(11)
            marker.setPenWidth(3)
        corners = self.footprint()
        points = [QgsPointXY(*corner) for corner in corners]
        self.band.setToGeometry(QgsGeometry.fromPolygonXY([points] if points else []), None)

    def footprint(self) -> list[tuple[float, float]]:
        """Return the picture's corners on the map; none without a fit."""
        if self.found.matrix is None:
            return []
        size = self.scene.items()[-1].boundingRect()
        width, height = size.width(), size.height()
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        return [(float(x), float(y)) for x, y in place(self.found.matrix, corners)]

    # --- exporting ----------------------------------------------------------------------------------------------------

    def ask_export(self) -> None:
        """Ask where to write the matches."""
        start = str(Path(self.picture).with_suffix(".points")) if self.picture else ""
        path, _ = QFileDialog.getSaveFileName(self, _tr("Write control points"), start, "*.points *.tif")
        if path:
            self.export(path)

    def export(self, path: str) -> None:
        """Write the matches as control points; as GeoTIFF, with the picture, where the name ends so."""
        if path.lower().endswith((".tif", ".tiff")):
            _write_geotiff(path, self.picture, self.crs, self.matches)
        else:
            Path(path).write_text(format_points(self.crs, self.matches, self.found), "utf-8")
        self.said.setText(_tr("Wrote {}").format(path))


def _write_geotiff(path: str, picture: str, crs: str, matches: list[Match]) -> None:
    """Write the picture's own pixels with the matches that are on as control points."""
    from osgeo import gdal  # type: ignore[import-not-found]  # QGIS's own

    points = [gdal.GCP(one.x, one.y, 0.0, one.column, one.row) for one in matches if one.on]
    gdal.Translate(path, picture, GCPs=points, outputSRS=crs or None, creationOptions=["COMPRESS=DEFLATE"])
