"""The plugin's menu and its button in the toolbar: everything in the order in which it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import Qgis, QgsApplication, QgsRasterLayer
from qgis.PyQt import sip
from qgis.PyQt.QtCore import Qt, QUrl
from qgis.PyQt.QtGui import QDesktopServices, QIcon
from qgis.PyQt.QtWidgets import QMenu, QToolButton

from .dock import MatchDock
from .settings import locate_executable, propose_executable
from .window import open_dialog, push

__all__ = ["Menu"]

_HERE = Path(__file__).parent


class Menu:
    """The plugin in the window: menu, button, and the panel of control points.

    Attributes
    ----------
    actions : dict
        The entries, by name.
    """

    def __init__(self, iface: Any) -> None:
        self.iface = iface
        self.dock = MatchDock(iface.mainWindow())
        iface.addDockWidget(Qt.DockWidgetArea.BottomDockWidgetArea, self.dock)
        self.dock.hide()
        self.menu = QMenu("roadgeo", iface.mainWindow())
        self.menu.setIcon(QIcon(str(_HERE / "icon.png")))
        self.actions: dict[str, Any] = {}
        self._add("build", "Build road reference...", "mActionAddOgrLayer.svg", lambda: self._open("buildreference"))
        self._add("locate", "Locate the current layer...", "mActionAddRasterLayer.svg", self.locate)
        self._add("near", "Locate it near what the map shows...", "mActionZoomToLayer.svg", self.locate_near)
        self._add("folder", "Locate a folder of images...", "mIconFolder.svg", lambda: self._open("locatemasks"))
        self._add("mend", "Mend a place by hand", "mActionEditNodesItem.svg", self.mend)
        self.menu.addSeparator()
        self._add("setup", "Set up roadgeo...", "mActionOptions.svg", self.set_up)
        self._add("help", "Help", "mActionHelpContents.svg", self.help)
        iface.pluginMenu().addMenu(self.menu)
        button = QToolButton()
        button.setIcon(self.menu.icon())
        button.setToolTip("roadgeo: locate the current layer; more in the list")
        button.setMenu(self.menu)
        button.setPopupMode(QToolButton.ToolButtonPopupMode.MenuButtonPopup)
        button.clicked.connect(self.locate)
        self.button = button
        self.on_toolbar = iface.addToolBarWidget(button)
        self.question: Any = None
        if locate_executable() is None:
            self.ask_to_set_up()

    def _add(self, name: str, text: str, icon: str, does: Any) -> None:
        action = self.menu.addAction(QgsApplication.getThemeIcon(f"/{icon}"), text)
        action.triggered.connect(lambda _=False: does())
        self.actions[name] = action

    def _open(self, algorithm: str, **parameters: Any) -> Any:
        """Open an algorithm's dialog; without the program, that which sets it up."""
        return open_dialog(algorithm, parameters) if locate_executable() else self.set_up()

    def set_up(self) -> Any:
        """Open the dialog that finds or, where it is not there, installs the program.

        One in the home folder is named there, and starts only when the dialog is run.
        """
        proposed = "" if locate_executable() else propose_executable()
        named = {"PROGRAM": proposed} if proposed else {}
        return open_dialog("setup", {"INSTALL": not (proposed or locate_executable()), **named})

    def ask_to_set_up(self) -> None:
        """Ask in the message bar, until it is done."""
        text = "The program that does the work is not on this computer yet, or was not found."
        self.question = push("roadgeo", text, {"Set up roadgeo...": self.set_up}, Qgis.MessageLevel.Info)

    def forget_question(self) -> None:
        """Take the question back."""
        question, self.question = self.question, None
        if question is not None and not sip.isdeleted(question):
            self.iface.messageBar().popWidget(question)

    def locate(self) -> Any:
        """Locate the raster layer that is selected; where none is, the dialog asks for one."""
        layer = self.iface.activeLayer()
        picture = {"MASK": layer.id()} if isinstance(layer, QgsRasterLayer) else {}
        return self._open("locatemask", **picture)

    def locate_near(self) -> Any:
        """Locate it on the part of the map that the window shows."""
        canvas, layer = self.iface.mapCanvas(), self.iface.activeLayer()
        box, crs = canvas.extent(), canvas.mapSettings().destinationCrs()
        if not crs.isValid():
            text = "The project has no CRS, so nobody knows what the map shows: load a map first, such as a reference"
            self.iface.messageBar().pushMessage("roadgeo", text, Qgis.MessageLevel.Warning)
            return None
        sides = (box.xMinimum(), box.xMaximum(), box.yMinimum(), box.yMaximum())
        area = f"{','.join(f'{side:.9g}' for side in sides)} [{crs.authid()}]"
        picture = {"MASK": layer.id()} if isinstance(layer, QgsRasterLayer) else {}
        return self._open("locatemask", AREA=area, **picture)

    def mend(self, picture: str = "", points: str = "") -> None:
        """Show the panel of control points, with a picture and its points where they are given."""
        self.dock.show()
        self.dock.raise_()
        if picture:
            self.dock.open(picture, points)
        elif not self.dock.picture:
            self.dock.open_first()

    def help(self) -> None:
        """Open the help page, which ships with the plugin."""
        QDesktopServices.openUrl(QUrl.fromLocalFile(str(_HERE / "help.html")))

    def remove(self) -> None:
        """Take all of it away."""
        self.iface.removeToolBarIcon(self.on_toolbar)
        self.iface.removeDockWidget(self.dock)
        self.iface.pluginMenu().removeAction(self.menu.menuAction())
        self.menu.deleteLater()
        self.dock.deleteLater()
