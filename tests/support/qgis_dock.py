"""What `test_dock.py` does in QGIS's own window: the panel of matches is opened and used with the mouse.

The task is the JSON file that the environment variable ROADGEO_TASK names.
"""

import json
import os
import traceback
from pathlib import Path

from qgis.core import QgsApplication, QgsPointXY, QgsProject, QgsVectorLayer
from qgis.PyQt.QtCore import QEvent, QPoint, QPointF, Qt, QTimer
from qgis.PyQt.QtGui import QMouseEvent
from qgis.PyQt.QtTest import QTest
from qgis.utils import iface, plugins

TASK = json.loads(Path(os.environ["ROADGEO_TASK"]).read_text("utf-8"))
ANSWER = {}


def residuals(dock):
    return [dock.table.item(k, 1).text() for k in range(dock.table.rowCount())]


def drag(widget, start, end):
    """Press, move and release the mouse."""
    left = Qt.MouseButton.LeftButton
    QTest.mousePress(widget, left, pos=start)
    for at in ((start + end) / 2, end):  # QTest's own moves hold no button
        there = widget.mapToGlobal(at)
        event = QMouseEvent(
            QEvent.Type.MouseMove, QPointF(at), QPointF(there), left, Qt.MouseButtons(left), Qt.KeyboardModifiers()
        )
        QgsApplication.sendEvent(widget, event)
    QTest.mouseRelease(widget, left, pos=end)
    QgsApplication.processEvents()


def use():
    QgsProject.instance().addMapLayer(QgsVectorLayer(TASK["roads"], "roads", "ogr"))
    dock = plugins["roadgeo_qgis"].dock
    ANSWER["hidden"] = dock.isHidden()
    plugins["roadgeo_qgis"].action.trigger()
    iface.mainWindow().resize(1250, 850)
    dock.setMinimumHeight(450)
    ANSWER["refused"] = dock.open(TASK["picture"], TASK["picture"])
    ANSWER["opened"] = dock.open(TASK["picture"], TASK["points"])
    ANSWER["before"], ANSWER["said"] = residuals(dock), dock.said.text()
    for _ in range(5):
        QgsApplication.processEvents()
    dock.view.fitInView(dock.scene.itemsBoundingRect(), Qt.AspectRatioMode.KeepAspectRatio)
    # Switched off in the list.
    dock.table.item(0, 0).setCheckState(Qt.CheckState.Unchecked)
    ANSWER["off"], ANSWER["said_off"] = residuals(dock), dock.said.text()
    dock.table.item(0, 0).setCheckState(Qt.CheckState.Checked)
    # Dragged on the map, by 30 pixels to the right.
    one = dock.matches[1]
    there = dock.canvas.getCoordinateTransform().transform(QgsPointXY(one.x, one.y))
    start = QPoint(round(there.x()), round(there.y()))
    drag(dock.canvas.viewport(), start, start + QPoint(30, 0))
    ANSWER["moved_m"] = dock.matches[1].x - one.x
    ANSWER["pixel_m"] = dock.canvas.mapUnitsPerPixel()
    ANSWER["dragged"] = residuals(dock)
    # Dragged on the picture, where others lie beside it: the one that is chosen lies on top.
    dock.table.selectRow(2)
    two = dock.matches[2]
    start = dock.view.mapFromScene(two.column, two.row)
    drag(dock.view.viewport(), start, start + QPoint(0, 25))
    ANSWER["moved_px"] = dock.matches[2].row - two.row
    dock.canvas.waitWhileRendering()
    QgsApplication.processEvents()
    iface.mainWindow().grab().save(TASK["window"])
    dock.grab().save(TASK["dock"])
    ANSWER["footprint"] = dock.footprint()
    dock.export(TASK["exported"])
    dock.export(TASK["geotiff"])


def start():
    try:
        use()
    except Exception:
        ANSWER["error"] = traceback.format_exc()
    Path(TASK["answer"]).write_text(json.dumps(ANSWER), "utf-8")
    os._exit(0)


QTimer.singleShot(0, start)
