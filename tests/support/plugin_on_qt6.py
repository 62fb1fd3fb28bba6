"""Run the QGIS plugin with the real PyQt6, in place of the PyQt5 of QGIS 3.22.

    python plugin_on_qt6.py PLUGIN_FOLDER MASK OUTPUT_FOLDER

Wants nothing but PyQt6, as Debian has no QGIS that was built with it. `qgis.PyQt` is PyQt6 itself; `qgis.core` is
played by classes with the enumerations that the plugin needs, which are known by their scope only, as in PyQt6. Prints
what came out as JSON.
"""

import ast
import enum
import importlib
import json
import sys
import types
from pathlib import Path

import PyQt6
from PyQt6 import sip
from PyQt6.QtCore import QObject, pyqtSlot
from PyQt6.QtGui import QDesktopServices, QGuiApplication


def scoped(name, *members):
    """An enumeration as PyQt6 has them."""
    return enum.Flag(name, members)


class Definition:
    """A parameter: what it is called, and with what else it was made."""

    Flag = scoped("Flag", "FlagAdvanced", "FlagOptional")

    def __init__(self, name, description="", **settings):
        self.own_name, self.description, self.settings = name, description, settings
        self.own_flags, self.help = self.Flag(0), ""

    def name(self):
        return self.own_name

    def defaultValue(self):
        return self.settings.get("defaultValue")

    def setHelp(self, text):
        self.help = text

    def setMetadata(self, metadata):
        self.metadata = metadata

    def flags(self):
        return self.own_flags

    def setFlags(self, flags):
        assert isinstance(flags, self.Flag), flags
        self.own_flags = flags


class Number(Definition):
    Type = scoped("Type", "Integer", "Double")

    def __init__(self, name, description="", type=None, **settings):
        assert isinstance(type, self.Type), type
        super().__init__(name, description, **settings)


class File(Definition):
    Behavior = scoped("Behavior", "File", "Folder")


class Source(Definition):
    def __init__(self, name, description="", types=(), **settings):
        assert all(isinstance(item, Processing.SourceType) for item in types), types
        super().__init__(name, description, **settings)


class Processing:
    SourceType = scoped("SourceType", "TypeVectorLine", "TypeVectorPolygon")


class Algorithm:
    """Keeps parameters and outputs, and reads values as QGIS does."""

    def __init__(self):
        self.parameters, self.outputs = {}, {}

    def addParameter(self, definition):
        self.parameters[definition.name()] = definition

    def addOutput(self, output):
        self.outputs[output.name()] = output

    def parameterDefinition(self, name):
        return self.parameters[name]

    def value(self, parameters, name, context):
        return parameters.get(name, self.parameters[name].defaultValue())

    parameterAsString = parameterAsFile = parameterAsDouble = parameterAsInt = parameterAsBoolean = value

    def parameterAsEnumStrings(self, parameters, name, context):
        found = self.value(parameters, name, context)
        return found if isinstance(found, list) else [found]

    def parameterAsRasterLayer(self, parameters, name, context):
        return Layer(parameters[name])


class Layer:
    def __init__(self, path):
        self.path = path

    def providerType(self):
        return "gdal"

    def source(self):
        return self.path

    def name(self):
        return Path(self.path).stem


class Providers:
    @staticmethod
    def instance():
        return Providers()

    def decodeUri(self, provider, source):
        return {"path": source}


class Provider(QObject):
    def __init__(self):
        super().__init__()
        self.algorithms = []

    def addAlgorithm(self, algorithm):
        self.algorithms.append(algorithm)

    def refreshAlgorithms(self):
        self.loadAlgorithms()


class Registry:
    def __init__(self):
        self.providers = []

    def addProvider(self, provider):
        provider.load()
        self.providers.append(provider)

    def removeProvider(self, provider):
        provider.unload()
        self.providers.remove(provider)


REGISTRY = Registry()


class Context:
    """Takes the layers that are to be loaded."""

    class LayerDetails:
        def __init__(self, name, project, output, hint):
            assert isinstance(hint, Utils.LayerHint), hint
            self.name, self.styler = name, None

        def setPostProcessor(self, styler):
            self.styler = styler

    def __init__(self):
        self.layers = []

    def project(self):
        return self

    def mapLayers(self):
        return {}

    def addLayerToLoadOnCompletion(self, source, details):
        assert not sip.isdeleted(details.styler)
        self.layers.append(details.name)


class Utils:
    LayerHint = scoped("LayerHint", "Vector", "Raster")


class Feedback:
    """Keeps what is said."""

    def __init__(self):
        self.said = []

    def isCanceled(self):
        return False

    def pushInfo(self, text):
        self.said.append(text)

    setProgress = setProgressText = pushCommandInfo = pushWarning = reportError = pushInfo


class Application:
    @staticmethod
    def processingRegistry():
        return REGISTRY

    @staticmethod
    def qgisSettingsDirPath():
        return "/config/profiles/default/"


class Kept:
    """QGIS's settings: none yet."""

    def value(self, name, default):
        return default


CORE = {
    "QgsApplication": Application,
    "QgsProcessing": Processing,
    "QgsProcessingAlgorithm": Algorithm,
    "QgsProcessingContext": Context,
    "QgsProcessingException": type("QgsProcessingException", (Exception,), {}),
    "QgsProcessingLayerPostProcessorInterface": type("QgsProcessingLayerPostProcessorInterface", (QObject,), {}),
    "QgsProcessingParameterDefinition": Definition,
    "QgsProcessingParameterFeatureSource": Source,
    "QgsProcessingParameterFile": File,
    "QgsProcessingParameterNumber": Number,
    "QgsProcessingProvider": Provider,
    "QgsProcessingUtils": Utils,
    "QgsProject": object,
    "QgsCoordinateReferenceSystem": str,
    "QgsProviderRegistry": Providers,
    "QgsSettings": Kept,
    **{f"Qgs{name}": object for name in ("CoordinateTransform", "PointXY", "VectorLayer")},
}


class Settings:
    """Processing's settings."""

    settingIcons: dict = {}
    FILE = 3

    def __init__(self, group="", name="", description="", default=None, valuetype=None):
        assert valuetype in (None, self.FILE)

    @staticmethod
    def addSetting(setting):
        pass

    @staticmethod
    def readSettings():
        pass

    @staticmethod
    def removeSetting(name):
        pass

    @staticmethod
    def getSetting(name):
        return ""


def play_qgis():
    """Put the modules in place that the plugin imports from QGIS."""
    core = types.ModuleType("qgis.core")
    plain = ("Band", "Boolean", "Crs", "Enum", "Extent", "FileDestination", "FolderDestination", "Point")
    plain += ("RasterLayer", "String")
    for name in plain:
        CORE[f"QgsProcessingParameter{name}"] = type(name, (Definition,), {})
    for name in ("File", "Number", "RasterLayer", "String", "VectorLayer"):
        CORE[f"QgsProcessingOutput{name}"] = type(name, (Definition,), {})
    vars(core).update(CORE)
    utils = types.ModuleType("qgis.utils")
    utils.iface = object()
    config = types.ModuleType("processing.core.ProcessingConfig")
    config.ProcessingConfig, config.Setting = Settings, Settings
    known = {"qgis": types.ModuleType("qgis"), "qgis.PyQt": PyQt6, "qgis.PyQt.sip": sip, "qgis.core": core}
    known |= {"qgis.utils": utils, "processing": types.ModuleType("processing")}
    known |= {"processing.core": types.ModuleType("processing.core"), config.__name__: config}
    for name in ("QtCore", "QtGui", "QtWidgets"):
        known[f"qgis.PyQt.{name}"] = importlib.import_module(f"PyQt6.{name}")
    sys.modules.update(known)


class Browser(QObject):
    """Takes the place of the user's browser."""

    def __init__(self):
        super().__init__()
        self.pages = []

    @pyqtSlot("QUrl")
    def open(self, url):
        self.pages.append(url.toLocalFile())


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
    """Load the plugin, look at all that it offers, run an algorithm, and unload it."""
    folder, mask, found = sys.argv[1:]
    application = QGuiApplication(["qgis", "-platform", "offscreen"])
    browser = Browser()
    QDesktopServices.setUrlHandler("file", browser.open)
    wrong = unknown_names(folder)
    assert not wrong, f"PyQt6 has no {', '.join(wrong)}"
    play_qgis()
    sys.path.insert(0, str(Path(folder).parent))
    plugin = importlib.import_module(Path(folder).name).classFactory(None)
    window, heard = types.ModuleType("messages"), []
    window.announce = lambda algorithm, finding: heard.extend([algorithm, finding.name, finding.location["status"]])
    sys.modules[f"{Path(folder).name}.messages"] = window
    plugin.initGui()
    (provider,) = REGISTRY.providers
    assert not provider.icon().isNull()
    reported = {}
    for algorithm in provider.algorithms:
        made = algorithm.createInstance()
        made.initAlgorithm()
        assert not made.icon().isNull()
        assert made.canExecute() == (True, "")
        assert made.shortHelpString()
        reported[made.name()] = [made.helpUrl(), len(made.parameters), len(made.outputs)]
        folded = [
            parameter for parameter in made.parameters.values() if parameter.flags() & Definition.Flag.FlagAdvanced
        ]
        reported[made.name()].append(len(folded))
        reported[made.name()].append({name: type(parameter).__name__ for name, parameter in made.parameters.items()})
    locate = next(item for item in provider.algorithms if item.name() == "locatemask").createInstance()
    locate.initAlgorithm()
    context, feedback = Context(), Feedback()
    results = locate.processAlgorithm({"MASK": mask, "OUTPUT_FOLDER": found, "REPORT": True}, context, feedback)
    locate.postProcessAlgorithm(context, feedback)
    application.processEvents()
    plugin.unload()
    answer = {
        "algorithms": reported,
        "results": results,
        "layers": context.layers,
        "pages": browser.pages,
        "told": heard,
    }
    print(json.dumps({**answer, "qt": sip.SIP_VERSION_STR, "said": feedback.said}))


main()
