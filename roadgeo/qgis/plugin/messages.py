"""The result of a search in the window's message bar, with buttons to zoom, to choose a place, or to mend it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import Qgis, QgsProcessingUtils
from qgis.PyQt.QtCore import QTimer, QUrl
from qgis.PyQt.QtGui import QDesktopServices
from qgis.utils import plugins

from .places import PlacesDialog
from .refit import TiePoint, corners, fit, format_points
from .session import Finding
from .window import keep, open_dialog, push, zoom

__all__ = ["announce", "announce_ready"]

#: QGIS reports itself that a task is complete; our message should lie above that.
_AFTER_MS = 400


def announce_ready(version: str) -> None:
    """Report that the program is set up, in place of the question that asked for it, with the next steps."""
    offered = {"Build road reference...": lambda: open_dialog("buildreference", {})}
    _menu().forget_question()
    QTimer.singleShot(
        _AFTER_MS, lambda: push("roadgeo", f"Version {version} is set up.", offered, Qgis.MessageLevel.Success)
    )


def announce(algorithm: str, finding: Finding) -> None:
    """Report a result in the window's message bar, with buttons for the next step."""
    location, offered = finding.location, {}
    located, chosen = (location["status"] == status for status in ("located", "chosen"))
    if chosen:
        text = location["reason"]
    elif located:
        rate = location["error_rate"]
        text = f"located, {location['gsd_m']:.2g} m per pixel" + (f"; {rate['said']}" if rate else "")
    else:
        near = finding.parameters.get("NEAR")
        text = f"{'not sure near the chosen place either: ' if near else ''}{location['reason']}"
    if not (located or chosen) and location["alternatives"]:
        offered["Choose the place..."] = lambda: keep(PlacesDialog(algorithm, finding))
    elif location["footprint_lonlat"]:  # of a refused picture, a place that is known along one direction only
        offered["Zoom to it"] = lambda: zoom(location["footprint_lonlat"])
    if finding.points or location["footprint"]:
        offered["Mend by hand"] = lambda: _mend(finding)
    if finding.page:
        offered["Report"] = lambda: QDesktopServices.openUrl(QUrl.fromLocalFile(finding.page))
    level, lasts_s = (Qgis.MessageLevel.Success, 20) if located else (Qgis.MessageLevel.Warning, 0)
    if chosen:
        level = Qgis.MessageLevel.Info

    def tell() -> None:
        if located or chosen:
            zoom(location["footprint_lonlat"])  # in the project's CRS, which its first layer may have set
        push(finding.name, text, offered, level, lasts_s)

    QTimer.singleShot(_AFTER_MS, tell)


def _menu() -> Any:
    return plugins[Path(__file__).parent.name].menu


def _mend(finding: Finding) -> None:
    """Open the panel with the matched intersections, or else with the corners of the best place."""
    points, location = finding.points, finding.location
    if not points:
        points = QgsProcessingUtils.generateTempFilename(f"{finding.name}.points")
        pixels = corners(*location["size"]).tolist()
        matches = [TiePoint(*pixel, *there) for pixel, there in zip(pixels, location["footprint"])]  # noqa: B905
        Path(points).write_text(format_points(location["crs"], matches, fit(matches)), "utf-8")
    _menu().mend(finding.picture, points)
