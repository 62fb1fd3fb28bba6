"""Parameters of the algorithms, and their form on roadgeo's command line."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsProcessing,
    QgsProcessingException,
    QgsProcessingParameterBand,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterExtent,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterPoint,
    QgsProcessingParameterRasterLayer,
    QgsProcessingParameterString,
    QgsProviderRegistry,
)

from .environment import ENVIRONMENT, SOURCE

__all__ = [
    "BATCH", "DRAWING", "IMAGE", "ITS_MASK", "LOCALIZABILITY", "OUTPUT_FOLDER", "POINTS", "PRODUCTS", "QUERY", "ROADS",
    "SEARCH", "SETUP", "VECTORIZE", "Option", "Values",
]  # fmt: skip


class Values:
    """The values that the user set."""

    def __init__(self, algorithm: Any, parameters: dict[str, Any], context: Any, feedback: Any) -> None:
        self.algorithm, self.parameters, self.context, self.feedback = algorithm, parameters, context, feedback

    def given(self, name: str) -> bool:
        """Whether a parameter has a value, be it its default."""
        default = self.algorithm.parameterDefinition(name).defaultValue()
        return self.parameters.get(name, default) not in (None, "")

    def get(self, kind: str, name: str, *more: Any) -> Any:
        """Return a value as `QgsProcessingAlgorithm.parameterAs<kind>` reads it."""
        return getattr(self.algorithm, f"parameterAs{kind}")(self.parameters, name, self.context, *more)

    def path(self, kind: str, name: str) -> str:
        """Return a path in full, for the program runs in another folder; "" where none is given."""
        text = self.get(kind, name)
        return str(Path(text).absolute()) if text else ""

    def reference(self) -> str:
        """Return the name of the reference in roadgeo's library, or its file in full; "" where none is given."""
        text = str(self.get("String", "REFERENCE"))
        return str(Path(text).absolute()) if Path(text).suffix and Path(text).exists() else text

    def in_degrees(self, kind: str, name: str) -> Any:
        """Return a point or an extent as longitudes and latitudes."""
        return self.get(kind, name, QgsCoordinateReferenceSystem("EPSG:4326"))

    def raster(self, name: str) -> str:
        """Return the file of a raster layer.

        Raises
        ------
        QgsProcessingException
            It cannot be opened, or is not a file.
        """
        layer = self.get("RasterLayer", name)
        if layer is None:
            raise QgsProcessingException(self.algorithm.invalidRasterError(self.parameters, name))
        path = QgsProviderRegistry.instance().decodeUri(layer.providerType(), layer.source()).get("path", "")
        if not Path(path).is_file():
            raise QgsProcessingException(f"{layer.name()} is not a file on this computer; save it as GeoTIFF first")
        return str(Path(path).absolute())

    def lines(self, name: str) -> tuple[str, str, str]:
        """Return file, layer and CRS of a layer of lines; one that roadgeo cannot read is saved as a file."""
        formats = ["gpkg", "shp", "geojson", "json", "fgb"]
        path, layer = self.get("CompatibleSourceLayerPathAndLayerName", name, formats, formats[0], self.feedback)
        return str(Path(path).absolute()), layer, name_crs(self.get("Source", name).sourceCrs())

    def layer_name(self, name: str) -> str:
        """Return the name of a layer of lines; "" where none is given."""
        source = self.get("Source", name) if self.given(name) else None
        return "" if source is None else str(source.sourceName())


def name_crs(crs: Any) -> str:
    """Name a CRS so that others know it: those that users define are known to QGIS only."""
    has_name = crs.authid() and not crs.authid().startswith("USER:")
    return str(crs.authid() if has_name else crs.toWkt())


@dataclass(frozen=True)
class Option:
    """A parameter.

    Attributes
    ----------
    kind : type
        Class of its definition, one of `QgsProcessingParameter...`.
    hint : str
        Its purpose.
    flag : str
        Its name on the command line, which messages may use; "" where it has none.
    settings : dict
        Further arguments of its definition.
    write : callable
        Its value as arguments of the command line, where that is more than the flag with the value.
    default : str
        The program's own, which is left out.
    folded : bool
        Below "Advanced parameters".
    metadata : dict
        Metadata for QGIS's dialogs.
    """

    kind: Any
    name: str
    label: str
    hint: str
    flag: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    write: Callable[[Values, str], list[str]] | None = None
    default: str = ""
    folded: bool = False
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def define(self) -> Any:
        """Make its definition, which QGIS then owns."""
        definition = self.kind(self.name, self.label, **self.settings)
        definition.setHelp(self.hint)
        definition.setMetadata(dict(self.metadata))
        if self.folded:
            definition.setFlags(definition.flags() | QgsProcessingParameterDefinition.Flag.FlagAdvanced)
        return definition

    def arguments(self, values: Values) -> list[str]:
        """Return it as arguments of the command line."""
        if not self.flag or not values.given(self.name):
            return []
        if self.write is not None:
            return self.write(values, self.name)
        if self.kind is QgsProcessingParameterBoolean:
            return [self.flag] if values.get("Boolean", self.name) else []
        return [f"{self.flag}={text}" for text in _READ[self.kind](values, self.name) if text != self.default]


#: A value as text, or several, by the class of the parameter.
_READ: dict[Any, Callable[[Values, str], list[str]]] = {
    QgsProcessingParameterBand: lambda values, name: [str(values.get("Int", name))],
    QgsProcessingParameterCrs: lambda values, name: [name_crs(values.get("Crs", name))],
    QgsProcessingParameterEnum: lambda values, name: values.get("EnumStrings", name),
    QgsProcessingParameterFile: lambda values, name: [values.path("File", name)],
    QgsProcessingParameterNumber: lambda values, name: [f"{values.get('Double', name):.12g}"],
    QgsProcessingParameterString: lambda values, name: [str(values.get("String", name))],
}


def _write_near(values: Values, name: str) -> list[str]:
    point = values.in_degrees("Point", name)
    return [f"--near={point.x():.9g},{point.y():.9g},{values.get('Double', 'NEAR_RADIUS'):.9g}"]


def _write_stated(values: Values, name: str) -> list[str]:
    if not values.get("Boolean", name):
        return []
    if values.given("NEAR"):
        raise QgsProcessingException("Give a place, or tick that the camera says it, not both")
    return ["--near=exif"]


def _write_box(values: Values, name: str) -> list[str]:
    box = values.in_degrees("Extent", name)
    return [f"--bbox={box.xMinimum():.9g},{box.yMinimum():.9g},{box.xMaximum():.9g},{box.yMaximum():.9g}"]


def _write_area(values: Values, name: str) -> list[str]:
    if values.given("WITHIN"):
        raise QgsProcessingException("Name the country or state, or give a part of the map, not both")
    return [text.replace("--bbox", "--within") for text in _write_box(values, name)]


def _write_lines(values: Values, name: str) -> list[str]:
    path, layer, crs = values.lines(name)
    return [f"--roads={path}", *([f"--layer={layer}"] if layer else []), f"--crs={crs}"]


# --- parameters from the table of options -----------------------------------------------------------------------------

#: The command line's options, and the outputs of `--also` with their purpose: written when the plugin is installed or
#: packed, for QGIS's Python has no roadgeo.
_TABLE: dict[str, Any] = json.loads((Path(__file__).parent / "table.json").read_text("utf-8"))
_OUTPUTS, _LOCATE = _TABLE["outputs"], _TABLE["options"]["locate"]


def _option(command: str, flag: str, label: str = "", hint: str = "", name: str = "", **settings: Any) -> Option:
    """Make a parameter of an option of the table; a given label, hint or setting replaces the table's."""
    row, words = _TABLE["options"][command][flag], flag[2:].replace("-", " ")
    kind, form = _form(row["schema"])
    if row["default"] != "":
        form["defaultValue"] = row["default"]
    form.update(settings)
    form.setdefault("optional", "defaultValue" not in form or kind is QgsProcessingParameterString)
    name, label = name or words.replace(" ", "_").upper(), label or row["label"] or words.capitalize()
    return Option(kind, name, label, hint or row["help"], flag, form, default=str(row["default"]))


def _form(schema: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return class and settings of the parameter whose values a JSON Schema describes."""
    kind = schema.get("type", "string")
    if kind == "boolean":
        return QgsProcessingParameterBoolean, {"defaultValue": False}
    if "enum" in schema:
        return QgsProcessingParameterEnum, {"options": schema["enum"], "usesStaticStrings": True}
    if kind in ("number", "integer"):
        limits = {"minValue": schema.get("minimum", schema.get("exclusiveMinimum")), "maxValue": schema.get("maximum")}
        whole, real = QgsProcessingParameterNumber.Type.Integer, QgsProcessingParameterNumber.Type.Double
        form = {name: limit for name, limit in limits.items() if limit is not None}
        return QgsProcessingParameterNumber, {"type": whole if kind == "integer" else real, **form}
    return QgsProcessingParameterString, {}


def _fold(*options: Option) -> tuple[Option, ...]:
    return tuple(replace(option, folded=True) for option in options)


# --- the parameters ---------------------------------------------------------------------------------------------------

#: Nothing need be given.
_MAY_LACK = {"optional": True}
_FOLDER = {"behavior": QgsProcessingParameterFile.Behavior.Folder}

_MASK = Option(
    QgsProcessingParameterRasterLayer, "MASK", "Road mask",
    "An image of the roads that the aerial picture shows: bright, or 1, where there is road. It needs no georeference.",
)  # fmt: skip
QUERY = replace(
    _MASK, label="Road mask, or photograph",
    hint=f"{_MASK.hint} A photograph is recognised, and a network finds its roads.",
)  # fmt: skip
ITS_MASK = replace(_MASK, hint=f"{_MASK.hint} Empty: a network finds the roads of the image.", settings=_MAY_LACK)
IMAGE = replace(
    _MASK, name="IMAGE", label="Image",
    hint="The picture that the mask shows the roads of, of the same frame. Its size may differ from the mask's.",
)  # fmt: skip
_REFERENCE = Option(
    QgsProcessingParameterString, "REFERENCE", "Road reference",
    "What Build road reference made: one of the list, or a file. Empty: all that there are.", settings=_MAY_LACK,
    metadata={"widget_wrapper": {"class": f"{__package__}.references.ReferenceWrapper"}},
)  # fmt: skip
_AREA = Option(
    QgsProcessingParameterExtent, "AREA", "It lies on this part of the map",
    "The middle of the image lies there: with the map canvas extent, near what you see. Empty: not known.",
    "--within", _MAY_LACK, _write_area,
)  # fmt: skip
_BAND, _THRESHOLD = _option("locate", "--band"), _option("locate", "--threshold")
_READING = (
    *_fold(
        replace(_BAND, kind=QgsProcessingParameterBand, settings={"parentLayerParameterName": "MASK", **_MAY_LACK}),
        _THRESHOLD,
        _option("locate", "--segment", "Find roads in photographs"),
        Option(
            QgsProcessingParameterFile, "SEGMENTER", "Model for photographs",
            "A segmentation model, as QGIS's Deepness takes them. Empty: the one that ships with roadgeo.",
            "--segmenter", {"extension": "onnx", **_MAY_LACK},
        ),
    ),
)  # fmt: skip
#: All hints on an image, in the order of the table; a place is clicked on the map.
_HINTS = _fold(
    Option(
        QgsProcessingParameterPoint, "NEAR", "Near", "The middle of the mask lies near this place.",
        "--near", _MAY_LACK, _write_near,
    ),
    Option(
        QgsProcessingParameterNumber, "NEAR_RADIUS", "Within, metres", "How near.",
        settings={"type": QgsProcessingParameterNumber.Type.Double, "defaultValue": 10_000.0, "minValue": 1.0},
    ),
    Option(
        QgsProcessingParameterBoolean, "NEAR_STATED", "Near where its camera says",
        "In EXIF and XMP, with the errors of such statements. Pixel size and heading may be exif, too.",
        "--near", {"defaultValue": False}, _write_stated,
    ),
    *(_option("locate", flag) for flag, row in _LOCATE.items() if row["is_hint"] and flag != "--near"),
)  # fmt: skip
_REPORT = _option(
    "locate", "--report", "Open a report", "A page with map, mask, residuals and numbers, in the browser."
)
_TAKE = _option(
    "locate", "--take", "Take the place of this number",
    "Where nothing is located: draw the picture at the place of that number of those that the refusal lists, as chosen "
    "by you.",
)  # fmt: skip
SEARCH = (_REFERENCE, _AREA, _REPORT, *_READING, *_HINTS, *_fold(_TAKE))
OUTPUT_FOLDER = Option(
    QgsProcessingParameterFolderDestination, "OUTPUT_FOLDER", "Folder for the results", "Made if it is missing."
)
VECTORIZE = (QUERY, *_READING, *_fold(_option("locate", "--gsd")), OUTPUT_FOLDER)
BATCH = (
    Option(
        QgsProcessingParameterFile, "MASKS", "Folder of road masks or photographs", "Every image in it is located.",
        settings=_FOLDER,
    ),
    _REFERENCE,
    _AREA,
    _option("locate", "--jobs", "Processes"),
    *_fold(_option("locate", "--skip-existing", "Keep earlier results"), _BAND, _THRESHOLD),
    *_HINTS,
    OUTPUT_FOLDER,
)  # fmt: skip

DRAWING = (
    Option(
        QgsProcessingParameterCrs, "CRS", "CRS of the result", "Empty: the reference's own, which is metric.",
        "--crs", _MAY_LACK,
    ),
    *_fold(_option("locate", "--resolution", "Pixel size of the result"), _option("locate", "--resampling")),
)  # fmt: skip
PRODUCTS = Option(
    QgsProcessingParameterEnum, "PRODUCTS", "Also write",
    f"Further forms of the result. {'; '.join(f'{name}: {purpose}' for name, purpose in _OUTPUTS.items())}.", "--also",
    {"options": list(_OUTPUTS), "usesStaticStrings": True, "allowMultiple": True, **_MAY_LACK}, folded=True,
)  # fmt: skip
POINTS = (
    replace(IMAGE, label="Picture", hint="Any, of any number of bands."),
    Option(
        QgsProcessingParameterFile, "POINTS", "Control points",
        "Four or more, not on one line; a file of the Georeferencer, or of the panel to mend a place by hand.",
        settings={"extension": "points"},
    ),
    replace(DRAWING[0], hint="Empty: the CRS of the points."),
    *DRAWING[1:],
    OUTPUT_FOLDER,
)  # fmt: skip

ROADS = (
    Option(
        QgsProcessingParameterFeatureSource, "ROADS", "Road lines",
        "A layer of roads. Or leave it empty, and name a place or an extent: its roads come from OpenStreetMap.",
        "--roads", {"types": [QgsProcessing.SourceType.TypeVectorLine], **_MAY_LACK}, _write_lines,
    ),
    _option("index", "--osm", "Place", "The name of a place in OpenStreetMap, such as Boston, MA.", "PLACE"),
    Option(
        QgsProcessingParameterExtent, "EXTENT", "Extent",
        "Roads in it come from OpenStreetMap; or the road lines are cut to it.", "--bbox", _MAY_LACK, _write_box,
    ),
    _option("index", "--name", "", "Of the reference, in the list. Empty: after the place, the file or the layer."),
    _option("index", "--kinds", "Which roads"),
    _option("index", "--replace", "Replace a reference of that name"),
    *_fold(_option("index", "--tunnels"), _option("index", "--attribution", "", "Whom to name beside the map.")),
    Option(
        QgsProcessingParameterFileDestination, "OUTPUT", "Keep it in a file of its own",
        "A GeoPackage; its search index, of the same name, lies beside it. Empty: it is kept in roadgeo's library.",
        settings={"fileFilter": "GeoPackage (*.gpkg)", "createByDefault": False, **_MAY_LACK},
    ),
)  # fmt: skip

LOCALIZABILITY = (
    replace(_REFERENCE, hint="What Build road reference made: one of the list, or a file.", settings={}),
    _option(
        "evaluate", "--height", "Height above ground, metres",
        "Height of the flight. With the focal length it gives the pixel size.", defaultValue=400.0,
    ),
    _option("evaluate", "--focal", "Focal length, pixels", "Of the camera.", defaultValue=1000.0),
    _option("evaluate", "--size", "Side of the image, pixels", "Of a square one.", defaultValue=1000),
    _option(
        "evaluate", "--noise", "How good the masks are",
        "Clean, as a network makes them (segmented), or poor.", defaultValue="segmented",
    ),
    *_fold(
        _option(
            "evaluate", "--count", "Masks to try",
            "More of them distinguish neighbouring places more surely, and take longer.", defaultValue=600,
        ),
        _option("locate", "--jobs", "Processes"),
    ),
    OUTPUT_FOLDER,
)  # fmt: skip

SETUP = (
    Option(
        QgsProcessingParameterFile, "PROGRAM", "Program roadgeo, or a Python",
        "The program, or the Python that has it or that is to have it, 3.11 or newer. Empty: searched for.",
        settings={"fileFilter": "All files (*)", **_MAY_LACK},  # "*.*", the usual, refuses names without a dot
    ),
    Option(
        QgsProcessingParameterBoolean, "INSTALL", "Install roadgeo into an environment of its own",
        "With that Python, in the folder below; takes some minutes, 1.1 GB, and the network.",
        settings={"defaultValue": False},
    ),
    *_fold(
        Option(
            QgsProcessingParameterString, "SOURCE", "What to install",
            "As pip takes it: the wheel that came with the plugin, or another, a folder of sources or an address, in "
            "full.",
            settings={"defaultValue": SOURCE},
        ),
        Option(
            QgsProcessingParameterFile, "FOLDER", "Folder of the environment", "Made if it is missing.",
            settings={"defaultValue": str(ENVIRONMENT), **_FOLDER, **_MAY_LACK},
        ),
    ),
)  # fmt: skip
