"""Run the QGIS plugin with the real PyQt6, in place of the PyQt5 of QGIS 3.22.

    python plugin_on_qt6.py PLUGIN_FOLDER

Needs PyQt6 and NumPy alone: Debian has no QGIS that was built with PyQt6. `qgis.PyQt` is PyQt6 itself; the classes of
QGIS are played by one that takes anything. All modules are loaded, all parameters defined, and the panel and the dialog
of places are opened. Prints the parameters of each algorithm, with their classes, as JSON.
"""

import ast
import importlib
import json
import sys
import types
from pathlib import Path
from unittest.mock import MagicMock

import PyQt6
from PyQt6 import sip
from PyQt6.QtWidgets import QApplication, QWidget


class Anything(type):
    """A class of classes whose every attribute is there."""

    def __getattr__(cls, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return MagicMock()


class Played(metaclass=Anything):
    def __init__(self, *arguments, **settings):
        self.arguments = arguments

    def __getattr__(self, name):
        return MagicMock()


class Crs(Played):
    def isValid(self):
        return False


class Canvas(QWidget):
    def __getattr__(self, name):
        return MagicMock()


class Module(types.ModuleType):
    """A module of QGIS, which has any class."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        vars(self)[name] = type(name, (Played,), {})
        return vars(self)[name]


def play_qgis():
    """Put the modules in place that the plugin imports from QGIS."""
    names = ("qgis", "qgis.core", "qgis.gui", "qgis.utils", "processing", "processing.core", "processing.gui")
    names += ("processing.core.ProcessingConfig", "processing.gui.wrappers")
    known = {name: Module(name) for name in names}
    known["qgis.core"].QgsCoordinateReferenceSystem = Crs
    known["qgis.core"].QgsProcessingException = Exception
    known["qgis.gui"].QgsMapCanvas = Canvas
    known["qgis.utils"].iface = MagicMock()
    known["qgis.utils"].iface.mainWindow.return_value = None
    for name in ("QtCore", "QtGui", "QtWidgets"):
        known[f"qgis.PyQt.{name}"] = importlib.import_module(f"PyQt6.{name}")
    sys.modules.update({**known, "qgis.PyQt": PyQt6, "qgis.PyQt.sip": sip})


def unknown_names(folder):
    """What the plugin's sources take from Qt, by import or as `Class.name.name`, and PyQt6 does not have."""
    wrong = []
    for path in sorted(Path(folder).glob("*.py")):
        tree, known = ast.parse(path.read_text("utf-8")), {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("qgis.PyQt."):
                module = importlib.import_module(node.module.replace("qgis.PyQt", "PyQt6"))
                known |= {name.asname or name.name: getattr(module, name.name, None) for name in node.names}
        wrong += [f"{path.name}: {name}" for name, found in known.items() if found is None]
        for node in ast.walk(tree):
            words, inner = [], node
            while isinstance(inner, ast.Attribute):
                words, inner = [inner.attr, *words], inner.value
            if words and isinstance(inner, ast.Name) and isinstance(known.get(inner.id), type):
                found = known[inner.id]
                for word in words:
                    found = getattr(found, word, None)
                wrong += [] if found is not None else [f"{path.name}: {'.'.join([inner.id, *words])}"]
    return wrong


def main():
    """Load all of the plugin, define its parameters, and open its widgets."""
    folder = Path(sys.argv[1])
    application = QApplication(["qgis", "-platform", "offscreen"])
    wrong = unknown_names(folder)
    assert not wrong, f"PyQt6 has no {', '.join(wrong)}"
    play_qgis()
    sys.path.insert(0, str(folder.parent))
    loaded = {path.stem: importlib.import_module(f"{folder.name}.{path.stem}") for path in folder.glob("[!_]*.py")}
    algorithms = {}
    for algorithm in loaded["algorithms"].ALGORITHMS:
        made = algorithm()
        made.initAlgorithm()
        assert not made.icon().isNull()
        assert made.helpUrl().endswith(f"help.html#{made.name()}")
        algorithms[made.name()] = {option.name: type(option.define()).__name__ for option in made.OPTIONS}
    dock, match = loaded["dock"].MatchDock(), loaded["refit"].TiePoint
    dock._renew([match(u, v, 2.0 * u, 3.0 * v) for u, v in ((0, 0), (100, 0), (100, 80), (0, 80), (40, 30))])
    dock.delete_chosen()
    dock.undo()
    place = loaded["library"].ListedPlace(8.0, 47.0, 3.0, "town", [])
    loaded["places"].list_places = lambda _: [place]
    loaded["places"]._measure = lambda *_: 0.0
    location = {"reason": "two places fit", "footprint_lonlat": None}
    dialog = loaded["places"].PlacesDialog("locatemask", MagicMock(location=location))
    application.processEvents()
    print(json.dumps({"algorithms": algorithms, "status": dock.status.text(), "rows": dialog.list.topLevelItemCount()}))


main()
