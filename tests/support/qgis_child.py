"""What the tests ask of QGIS: run by QGIS's own Python as a child of the tests, which send it lists of tasks."""

import json
import os
import sys
import traceback
from multiprocessing.connection import Connection
from pathlib import Path

import qgis.utils
from qgis.analysis import QgsGcpTransformerInterface
from qgis.core import (
    QgsApplication,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsPointXY,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProject,
    QgsRasterLayer,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QSize, QTimer
from qgis.PyQt.QtGui import QColor

WARNING, CRITICAL = 1, 2


class Heard(QgsProcessingFeedback):
    """Keeps what an algorithm says."""

    def __init__(self):
        super().__init__(False)
        self.said = []

    def reportError(self, error, fatalError=False):
        self.said.append(f"error: {error}")

    def pushWarning(self, warning):
        self.said.append(f"warning: {warning}")

    def setProgressText(self, text):
        self.said.append(f"progress: {text}")


def start():
    """Start QGIS with the plugin, as installed in the profile."""
    profile = Path(os.environ["QGIS_CUSTOM_CONFIG_PATH"], "profiles", "default")
    application = QgsApplication([], True, str(profile))
    application.initQgis()
    plugins = [str(Path(folder, "python", "plugins")) for folder in (QgsApplication.pkgDataPath(), profile)]
    sys.path += plugins
    qgis.utils.plugin_paths = plugins
    qgis.utils.updateAvailablePlugins()
    for name in ("processing", "roadgeo_qgis"):
        assert qgis.utils.loadPlugin(name), name
        assert qgis.utils.startProcessingPlugin(name), name
    return application


def run(algorithm, parameters):
    """Run an algorithm as the toolbox does, with its layers loaded into the project; describe those that came."""
    import processing

    before = set(QgsProject.instance().mapLayers())
    feedback, context = Heard(), QgsProcessingContext()
    context.setProject(QgsProject.instance())
    context.setFeedback(feedback)
    try:
        results = processing.runAndLoadResults(algorithm, parameters, feedback=feedback, context=context)
    except QgsProcessingException as error:
        return {"failed": str(error), "said": feedback.said}
    layers = [layer for key, layer in QgsProject.instance().mapLayers().items() if key not in before]
    return {"results": results, "said": feedback.said, "layers": {layer.name(): describe(layer) for layer in layers}}


def cancel(algorithm, parameters, executable, seconds):
    """Run an algorithm with another executable, and cancel it after some time, as its dialog does: from outside."""
    os.environ["ROADGEO_EXECUTABLE"] = executable
    found = QgsApplication.processingRegistry().createAlgorithmById(algorithm)
    feedback, context = Heard(), QgsProcessingContext()
    timer = QTimer()
    timer.timeout.connect(feedback.cancel)
    timer.start(int(1000 * seconds))
    from qgis.core import QgsProcessingAlgRunnerTask

    ended = []
    task = QgsProcessingAlgRunnerTask(found, parameters, context, feedback)
    task.executed.connect(lambda successful, results: ended.append([successful, results]))
    QgsApplication.taskManager().addTask(task)
    while not ended:
        QgsApplication.processEvents()
    del os.environ["ROADGEO_EXECUTABLE"]
    return {"ended": ended[0], "said": feedback.said}


def configure(executable):
    """Set the executable's path in Processing's settings; return whether algorithms can run, and the advice."""
    from processing.core.ProcessingConfig import ProcessingConfig

    ProcessingConfig.settings["ROADGEO_EXECUTABLE"].value = executable
    return list(QgsApplication.processingRegistry().createAlgorithmById("roadgeo:locatemask").canExecute())


def forget_program():
    """Have the program searched for again."""
    from processing.core.ProcessingConfig import ProcessingConfig

    ProcessingConfig.setSettingValue("ROADGEO_EXECUTABLE", "")


def remembered():
    """List the references that the plugin remembers."""
    return __import__("roadgeo_qgis.settings", fromlist=["settings"]).remembered_references()


def describe(layer):
    """Say what a layer is and how it is drawn."""
    node = QgsProject.instance().layerTreeRoot().findLayer(layer.id())
    group = "" if node is None or node.parent() is None else node.parent().name()
    known = {"valid": layer.isValid(), "crs": layer.crs().authid(), "group": group}
    if isinstance(layer, QgsRasterLayer):
        return {**known, "bands": layer.bandCount(), "renderer": layer.renderer().type()}
    symbols = layer.renderer().symbols(qgis.core.QgsRenderContext())
    colors = [part.color().name() for symbol in symbols for part in symbol.symbolLayers()]
    return {**known, "features": layer.featureCount(), "renderer": layer.renderer().type(), "colors": colors}


def load(path, layer=""):
    """Open a layer as by dragging its file into the window, and put it into the project under that name."""
    name = f"{Path(path).name} {layer}".strip()
    opened = QgsVectorLayer(f"{path}|layername={layer}", name, "ogr") if layer else QgsRasterLayer(path, name)
    QgsProject.instance().addMapLayer(opened)
    return describe(opened)


def render(layers, extent, size, path):
    """Draw layers of the project, by name, the first on top."""
    by_name = {layer.name(): layer for layer in QgsProject.instance().mapLayers().values()}
    settings = QgsMapSettings()
    settings.setLayers([by_name[name] for name in layers])
    settings.setDestinationCrs(by_name[layers[0]].crs())
    settings.setExtent(QgsRectangle(*extent))
    settings.setOutputSize(QSize(*size))
    settings.setBackgroundColor(QColor("white"))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    assert job.renderedImage().save(path)


def sample(path, points, bands):
    """Return a raster's values at points of its CRS, None where it has no data."""
    layer = QgsRasterLayer(path, "sampled")
    provider = layer.dataProvider()
    values = [[provider.sample(QgsPointXY(*point), band) for band in bands] for point in points]
    return [[value if known else None for value, known in row] for row in values]


def project(points, pixels):
    """Fit QGIS's projective transformation to a .points file and apply it to pixels (column, row)."""
    lines = Path(points).read_text("utf-8").splitlines()[2:]
    rows = [[float(value) for value in line.split(",")[:4]] for line in lines]
    sources, targets = [QgsPointXY(*row[2:]) for row in rows], [QgsPointXY(*row[:2]) for row in rows]
    method = QgsGcpTransformerInterface.TransformMethod.Projective
    transformer = QgsGcpTransformerInterface.createFromParameters(method, sources, targets)
    return [transformer.transform(column, -row)[1:] for column, row in pixels]


def main():
    """Do tasks as they come, lists of [function, arguments]; send what they return, and QGIS's warnings."""
    pipe = Connection(int(sys.argv[1]))
    application = start()
    warnings = []

    def hear(text, tag, level):
        if level in (WARNING, CRITICAL):
            warnings.append(f"{tag}: {text}")

    application.messageLog().messageReceived.connect(hear)
    pipe.send_bytes(b"ready")
    while True:
        try:
            wanted = json.loads(pipe.recv_bytes())
        except EOFError:
            os._exit(0)  # QGIS 3.22 may crash as it takes itself apart
        warnings.clear()
        try:
            reported = {"answers": [globals()[name](**arguments) for name, arguments in wanted], "warnings": warnings}
        except Exception:
            reported = {"error": traceback.format_exc()}
        QgsProject.instance().clear()
        sys.stderr.flush()
        pipe.send_bytes(json.dumps(reported).encode())


main()
