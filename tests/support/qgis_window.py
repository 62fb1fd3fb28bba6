"""What `test_window.py` does in QGIS's own window: `qgis --code` runs this on a virtual screen.

A tour of the plugin as a newcomer makes it: set up, build a reference, locate the current layer near what the map
shows, choose among places, mend by hand. Keeps what happened, and a picture of every dialog. The task is the JSON file
that the environment variable ROADGEO_TASK names.
"""

import importlib
import json
import math
import os
import traceback
from dataclasses import replace
from pathlib import Path

from qgis.core import QgsApplication, QgsProcessingContext, QgsProject, QgsRasterLayer, QgsVectorLayer
from qgis.gui import QgsMessageBarItem
from qgis.PyQt.QtCore import QEvent, QEventLoop, QObject, QPoint, QPointF, Qt, QTimer, pyqtSlot
from qgis.PyQt.QtGui import QDesktopServices, QMouseEvent
from qgis.PyQt.QtTest import QTest
from qgis.PyQt.QtWidgets import QPushButton, QToolButton
from qgis.utils import active_plugins, iface, plugins

TASK = json.loads(Path(os.environ["ROADGEO_TASK"]).read_text("utf-8"))
ANSWER = {"plugins": list(active_plugins), "pages": []}
PROJECT = QgsProject.instance()


class Browser(QObject):
    """Takes the place of the user's browser."""

    @pyqtSlot("QUrl")
    def open(self, url):
        ANSWER["pages"].append(url.toLocalFile())


def settle(milliseconds=100):
    """Let the window draw."""
    loop = QEventLoop()
    QTimer.singleShot(milliseconds, loop.quit)
    loop.exec()


def keep(widget, name):
    """Keep a picture of a widget as it is on the screen."""
    settle()
    widget.grab().save(str(Path(TASK["pictures"], f"{name}.png")))


def describe(node):
    """Names of groups and layers, as the panel of layers shows them."""
    return {child.name(): describe(child) if hasattr(child, "findGroups") else [] for child in node.children()}


def fill_and_run(dialog, name):
    """Keep a picture of an algorithm's dialog, and press Run; return its results."""
    ended, loop = [], QEventLoop()

    def end(successful, results):
        ended.append({"successful": successful, "results": {key: str(value) for key, value in results.items()}})
        loop.quit()

    dialog.algorithmFinished.connect(end)
    keep(dialog, name)
    ended_title = dialog.windowTitle()
    dialog.runButton().click()
    if not ended:
        QTimer.singleShot(240_000, loop.quit)
        loop.exec()
    keep(dialog, f"{name}_log")
    assert ended, f"{name} did not end"
    dialog.close()
    return {"title": ended_title, **ended[0]}


def await_end(dialog):
    """Wait for an algorithm that runs in its dialog; return whether all went well, and the results."""
    ended, loop = [], QEventLoop()
    dialog.algorithmFinished.connect(lambda *done: (ended.extend(done), loop.quit()))
    QTimer.singleShot(240_000, loop.quit)
    loop.exec()
    settle(1000)
    return ended


def message():
    """What the message bar says, and its buttons."""
    settle(1000)
    item = iface.messageBar().currentItem()
    buttons = {one.text(): one for one in item.findChildren(QPushButton)} if item else {}
    return (f"{item.title()}: {item.text()}" if item else ""), buttons


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


def tour():
    plugin = plugins["roadgeo_qgis"]
    menu = plugin.menu
    messages, window = (importlib.import_module(f"roadgeo_qgis.{name}") for name in ("messages", "window"))
    iface.mainWindow().resize(1280, 850)
    # The menu and the button.
    ANSWER["menu"] = [action.text() for action in menu.menu.actions() if action.text()]
    ANSWER["in_menu"] = any(one.menu() is menu.menu for one in iface.pluginMenu().actions())
    ANSWER["on_toolbar"] = menu.button in iface.mainWindow().findChildren(QToolButton)
    menu.menu.popup(iface.mainWindow().mapToGlobal(QPoint(400, 200)))
    keep(menu.menu, "menu")
    menu.menu.hide()
    # Without the program, the window says so at first, and offers to set it up; it finds what is there.
    menu.ask_to_set_up()
    ANSWER["first"], buttons = message()
    ANSWER["first_buttons"] = list(buttons)
    buttons["Set up roadgeo..."].click()
    ANSWER["setup"] = fill_and_run(window.OPEN[-1], "setup")
    ANSWER["ready"], buttons = message()
    ANSWER["ready_buttons"] = list(buttons)
    ANSWER["messages"] = [one.text() for one in iface.messageBar().findChildren(QgsMessageBarItem)]
    # Build, from a layer, into the library.
    roads = QgsVectorLayer(TASK["roads"], "porto streets", "ogr")
    PROJECT.addMapLayer(roads)
    wanted = {"ROADS": roads.id(), "KINDS": "all"}
    ANSWER["build"] = fill_and_run(window.open_dialog("buildreference", wanted), "build")
    PROJECT.removeMapLayer(roads.id())
    # Locate the current layer near what the map shows.
    iface.setActiveLayer(next(one for one in PROJECT.mapLayers().values() if one.name().endswith(" roads")))
    iface.zoomToActiveLayer()
    picture = QgsRasterLayer(TASK["picture"], "drone picture")
    PROJECT.addMapLayer(picture)
    iface.setActiveLayer(picture)
    dialog = menu.locate_near()
    wrapper = dialog.mainWidget().wrappers["REFERENCE"]
    ANSWER["references"] = [wrapper.combo.itemText(k) for k in range(wrapper.combo.count())]
    values = dialog.createProcessingParameters()
    ANSWER["asked"] = {name: str(values.get(name)) for name in ("MASK", "REFERENCE", "AREA")}
    ANSWER["asked"]["MASK"] = ANSWER["asked"]["MASK"] == picture.id()
    wrapper.setValue("porto-streets")
    dialog.mainWidget().wrappers["REPORT"].setWidgetValue(True, QgsProcessingContext())
    ANSWER["locate"] = fill_and_run(dialog, "locate")
    ANSWER["message"], buttons = message()
    ANSWER["buttons"] = list(buttons)
    buttons["Zoom to it"].click()
    settle()
    iface.mapCanvas().waitWhileRendering()
    keep(iface.mainWindow(), "window")
    ANSWER["layers"] = describe(PROJECT.layerTreeRoot())
    extent = iface.mapCanvas().extent()
    ANSWER["shown"] = [extent.width(), extent.center().x(), extent.center().y()]
    # Mend by hand: from the menu, it opens what was located; from the message, with its points.
    menu.mend()
    ANSWER["opened"] = [menu.dock.picture, len(menu.dock.matches)]
    buttons["Mend by hand"].click()
    mend(menu.dock)
    menu.dock.hide()
    choose(messages, window)
    # Switched off in the list of plugins.
    plugin.unload()
    settle()
    ANSWER["left"] = [
        any(one.text() == "roadgeo" for one in iface.pluginMenu().actions()),
        QgsApplication.processingRegistry().providerById("roadgeo") is not None,
    ]


def choose(messages, window):
    """Two places fit: the second is looked at, and chosen."""
    session = importlib.import_module("roadgeo_qgis.session")
    location = json.loads(Path(ANSWER["locate"]["results"]["OUTPUT_FOLDER"], "drone_location.json").read_text("utf-8"))
    center = location["center"]
    reason = "two places fit almost equally: the roads that the picture shows explain one of them only 6 times better; "
    reason += "a pixel size, a heading or a part of the map would decide between them"
    second = {"center": {**center, "lon": center["lon"] - 0.01, "lat": center["lat"] + 0.01}, "log10_odds": -0.8}
    second["reference"] = location["reference"]
    location |= {"status": "ambiguous", "reason": reason, "log10_odds": 0.8, "alternatives": [second]}
    parameters = {"MASK": TASK["picture"], "REFERENCE": "porto-streets", "OUTPUT_FOLDER": "TEMPORARY_OUTPUT"}
    found = session.Finding("drone", TASK["picture"], "", "", location, parameters)
    messages.announce("locatemask", found)
    ANSWER["ambiguous"], buttons = message()
    ANSWER["ambiguous_buttons"] = list(buttons)
    bar, last = iface.messageBar(), buttons["Mend by hand"]
    ANSWER["button_within"] = last.mapTo(bar, QPoint(last.width(), 0)).x() < bar.width()
    keep(iface.mainWindow(), "ambiguous")
    buttons["Choose the place..."].click()
    dialog = window.OPEN[-1]
    dialog.list.setCurrentItem(dialog.list.topLevelItem(1))
    settle()
    iface.mapCanvas().waitWhileRendering()
    extent = iface.mapCanvas().extent()
    ANSWER["looked_at"] = extent.center().x()
    keep(dialog, "alike")
    ANSWER["places"] = [[dialog.list.topLevelItem(row).text(k) for k in (0, 1, 3)] for row in range(len(dialog.places))]
    dialog.button.click()
    again = window.OPEN[-1]
    values = again.createProcessingParameters()
    ANSWER["chosen"] = {name: str(values.get(name)) for name in ("NEAR", "NEAR_RADIUS", "MASK")}
    await_end(again)
    # Not sure there either: the panel opens with the corners of the best place.
    messages.announce("locatemask", replace(found, parameters={**parameters, **ANSWER["chosen"]}))
    ANSWER["again"], buttons = message()
    buttons["Mend by hand"].click()
    dock = plugins["roadgeo_qgis"].menu.dock
    ANSWER["corners"] = [residuals(dock), dock.footprint(), location["footprint"]]
    dock.hide()
    # Refused: a warning, with nothing to zoom to.
    nothing = dict.fromkeys(("center", "footprint", "footprint_lonlat"))
    refused = {**location, **nothing, "status": "not_located", "reason": "no", "alternatives": []}
    messages.announce("locatemask", replace(found, location=refused))
    ANSWER["refused"], buttons = message()
    ANSWER["refused_buttons"] = list(buttons)
    take(window)


def take(window):
    """A picture of another city is refused; the second of its places is looked at, and taken."""
    wanted = {"MASK": TASK["refused"], "REFERENCE": "porto-streets", "OUTPUT_FOLDER": "TEMPORARY_OUTPUT"}
    fill_and_run(window.open_dialog("locatemask", wanted), "refused")
    _, buttons = message()
    buttons["Choose the place..."].click()
    dialog = window.OPEN[-1]
    dialog.list.setCurrentItem(dialog.list.topLevelItem(1))
    settle()
    iface.mapCanvas().waitWhileRendering()
    keep(dialog, "places")
    second = dialog.places[1]
    dialog.take()
    results = {key: str(value) for key, value in await_end(window.OPEN[-1])[1].items()}
    ANSWER["taken"] = {"place": [second.lon, second.lat], "listed": len(dialog.places), **results}
    ANSWER["taken"]["message"], _ = message()
    ANSWER["taken"]["alone"] = [one.title() for one in iface.messageBar().items()].count("elsewhere")
    middle = iface.mapCanvas().extent().center()
    ANSWER["taken"]["shown"] = [middle.x(), middle.y()]
    ANSWER["taken"]["open"] = [one.windowTitle() for one in QgsApplication.topLevelWidgets() if one.isVisible()]
    iface.mapCanvas().waitWhileRendering()
    keep(iface.mainWindow(), "taken")


def residuals(dock):
    return [float(row.text(1) or "nan") for row in dock.rows]


def mend(dock):
    """Switch off, drag, add and delete points, and write what comes of it."""
    answer = ANSWER["dock"] = {"shown": dock.isVisible(), "picture": dock.picture}
    dock.setMinimumHeight(430)
    settle()
    dock.view.zoomToFullExtent()
    dock._zoom()
    dock.view.waitWhileRendering()
    dock.canvas.waitWhileRendering()
    answer["head"] = dock.list.headerItem().text(1)
    answer["before"], answer["said"] = residuals(dock), dock.status.text()
    answer["points"] = [[one.column, one.row, one.x, one.y] for one in dock.matches]
    answer["matches"] = len(dock.matches)
    dock.rows[0].setCheckState(0, Qt.CheckState.Unchecked)
    answer["off"], answer["said_off"] = residuals(dock), dock.status.text()
    dock.rows[0].setCheckState(0, Qt.CheckState.Checked)
    # Dragged on the map, by 30 pixels to the right.
    dock.list.setCurrentItem(dock.rows[1])
    one = dock.matches[1]
    start = dock.canvas.pixel(1).toPoint()
    drag(dock.canvas.viewport(), start, start + QPoint(30, 0))
    answer["moved_m"] = dock.matches[1].x - one.x
    answer["pixel_m"] = dock.canvas.mapUnitsPerPixel()
    answer["dragged"] = residuals(dock)
    # Sorted by residuals, the largest first; and taken back.
    dock.list.header().setSortIndicator(1, Qt.SortOrder.DescendingOrder)
    shown = [dock.list.topLevelItem(k) for k in range(dock.list.topLevelItemCount())]
    answer["sorted"] = [[int(row.text(0)) for row in shown], [float(row.text(1)) for row in shown]]
    dock.list.header().setSortIndicator(0, Qt.SortOrder.AscendingOrder)
    dock.undo()
    answer["undone"] = [dock.matches[1] == one, residuals(dock)]
    # Dragged on the picture, where others lie beside it: the one that is chosen lies on top.
    dock.list.setCurrentItem(dock.rows[2])
    two = dock.matches[2]
    start = dock.view.pixel(2).toPoint()
    drag(dock.view.viewport(), start, start + QPoint(0, 25))
    answer["moved_px"] = dock.matches[2].row - two.row
    # Both are deleted; one is added by a click on the picture.
    dock.list.clearSelection()
    for row in dock.rows[1:3]:
        row.setSelected(True)
    dock.delete_chosen()
    answer["deleted"] = len(dock.matches)
    dock.buttons["Add points"].click()
    spots = [(dock.size[0] * k / 20, dock.size[1] * n / 20) for k in range(2, 19) for n in range(2, 19)]
    free = max(spots, key=lambda spot: min(math.dist(spot, (one.column, one.row)) for one in dock.matches))
    there = dock.view.getCoordinateTransform().transform(free[0], -free[1])
    spot = QPoint(round(there.x()), round(there.y()))
    QTest.mouseClick(dock.view.viewport(), Qt.MouseButton.LeftButton, pos=spot)
    answer["added"] = [len(dock.matches), residuals(dock)[-1]]
    dock.buttons["Add points"].click()
    keep(dock, "mend")
    keep(iface.mainWindow(), "mend_window")
    answer["footprint"] = dock.footprint()
    for suffix in ("points", "tif"):
        dock.export(f"{TASK['mended']}.{suffix}")
    dock.draw()
    answer["drawn"] = fill_and_run(dock.drawing, "place")["results"]
    answer["layer"] = any(one.name() == "drone by points" for one in PROJECT.mapLayers().values())
    answer["matrix"] = dock.fitted.matrix.tolist()
    # A picture without points: four are clicked, on the picture and on the map in turn.
    answer["refused"] = dock.open(TASK["picture"], TASK["picture"])
    answer["refused_said"] = dock.status.text()
    dock.open(TASK["picture"])
    answer["empty"] = dock.status.text()
    width, height = dock.size
    for u, v in ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9)):
        dock.click("picture", u * width, v * height)
        answer["then"] = dock.status.text()
        dock.click("map", -8.61 + 1e-5 * u * width, 41.15 - 1e-5 * v * height)
    answer["own"] = residuals(dock)


def start():
    try:
        tour()
    except Exception:
        ANSWER["error"] = traceback.format_exc()
    Path(TASK["answer"]).write_text(json.dumps(ANSWER), "utf-8")
    os._exit(0)  # without QGIS's questions about saving


browser = Browser()
QDesktopServices.setUrlHandler("file", browser, "open")
QTimer.singleShot(0, start)
