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
    QgsRectangle,
    QgsWkbTypes,
)
from qgis.gui import QgsMapCanvas, QgsMapTool, QgsRubberBand, QgsVertexMarker
from qgis.PyQt.QtCore import QCoreApplication, QRectF, QSize, Qt
from qgis.PyQt.QtGui import QBrush, QColor, QPainter, QPen, QPixmap
from qgis.PyQt.QtWidgets import (
    QDockWidget,
    QFileDialog,
    QGraphicsEllipseItem,
    QGraphicsPixmapItem,
    QGraphicsScene,
    QGraphicsView,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QMenu,
    QPushButton,
    QSplitter,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)
from qgis.utils import iface

from .messages import open_dialog
from .refit import FEWEST, Fit, Match, fit, format_points, place, read_points
from .session import PICTURE_KEPT, POINTS_KEPT

__all__ = ["MatchDock"]

#: Colours of a point that is on, off, and chosen in the list; of the footprint; and how near a click must be, pixels.
_ON, _OFF, _CHOSEN, _FRAME, _NEAR = "#1f6fb4", "#9a9a9a", "#e4572e", "#1f6fb4", 12.0

#: Pictures are shown with at most this number of pixels a side.
_SHOWN_PX = 3000


def _tr(text: str) -> str:
    return str(QCoreApplication.translate("roadgeo", text))


class _Dot(QGraphicsEllipseItem):
    """A point on the picture, which can be dragged; as large on the screen however large the picture is."""

    def __init__(self, number: int, moved: Callable[[int, float, float], None]) -> None:
        super().__init__(QRectF(-6.0, -6.0, 12.0, 12.0))
        self._number, self._moved = number, moved
        self.setFlag(QGraphicsEllipseItem.GraphicsItemFlag.ItemIsMovable)
        self.setFlag(QGraphicsEllipseItem.GraphicsItemFlag.ItemIgnoresTransformations)
        self.setCursor(Qt.CursorShape.SizeAllCursor)

    def mouseMoveEvent(self, event: Any) -> None:
        """Report its new position."""
        super().mouseMoveEvent(event)
        self._moved(self._number, self.pos().x(), self.pos().y())


class _Picture(QGraphicsView):
    """The picture: the wheel zooms, dragging moves it, and a click adds a point where that is switched on."""

    def __init__(self, scene: Any, dock: MatchDock) -> None:
        super().__init__(scene)
        self._dock = dock
        self.setRenderHint(QPainter.RenderHint.SmoothPixmapTransform)
        self.setTransformationAnchor(QGraphicsView.ViewportAnchor.AnchorUnderMouse)
        self.setDragMode(QGraphicsView.DragMode.ScrollHandDrag)

    def wheelEvent(self, event: Any) -> None:
        """Zoom where the pointer is."""
        factor = 1.25 if event.angleDelta().y() > 0 else 0.8
        self.scale(factor, factor)

    def mousePressEvent(self, event: Any) -> None:
        """Add a point, or let it be moved."""
        if self._dock.adding and not isinstance(self.itemAt(event.pos()), _Dot):
            there = self.mapToScene(event.pos())
            self._dock.click("picture", there.x(), there.y())
        else:
            super().mousePressEvent(event)


class _MapTool(QgsMapTool):
    """Drags the point on the map that is pressed upon; elsewhere it adds one, or moves the map."""

    def __init__(self, canvas: Any, dock: MatchDock) -> None:
        super().__init__(canvas)
        self._dock, self._held, self._panning = dock, -1, False

    def canvasPressEvent(self, event: Any) -> None:
        """Take the point under the pointer."""
        self._held = self._dock.nearest_on_map(event.pos())

    def canvasMoveEvent(self, event: Any) -> None:
        """Have it follow."""
        if self._held >= 0:
            there = self.toMapCoordinates(event.pos())
            self._dock.move_on_map(self._held, there.x(), there.y())
        elif event.buttons() & Qt.MouseButton.LeftButton and not self._dock.adding:
            self._panning = True
            self.canvas().panAction(event)

    def canvasReleaseEvent(self, event: Any) -> None:
        """Leave it there."""
        there = self.toMapCoordinates(event.pos())
        if self._held >= 0:
            self._dock.move_on_map(self._held, there.x(), there.y())
        elif self._dock.adding:
            self._dock.click("map", there.x(), there.y())
        elif self._panning:
            self.canvas().panActionEnd(event.pos())
        self._held, self._panning = -1, False


class _Table(QTableWidget):
    """The points as a list, of which the key Delete takes away what is selected."""

    def __init__(self, dock: MatchDock) -> None:
        super().__init__(0, 3)
        self._dock = dock

    def keyPressEvent(self, event: Any) -> None:
        """Delete, or move on in the list."""
        if event.key() == Qt.Key.Key_Delete:
            self._dock.delete_chosen()
        else:
            super().keyPressEvent(event)


class MatchDock(QDockWidget):
    """The panel.

    Attributes
    ----------
    matches : list of Match
        The current ones; `found` is the fit through them.
    apart : list of float
        Of each, on or off, how far it lies from where the fit puts it: metres where the CRS is known, else map units.
    adding : bool
        Whether a click adds a point.
    """

    def __init__(self, parent: Any = None) -> None:
        super().__init__(_tr("roadgeo: mend a place by hand"), parent)
        self.setObjectName("RoadgeoMatches")
        self.matches: list[Match] = []
        self.found = Fit(None)
        self.apart: list[float] = []
        self.crs = ""
        self.picture = ""
        self.size = (0, 0)
        self.dots: list[_Dot] = []
        self.markers: list[Any] = []
        self._clicked: dict[str, tuple[float, float]] = {}
        self._filling = False
        self.scene = QGraphicsScene(self)
        self.view = _Picture(self.scene, self)
        self.canvas = QgsMapCanvas()
        self.canvas.setCanvasColor(QColor("#ffffff"))
        self.band = QgsRubberBand(self.canvas, QgsWkbTypes.GeometryType.PolygonGeometry)
        self.band.setStrokeColor(QColor(_FRAME))
        self.band.setFillColor(QColor(31, 111, 180, 30))
        self.tool = _MapTool(self.canvas, self)
        self.canvas.setMapTool(self.tool)
        self.table = _Table(self)
        self.table.verticalHeader().hide()
        self.table.horizontalHeader().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.table.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        self.table.itemChanged.connect(self._switched)
        self.table.itemSelectionChanged.connect(self._paint)
        self.said = QLabel(_tr("Open a picture that was located, or any picture to place it by points of your own."))
        self._lay_out()
        self._name_columns()

    @property
    def adding(self) -> bool:
        """Whether a click adds a point."""
        return bool(self.add_button.isChecked())

    def _lay_out(self) -> None:
        row = QHBoxLayout()
        self.buttons = {}
        for text, does in (
            ("Open...", self.offer),
            ("Add points", self._start_adding),
            ("Delete", self.delete_chosen),
            ("Put on the map...", self.draw),
            ("Export...", self.ask_export),
        ):
            self.buttons[text] = QPushButton(_tr(text))
            self.buttons[text].clicked.connect(lambda _=False, does=does: does())
            row.addWidget(self.buttons[text])
        self.add_button = self.buttons["Add points"]
        self.add_button.setCheckable(True)
        row.addWidget(self.said, 1)
        sides = QSplitter(Qt.Orientation.Horizontal)
        for side in (self.view, self.canvas, self.table):
            sides.addWidget(side)
        self.table.setMinimumWidth(265)
        sides.setSizes([400, 400, 265])
        body, column = QWidget(), QVBoxLayout()
        column.addLayout(row)
        column.addWidget(sides, 1)
        body.setLayout(column)
        self.setWidget(body)

    def _name_columns(self) -> None:
        unit = "m" if self._measure() is not None else _tr("map units")
        self.table.setHorizontalHeaderLabels([_tr("Point"), _tr("Residual") + f" ({unit})", _tr("Pixel")])

    # --- opening ------------------------------------------------------------------------------------------------------

    def offer(self) -> None:
        """Offer the pictures that were located in this project, and others."""
        menu = QMenu(self)
        for layer in QgsProject.instance().mapLayers().values():
            picture, points = (str(layer.customProperty(key, "") or "") for key in (PICTURE_KEPT, POINTS_KEPT))
            if picture and Path(picture).is_file():
                points = points if Path(points).is_file() else ""
                menu.addAction(layer.name(), lambda picture=picture, points=points: self.open(picture, points))
        if not menu.isEmpty():
            menu.addSeparator()
        menu.addAction(_tr("Another picture..."), self.ask_open)
        menu.popup(self.buttons["Open..."].mapToGlobal(self.buttons["Open..."].rect().bottomLeft()))

    def ask_open(self) -> None:
        """Ask for a picture, and for its control points, which it need not have."""
        picture, _ = QFileDialog.getOpenFileName(self, _tr("Picture"))
        if picture:
            told = _tr("Its control points, if there are any; else Cancel")
            points, _ = QFileDialog.getOpenFileName(self, told, str(Path(picture).parent), "*.points")
            self.open(picture, points)

    def open(self, picture: str, points: str = "") -> bool:
        """Show a picture and its points; return whether they could be read, and show the error if not."""
        layer = QgsRasterLayer(picture, "picture")
        try:
            crs, matches = read_points(points) if points else ("", [])
        except ValueError as error:
            self.said.setText(str(error))
            return False
        if not layer.isValid():
            self.said.setText(_tr("{} is no picture that can be shown.").format(picture))
            return False
        self.picture, self.crs = picture, crs or QgsProject.instance().crs().toWkt()
        self.size = (layer.width(), layer.height())
        self._renew([])
        self.scene.clear()
        self.scene.addItem(_preview(layer))
        self.scene.setSceneRect(QRectF(0.0, 0.0, *map(float, self.size)))
        self.view.fitInView(self.scene.sceneRect(), Qt.AspectRatioMode.KeepAspectRatio)
        self.canvas.setDestinationCrs(QgsCoordinateReferenceSystem.fromWkt(self.crs))
        shown = QgsProject.instance().layerTreeRoot().checkedLayers()
        self.canvas.setLayers(shown)
        self._name_columns()
        self._renew(matches)
        self._zoom()
        return True

    def _renew(self, matches: list[Match]) -> None:
        """Take other points."""
        self.matches, self._clicked = list(matches), {}
        for dot in self.dots:
            self.scene.removeItem(dot)
        for marker in self.markers:
            self.canvas.scene().removeItem(marker)
        self.dots = [_Dot(k, self.move_on_picture) for k in range(len(matches))]
        for dot in self.dots:
            self.scene.addItem(dot)
        self.markers = [QgsVertexMarker(self.canvas) for _ in matches]
        self._fill_table()
        self.refit()

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
        """Show all points on the map; without any, the extent of the window's map."""
        if self.matches:
            extent = QgsRectangle()
            extent.setMinimal()
            for one in self.matches:
                extent.combineExtentWith(one.x, one.y)
            extent.scale(1.3)
            self.canvas.setExtent(extent)
        elif iface is not None:
            self.canvas.setExtent(iface.mapCanvas().extent())
        self.canvas.refresh()

    # --- changing -----------------------------------------------------------------------------------------------------

    def _start_adding(self) -> None:
        self._clicked = {}
        if self.adding:
            self.said.setText(
                _tr("Click a spot on the picture or on the map; then drag the point to where it belongs.")
            )
        else:
            self._tell()

    def click(self, side: str, u: float, v: float) -> None:
        """Add a point at a spot of the "picture" or the "map".

        On the other side it goes where the fit has it; without a fit the next click there places it.
        """
        self._clicked[side] = (u, v)
        if self.found.matrix is not None and len(self._clicked) == 1:
            other = "map" if side == "picture" else "picture"
            matrix = self.found.matrix if side == "picture" else np.linalg.inv(self.found.matrix)
            self._clicked[other] = tuple(place(matrix, np.array([[u, v]]))[0].tolist())
        if len(self._clicked) == 2:
            one = Match(*self._clicked["picture"], *self._clicked["map"])
            self._renew([*self.matches, one])
            self.table.selectRow(len(self.matches) - 1)
        else:
            other = _tr("map") if side == "picture" else _tr("picture")
            self.said.setText(_tr("Now click the same spot on the {}.").format(other))

    def delete_chosen(self) -> None:
        """Delete the points that are selected in the list."""
        chosen = {index.row() for index in self.table.selectedIndexes()}
        self._renew([one for k, one in enumerate(self.matches) if k not in chosen])

    def switch(self, number: int, on: bool) -> None:
        """Switch a point on or off."""
        self.matches[number] = replace(self.matches[number], on=on)
        self.refit()

    def move_on_picture(self, number: int, column: float, row: float) -> None:
        """Put a point elsewhere on the picture."""
        self.matches[number] = replace(self.matches[number], column=column, row=row)
        self.refit()

    def move_on_map(self, number: int, x: float, y: float) -> None:
        """Put a point elsewhere on the map."""
        self.matches[number] = replace(self.matches[number], x=x, y=y)
        self.refit()

    def nearest_on_map(self, pixel: Any) -> int:
        """Return the point under a pixel of the map, a chosen one before others; -1 for none."""
        to_pixels = self.canvas.getCoordinateTransform()
        chosen = {index.row() for index in self.table.selectedIndexes()}
        apart = []
        for k, one in enumerate(self.matches):
            there = to_pixels.transform(QgsPointXY(one.x, one.y))
            far = math.hypot(there.x() - pixel.x(), there.y() - pixel.y())
            apart.append((far > _NEAR, k not in chosen, far))
        best = min(range(len(apart)), key=apart.__getitem__, default=-1)
        return best if best >= 0 and not apart[best][0] else -1

    def _switched(self, item: Any) -> None:
        if not self._filling and item.column() == 0:
            self.switch(item.row(), item.checkState() == Qt.CheckState.Checked)

    def refit(self) -> None:
        """Fit anew, and show it."""
        self.found = fit(self.matches)
        self.apart = self._residuals()
        self._filling = True
        for k, (one, apart) in enumerate(zip(self.matches, self.apart)):  # noqa: B905 (as long as each other)
            state = Qt.CheckState.Checked if one.on else Qt.CheckState.Unchecked
            self.table.item(k, 0).setCheckState(state)
            self.table.item(k, 1).setText(f"{apart:.2f}" if math.isfinite(apart) else "")
            self.table.item(k, 2).setText(f"{one.column:.0f}, {one.row:.0f}")
        self._filling = False
        self._tell()
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
        """Return how far each point lies from where the fit puts it, in metres where they can be measured."""
        measure = self._measure()
        if measure is None or self.found.matrix is None:
            return self.found.residuals
        fitted = place(self.found.matrix, np.array([(one.column, one.row) for one in self.matches]))
        pairs = zip(fitted.tolist(), self.matches)  # noqa: B905 (as long as each other)
        return [measure.measureLine(QgsPointXY(*there), QgsPointXY(one.x, one.y)) for there, one in pairs]

    def _tell(self) -> None:
        n = sum(one.on for one in self.matches)
        if self.found.matrix is None:
            self.said.setText(_tr("{} of {} points are on: a fit needs {}, not on one line.").format(
                n, len(self.matches), FEWEST
            ))  # fmt: skip
            return
        used = [apart for one, apart in zip(self.matches, self.apart) if one.on]  # noqa: B905
        rms = math.sqrt(sum(apart * apart for apart in used) / len(used))
        unit = "m" if self._measure() is not None else _tr("map units")
        self.said.setText(_tr("{} of {} points, {:.2f} {} root mean square").format(n, len(self.matches), rms, unit))

    def _paint(self) -> None:
        """Draw points and footprint as they are."""
        chosen = {index.row() for index in self.table.selectedIndexes()}
        for k, (one, dot, marker) in enumerate(zip(self.matches, self.dots, self.markers)):  # noqa: B905
            color = QColor(_CHOSEN if k in chosen else _ON if one.on else _OFF)
            dot.setPos(one.column, one.row)
            dot.setZValue(2.0 if k in chosen else 1.0)  # of dots that overlap, the chosen one is dragged
            dot.setPen(QPen(QColor("#ffffff"), 1.0))
            dot.setBrush(QBrush(color))
            marker.setCenter(QgsPointXY(one.x, one.y))
            marker.setColor(color)
            marker.setIconType(QgsVertexMarker.IconType.ICON_CIRCLE)
            marker.setIconSize(11)
            marker.setPenWidth(3)
        points = [QgsPointXY(*corner) for corner in self.footprint()]
        self.band.setToGeometry(QgsGeometry.fromPolygonXY([points] if points else []), None)
        self.buttons["Put on the map..."].setEnabled(self.found.matrix is not None)
        self.buttons["Delete"].setEnabled(bool(chosen))

    def footprint(self) -> list[tuple[float, float]]:
        """Return the picture's corners on the map; none without a fit."""
        if self.found.matrix is None:
            return []
        width, height = self.size
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        return [(float(x), float(y)) for x, y in place(self.found.matrix, corners)]

    # --- exporting ----------------------------------------------------------------------------------------------------

    def ask_export(self) -> None:
        """Ask where to write the matches."""
        start = f"{self.picture}.points" if self.picture else ""  # where the Georeferencer looks for them
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

    def draw(self) -> None:
        """Open the dialog that puts the picture on the map by the points as they are."""
        points = QgsProcessingUtils.generateTempFilename(f"{Path(self.picture).name}.points")
        self.export(points)
        self.drawing = open_dialog("placebypoints", {"IMAGE": self.picture, "POINTS": points})


def _preview(layer: Any) -> Any:
    """Draw a picture of any size and depth, stretched as QGIS does; in the picture's own pixels."""
    width, height = layer.width(), layer.height()
    scale = min(1.0, _SHOWN_PX / max(width, height))
    image = layer.previewAsImage(QSize(max(1, round(width * scale)), max(1, round(height * scale))))
    item = QGraphicsPixmapItem(QPixmap.fromImage(image))
    item.setTransform(item.transform().scale(width / image.width(), height / image.height()))
    item.setTransformationMode(Qt.TransformationMode.SmoothTransformation)
    return item


def _write_geotiff(path: str, picture: str, crs: str, matches: list[Match]) -> None:
    """Write the picture's own pixels with the matches that are on as control points."""
    from osgeo import gdal  # type: ignore[import-not-found]  # QGIS's own

    points = [gdal.GCP(one.x, one.y, 0.0, one.column, one.row) for one in matches if one.on]
    gdal.Translate(path, picture, GCPs=points, outputSRS=crs or None, creationOptions=["COMPRESS=DEFLATE"])
