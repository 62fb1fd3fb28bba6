"""A side of the panel to mend a place: picture or map, with numbered points that are dragged or added by a click."""

from __future__ import annotations

import math
from typing import Any

from qgis.core import QgsPointXY
from qgis.gui import QgsMapCanvas, QgsMapCanvasItem, QgsMapTool
from qgis.PyQt.QtCore import QPointF, QRectF, Qt
from qgis.PyQt.QtGui import QBrush, QColor, QPainter, QPainterPath, QPen

__all__ = ["Side"]

#: Radius of a point, where its number stands, and how near a click must be, pixels of the screen.
_RADIUS, _NUMBER_AT, _NEAR = 5.5, QPointF(7.0, -4.0), 8.0


class _Marker(QgsMapCanvasItem):
    """A point: a disc with its number beside it, as large on the screen whatever is zoomed."""

    def __init__(self, canvas: Any, number: int) -> None:
        super().__init__(canvas)
        self.number, self.color, self._at = number, QColor("#000000"), QgsPointXY(0.0, 0.0)

    def put(self, x: float, y: float) -> None:
        """Put it somewhere."""
        self._at = QgsPointXY(x, y)
        self.updatePosition()

    def updatePosition(self) -> None:
        """Follow the canvas as it moves."""
        self.setPos(self.toCanvasCoordinates(self._at))

    def boundingRect(self) -> Any:
        """Return the rectangle that holds disc and number."""
        return QRectF(-_RADIUS - 1.0, -20.0, 50.0, 20.0 + _RADIUS + 1.0)

    def paint(self, painter: Any, option: Any = None, widget: Any = None) -> None:  # noqa: ARG002 (Qt's signature)
        """Draw both; the number with a white border, for it may stand on anything."""
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setPen(QPen(QColor("#ffffff"), 1.0))
        painter.setBrush(QBrush(self.color))
        painter.drawEllipse(QPointF(0.0, 0.0), _RADIUS, _RADIUS)
        outline = QPainterPath()
        outline.addText(_NUMBER_AT, painter.font(), str(self.number))
        painter.strokePath(outline, QPen(QColor("#ffffff"), 2.5))
        painter.fillPath(outline, QBrush(self.color.darker(150)))


class Side(QgsMapCanvas):
    """The picture, whose coordinates are column and row, or the map.

    Attributes
    ----------
    name : str
        "picture" or "map".
    """

    def __init__(self, name: str, dock: Any) -> None:
        super().__init__()
        self.name = name
        self._markers: list[_Marker] = []
        self._origin, self._step = (0.0, 0.0), (1.0, 1.0)
        self._tool = _Tool(self, dock)
        self.setCanvasColor(QColor("#ffffff"))
        self.setMapTool(self._tool)

    def show_picture(self, layer: Any) -> None:
        """Show a raster layer in its own pixels."""
        extent = layer.extent()
        self._origin = (extent.xMinimum(), extent.yMaximum())
        self._step = (extent.width() / layer.width(), -extent.height() / layer.height())
        self.setLayers([layer])
        self.setExtent(extent)
        self.refresh()

    def renew(self, count: int) -> None:
        """Have that number of points."""
        for marker in self._markers:
            self.scene().removeItem(marker)
        self._markers = [_Marker(self, number + 1) for number in range(count)]

    def put(self, number: int, u: float, v: float, color: Any, on_top: bool) -> None:
        """Draw a point at its place."""
        marker = self._markers[number]
        marker.color = color
        marker.put(self._origin[0] + u * self._step[0], self._origin[1] + v * self._step[1])
        marker.setZValue(2.0 if on_top else 1.0)
        marker.update()

    def spot(self, pixel: Any) -> tuple[float, float]:
        """Return the coordinates at a pixel of the screen."""
        there = self.getCoordinateTransform().toMapCoordinates(pixel.x(), pixel.y())
        return (there.x() - self._origin[0]) / self._step[0], (there.y() - self._origin[1]) / self._step[1]

    def pixel(self, number: int) -> Any:
        """Return where a point is on the screen."""
        return self._markers[number].pos()

    def nearest(self, pixel: Any, chosen: set[int]) -> int:
        """Return the point under a pixel of the screen, a chosen one before others; -1 for none."""
        apart = []
        for number, marker in enumerate(self._markers):
            far = math.hypot(marker.pos().x() - pixel.x(), marker.pos().y() - pixel.y())
            if far <= _NEAR:
                apart.append((number not in chosen, far, number))
        return min(apart)[2] if apart else -1


class _Tool(QgsMapTool):
    """Drags the point that is pressed upon; elsewhere it adds one, or moves the picture or map."""

    def __init__(self, side: Side, dock: Any) -> None:
        super().__init__(side)
        self._side, self._dock, self._held, self._panning = side, dock, -1, False

    def canvasPressEvent(self, event: Any) -> None:
        """Take the point under the pointer."""
        self._held = self._side.nearest(event.pos(), self._dock.chosen())
        if self._held >= 0:
            self._dock.remember()

    def canvasMoveEvent(self, event: Any) -> None:
        """Have it follow."""
        if self._held >= 0:
            self._dock.move(self._side.name, self._held, *self._side.spot(event.pos()))
        elif event.buttons() & Qt.MouseButton.LeftButton and not self._dock.adding:
            self._panning = True
            self._side.panAction(event)

    def canvasReleaseEvent(self, event: Any) -> None:
        """Leave it there."""
        if self._held >= 0:
            self._dock.move(self._side.name, self._held, *self._side.spot(event.pos()))
        elif self._dock.adding:
            self._dock.click(self._side.name, *self._side.spot(event.pos()))
        elif self._panning:
            self._side.panActionEnd(event.pos())
        self._held, self._panning = -1, False
