"""What `test_window.py` does in QGIS's own window: `qgis --code` runs this on a virtual screen.

It opens the dialog of an algorithm, presses its button Run, and keeps what then is in the project, with pictures of the
dialog and of the window. The task is the JSON file that the environment variable ROADGEO_TASK names.
"""

import json
import os
import traceback
from pathlib import Path

import processing
from qgis.core import QgsApplication, QgsProject
from qgis.PyQt.QtCore import QObject, QTimer, pyqtSlot
from qgis.PyQt.QtGui import QDesktopServices
from qgis.utils import active_plugins, iface

TASK = json.loads(Path(os.environ["ROADGEO_TASK"]).read_text("utf-8"))
ANSWER = {"plugins": list(active_plugins), "pages": []}


class Browser(QObject):
    """Takes the place of the user's browser."""

    @pyqtSlot("QUrl")
    def open(self, url):
        ANSWER["pages"].append(url.toLocalFile())


def describe(node):
    """Names of groups and layers, as the panel of layers shows them."""
    return {child.name(): describe(child) if hasattr(child, "findGroups") else [] for child in node.children()}


def finish():
    """Write what came out, and leave without QGIS's questions about saving."""
    Path(TASK["answer"]).write_text(json.dumps(ANSWER), "utf-8")
    os._exit(0)


def guarded(step):
    """Have an exception in a step end the test, not wait for its time limit."""

    def call(*arguments):
        try:
            step(*arguments)
        except Exception:
            ANSWER["error"] = traceback.format_exc()
            finish()

    return call


@guarded
def start():
    """Open the dialog, filled in, and press Run."""
    global dialog  # or Python would let go of it
    provider = QgsApplication.processingRegistry().providerById("roadgeo")
    ANSWER["algorithms"] = [algorithm.name() for algorithm in provider.algorithms()]
    dialog = processing.createAlgorithmDialog(TASK["algorithm"], TASK["parameters"])
    dialog.algorithmFinished.connect(guarded(ended))
    dialog.show()
    QgsApplication.processEvents()
    ANSWER["title"] = dialog.windowTitle()
    dialog.grab().save(TASK["dialog"])
    dialog.runButton().click()


def ended(successful, results):
    """Look at the map once it is drawn."""
    ANSWER["successful"], ANSWER["results"] = successful, {name: str(value) for name, value in results.items()}
    dialog.grab().save(TASK["log"])
    dialog.close()
    layers = QgsProject.instance().mapLayers().values()
    iface.setActiveLayer(next(layer for layer in layers if layer.name().endswith("footprint")))
    iface.zoomToActiveLayer()
    QTimer.singleShot(0, guarded(look))


def look():
    """Keep a picture of the window, and what its panel of layers shows."""
    iface.mapCanvas().waitWhileRendering()
    QgsApplication.processEvents()
    iface.mainWindow().grab().save(TASK["window"])
    ANSWER["layers"] = describe(QgsProject.instance().layerTreeRoot())
    finish()


browser = Browser()
QDesktopServices.setUrlHandler("file", browser, "open")
QTimer.singleShot(0, start)
