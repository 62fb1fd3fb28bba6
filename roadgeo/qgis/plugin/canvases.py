"""Picture and map of the panel to mend a place: numbered points, which are dragged, and clicks that add some."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from qgis.core import QgsPointXY
from qgis.gui import QgsMapCanvasItem, QgsMapTool
from qgis.PyQt.QtCore import QPointF, QRectF, Qt
from qgis.PyQt.QtGui import QBrush, QColor, QPainter, QPainterPath, QPen
from qgis.PyQt.QtWidgets import QGraphicsItem, QGraphicsView

__all__ = ["Dot", "MapTool", "Marker", "PictureView"]

#: Radius of a point on the screen, and where its number stands, pixels.
_RADIUS, _NUMBER_AT = 5.5, QPointF(7.0, -4.0)


class _Numbered:
    """A point that is drawn as a disc with its number beside it, as large on the screen whatever is zoomed."""

    number, color = 0, QColor("#000000")

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


class Dot(_Numbered, QGraphicsItem):
    """A point on the picture, which can be dragged."""

    def __init__(self, number: int, dock: Any) -> None:
        super().__init__()
        self.number, self._dock = number, dock
        self.setFlag(QGraphicsItem.GraphicsItemFlag.ItemIsMovable)
        self.setFlag(QGraphicsItem.GraphicsItemFlag.ItemIgnoresTransformations)
        self.setCursor(Qt.CursorShape.SizeAllCursor)

    def shape(self) -> Any:
        """Return its disc, by which it is taken."""
        disc = QPainterPath()
        disc.addEllipse(QPointF(0.0, 0.0), _RADIUS + 1.0, _RADIUS + 1.0)
        return disc

    def mousePressEvent(self, event: Any) -> None:
        """Remember where it was."""
        super().mousePressEvent(event)
        self._dock.remember()

    def mouseMoveEvent(self, event: Any) -> None:
        """Report its new position."""
        super().mouseMoveEvent(event)
        self._dock.move(self.number - 1, column=self.pos().x(), row=self.pos().y())


class Marker(_Numbered, QgsMapCanvasItem):
    """A point on the map; `MapTool` drags it."""

    def __init__(self, canvas: Any, number: int) -> None:
        super().__init__(canvas)
        self.number, self._at = number, QgsPointXY(0.0, 0.0)

    def put(self, x: float, y: float) -> None:
        """Put it somewhere on the map."""
        self._at = QgsPointXY(x, y)
        self.updatePosition()

    def updatePosition(self) -> None:
        """Follow the map as it moves."""
        self.setPos(self.toCanvasCoordinates(self._at))


class PictureView(QGraphicsView):
    """The picture: the wheel zooms, dragging moves it, and a click adds a point where that is switched on."""

    def __init__(self, scene: Any, dock: Any) -> None:
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
        if self._dock.adding and not isinstance(self.itemAt(event.pos()), Dot):
            there = self.mapToScene(event.pos())
            self._dock.click("picture", there.x(), there.y())
        else:
            super().mousePressEvent(event)


class MapTool(QgsMapTool):
    """Drags the point on the map that is pressed upon; elsewhere it adds one, or moves the map."""

    def __init__(self, canvas: Any, dock: Any, nearest: Callable[[Any], int]) -> None:
        super().__init__(canvas)
        self._dock, self._nearest, self._held, self._panning = dock, nearest, -1, False

    def canvasPressEvent(self, event: Any) -> None:
        """Take the point under the pointer."""
        self._held = self._nearest(event.pos())
        if self._held >= 0:
            self._dock.remember()

    def canvasMoveEvent(self, event: Any) -> None:
        """Have it follow."""
        there = self.toMapCoordinates(event.pos())
        if self._held >= 0:
            self._dock.move(self._held, x=there.x(), y=there.y())
        elif event.buttons() & Qt.MouseButton.LeftButton and not self._dock.adding:
            self._panning = True
            self.canvas().panAction(event)

    def canvasReleaseEvent(self, event: Any) -> None:
        """Leave it there."""
        there = self.toMapCoordinates(event.pos())
        if self._held >= 0:
            self._dock.move(self._held, x=there.x(), y=there.y())
        elif self._dock.adding:
            self._dock.click("map", there.x(), there.y())
        elif self._panning:
            self.canvas().panActionEnd(event.pos())
        self._held, self._panning = -1, False
