"""The plugin and its Processing provider."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import QgsApplication, QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from .algorithms import ALGORITHMS
from .settings import add_settings, remove_settings

__all__ = ["RoadgeoPlugin", "RoadgeoProvider"]


class RoadgeoProvider(QgsProcessingProvider):
    """The algorithms of roadgeo in the Processing toolbox."""

    def id(self) -> str:
        """Begin the algorithms' ids."""
        return "roadgeo"

    def name(self) -> str:
        """Heading in the toolbox and in the settings."""
        return "roadgeo"

    def icon(self) -> Any:
        """Crossroads under a pin."""
        return QIcon(str(Path(__file__).parent / "icon.png"))

    def load(self) -> bool:
        """Add settings and algorithms."""
        add_settings(self.name(), self.icon())
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        """Take the settings away."""
        remove_settings()

    def loadAlgorithms(self) -> None:
        """Add the algorithms."""
        for algorithm in ALGORITHMS:
            self.addAlgorithm(algorithm())


class RoadgeoPlugin:
    """The object that QGIS loads and unloads."""

    def __init__(self, iface: Any = None) -> None:
        self.iface = iface
        self.provider: RoadgeoProvider | None = None
        self.menu: Any = None

    def initProcessing(self) -> None:
        """Register the provider; without a window only this is called."""
        self.provider = RoadgeoProvider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self) -> None:
        """Start in a window: with menu, button and panel."""
        self.initProcessing()
        if self.iface is not None:
            from .menu import Menu

            self.menu = Menu(self.iface)

    def unload(self) -> None:
        """Leave."""
        if self.menu is not None:
            self.menu.remove()
            self.menu = None
        QgsApplication.processingRegistry().removeProvider(self.provider)
