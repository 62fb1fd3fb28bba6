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

from .environment import ENVIRONMENT

__all__ = [
    "AREA", "BATCH", "CAMERA", "ITS_MASK", "LOCALIZABILITY", "MASK", "MASK_VALUES", "OUTPUT_FOLDER", "PICTURE",
    "PIXEL_SIZE", "POINTS", "QUERY", "REFERENCE", "REPORT", "ROADS", "SEGMENT", "SETUP", "Option", "Values",
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
    known = crs.authid() and not crs.authid().startswith("USER:")
    return str(crs.authid() if known else crs.toWkt())


@dataclass(frozen=True)
class Option:
    """A parameter.

    Attributes
    ----------
    kind : type
        Class of its definition, one of `QgsProcessingParameter...`.
    hint : str
        Its purpose.
    say : callable
        Its value as arguments of the command line; called only where it has one.
    settings : dict
        Further arguments of its definition.
    folded : bool
        Below "Advanced parameters".
    flag : str
        Its name on the command line, which messages may use.
    metadata : dict
        Metadata for QGIS's dialogs.
    """

    kind: Any
    name: str
    label: str
    hint: str
    say: Callable[[Values, str], list[str]] = lambda *_: []
    settings: dict[str, Any] = field(default_factory=dict)
    folded: bool = False
    flag: str = ""
    metadata: dict[str, Any] = field(default_factory=dict)

    def define(self) -> Any:
        """Make its definition, which QGIS then owns."""
        definition = self.kind(self.name, self.label, **self.settings)
        definition.setHelp(self.hint)
        definition.setMetadata(self.metadata)
        if self.folded:
            definition.setFlags(definition.flags() | QgsProcessingParameterDefinition.Flag.FlagAdvanced)
        return definition

    def arguments(self, values: Values) -> list[str]:
        """Return it as arguments of the command line."""
        return self.say(values, self.name) if values.given(self.name) else []


# --- ways to say a value ----------------------------------------------------------------------------------------------


def _said(flag: str, kind: str, form: str = "{}") -> Callable[[Values, str], list[str]]:
    return lambda values, name: [f"{flag}={form.format(values.get(kind, name))}"]


def _path(flag: str) -> Callable[[Values, str], list[str]]:
    return lambda values, name: [f"{flag}={values.path('File', name)}"]


def _switched(flag: str) -> Callable[[Values, str], list[str]]:
    return lambda values, name: [flag] if values.get("Boolean", name) else []


def _chosen(flag: str) -> Callable[[Values, str], list[str]]:
    return lambda values, name: [f"{flag}={word}" for word in values.get("EnumStrings", name)]


def _crs(values: Values, name: str) -> list[str]:
    return [f"--crs={name_crs(values.get('Crs', name))}"]


def _near(values: Values, name: str) -> list[str]:
    point = values.in_degrees("Point", name)
    return [f"--near={point.x():.9g},{point.y():.9g},{values.get('Double', 'NEAR_RADIUS'):.9g}"]


def _box(values: Values, name: str) -> list[str]:
    box = values.in_degrees("Extent", name)
    return [f"--bbox={box.xMinimum():.9g},{box.yMinimum():.9g},{box.xMaximum():.9g},{box.yMaximum():.9g}"]


def _area(values: Values, name: str) -> list[str]:
    if values.given("WITHIN"):
        raise QgsProcessingException("Say where it lies by name or by a part of the map, not by both")
    return [text.replace("--bbox", "--within") for text in _box(values, name)]


def _lines(values: Values, name: str) -> list[str]:
    path, layer, crs = values.lines(name)
    return [f"--roads={path}", *([f"--layer={layer}"] if layer else []), f"--crs={crs}"]


# --- parameters from the table of options -----------------------------------------------------------------------------

#: The command line's options, and the outputs of `--also` with their purpose: written when the plugin is installed or
#: packed, for QGIS's Python has no roadgeo.
_TABLE: dict[str, Any] = json.loads((Path(__file__).parent / "table.json").read_text("utf-8"))
_OUTPUTS: dict[str, str] = _TABLE["outputs"]
_HINTS = _TABLE["options"]["locate"].items()


def _option(command: str, flag: str, label: str = "", name: str = "", hint: str = "", **settings: Any) -> Option:
    """Make a parameter of an option of the table; what is given replaces the table's. A default is not said."""
    row = _TABLE["options"][command][flag]
    kind, say, form = _form(flag, row["schema"])
    given = {"defaultValue": row["default"]} if row["default"] != "" else {}
    settings = {**form, **given, **settings}

    def arguments(values: Values, name: str) -> list[str]:
        said = say(values, name)
        return [] if said == [f"{flag}={row['default']}"] else said

    return Option(
        kind,
        name or flag[2:].replace("-", "_").upper(),
        label or row["label"],
        hint or row["help"],
        arguments,
        {"optional": "defaultValue" not in settings or kind is QgsProcessingParameterString, **settings},
        flag=flag,
    )


def _form(flag: str, schema: Mapping[str, Any]) -> tuple[Any, Callable[[Values, str], list[str]], dict[str, Any]]:
    """Return class, way to say a value, and settings of the parameter whose values a JSON Schema describes."""
    kind = schema.get("type", "string")
    if kind == "boolean":
        return QgsProcessingParameterBoolean, _switched(flag), {"defaultValue": False}
    if "enum" in schema:
        return QgsProcessingParameterEnum, _chosen(flag), {"options": schema["enum"], "usesStaticStrings": True}
    if kind in ("number", "integer"):
        limits = {"minValue": schema.get("minimum", schema.get("exclusiveMinimum")), "maxValue": schema.get("maximum")}
        form = {name: limit for name, limit in limits.items() if limit is not None}
        if kind == "integer":
            whole = QgsProcessingParameterNumber.Type.Integer
            return QgsProcessingParameterNumber, _said(flag, "Int"), {"type": whole, **form}
        real = QgsProcessingParameterNumber.Type.Double
        return QgsProcessingParameterNumber, _said(flag, "Double", "{:.12g}"), {"type": real, **form}
    return QgsProcessingParameterString, _said(flag, "String"), {}


def _raster(name: str, label: str, hint: str) -> Option:
    return Option(QgsProcessingParameterRasterLayer, name, label, hint)


def _folder(name: str, label: str, hint: str, **settings: Any) -> Option:
    behavior = QgsProcessingParameterFile.Behavior.Folder
    return Option(QgsProcessingParameterFile, name, label, hint, settings={"behavior": behavior, **settings})


def _fold(*options: Option) -> tuple[Option, ...]:
    return tuple(replace(option, folded=True) for option in options)


# --- the parameters ---------------------------------------------------------------------------------------------------

#: Nothing need be given.
_MAY_LACK = {"optional": True}

MASK = _raster(
    "MASK", "Road mask",
    "An image of the roads that the aerial picture shows: bright, or 1, where there is road. It needs no georeference.",
)  # fmt: skip
QUERY = replace(
    MASK, label="Road mask, or photograph",
    hint=f"{MASK.hint} A photograph is recognised, and a network finds its roads.",
)  # fmt: skip
ITS_MASK = replace(MASK, hint=f"{MASK.hint} Empty: a network finds the roads of the image.", settings=_MAY_LACK)
_BAND = _option("locate", "--band", "Band")
_THRESHOLD = _option("locate", "--threshold", "Threshold")
MASK_VALUES = _fold(
    replace(_BAND, kind=QgsProcessingParameterBand, settings={"parentLayerParameterName": "MASK", **_MAY_LACK}),
    _THRESHOLD,
)
SEGMENT = _fold(
    _option("locate", "--segment", "Find roads in photographs"),
    Option(
        QgsProcessingParameterFile, "SEGMENTER", "Model for photographs",
        "A segmentation model, as QGIS's Deepness takes them. Empty: the one that ships with roadgeo.",
        _path("--segmenter"), {"extension": "onnx", **_MAY_LACK}, flag="--segmenter",
    ),
)  # fmt: skip
REPORT = _option(
    "locate", "--report", "Open a report", hint="A page with map, mask, residuals and numbers, in the browser."
)
REFERENCE = Option(
    QgsProcessingParameterString, "REFERENCE", "Road reference",
    "What Build road reference made: one of the list, or a file. Empty: all that there are.",
    settings=_MAY_LACK, flag="--reference",
    metadata={"widget_wrapper": {"class": f"{__package__}.references.ReferenceWrapper"}},
)  # fmt: skip

PIXEL_SIZE = _fold(_option("locate", "--gsd"))

#: All hints on an image, in the order of the table; a place is clicked on the map.
CAMERA = _fold(
    Option(
        QgsProcessingParameterPoint, "NEAR", "Near",
        "The middle of the mask lies near this place.", _near, _MAY_LACK, flag="--near",
    ),
    Option(
        QgsProcessingParameterNumber, "NEAR_RADIUS", "Within, metres", "How near.",
        settings={"type": QgsProcessingParameterNumber.Type.Double, "defaultValue": 10_000.0, "minValue": 1.0},
    ),
    *(_option("locate", flag) for flag, row in _HINTS if row["is_hint"] and flag != "--near"),
)  # fmt: skip
AREA = Option(
    QgsProcessingParameterExtent, "AREA", "It lies on this part of the map",
    "The middle of the image lies there: with the map canvas extent, near what you see. Empty: not known.",
    _area, _MAY_LACK, flag="--within",
)  # fmt: skip

PICTURE = (
    _raster(
        "IMAGE", "Image",
        "The picture that the mask shows the roads of, of the same frame. Its size may differ from the mask's.",
    ),
    Option(
        QgsProcessingParameterCrs, "CRS", "CRS of the result",
        "Empty: the reference's own, which is metric.", _crs, _MAY_LACK, flag="--crs",
    ),
    *_fold(
        _option("locate", "--resolution", "Pixel size of the result"),
        _option("locate", "--resampling", "Resampling"),
        Option(
            QgsProcessingParameterEnum, "PRODUCTS", "Also write",
            f"Further forms of the result. {'; '.join(f'{name}: {what}' for name, what in _OUTPUTS.items())}.",
            _chosen("--also"),
            {"options": list(_OUTPUTS), "usesStaticStrings": True, "allowMultiple": True, **_MAY_LACK}, flag="--also",
        ),
    ),
)  # fmt: skip

BATCH = (
    _folder("MASKS", "Folder of road masks or photographs", "Every image in it is located."),
    REFERENCE,
    AREA,
    _option("locate", "--jobs", "Processes"),
    *_fold(_option("locate", "--skip-existing", "Keep earlier results"), _BAND, _THRESHOLD),
)

ROADS = (
    Option(
        QgsProcessingParameterFeatureSource, "ROADS", "Road lines",
        "A layer of roads. Or leave it empty, and name a place or an extent: its roads come from OpenStreetMap.",
        _lines, {"types": [QgsProcessing.SourceType.TypeVectorLine], **_MAY_LACK}, flag="--roads",
    ),
    _option("index", "--osm", "Place", "PLACE", "The name of a place in OpenStreetMap, such as Boston, MA."),
    Option(
        QgsProcessingParameterExtent, "EXTENT", "Extent",
        "Roads in it come from OpenStreetMap; or the road lines are cut to it.", _box, _MAY_LACK, flag="--bbox",
    ),
    _option(
        "index", "--name", "Name",
        hint="Of the reference, in the list. Empty: after the place, the file or the layer.",
    ),
    _option(
        "index", "--kinds", "Which roads",
        hint="Those that the masks show, where the data tell kinds apart: main roads, public ones for cars (drivable), "
        "all for vehicles, or all.",
    ),
    *_fold(
        _option("index", "--tunnels", "Tunnels too"),
        _option("index", "--attribution", "Attribution", hint="Whom to name beside the map; goes with road lines."),
    ),
    Option(
        QgsProcessingParameterFileDestination, "OUTPUT", "Keep it in a file of its own",
        "A GeoPackage; its search index, of the same name, lies beside it. Empty: it is kept in roadgeo's library.",
        settings={"fileFilter": "GeoPackage (*.gpkg)", "createByDefault": False, **_MAY_LACK}, flag="--out",
    ),
)  # fmt: skip

OUTPUT_FOLDER = Option(
    QgsProcessingParameterFolderDestination, "OUTPUT_FOLDER", "Folder for the results", "Made if it is missing."
)

LOCALIZABILITY = (
    replace(REFERENCE, hint="What Build road reference made: one of the list, or a file.", settings={}),
    _option(
        "evaluate", "--height", "Height above ground, metres",
        hint="Of the flight. With the focal length it says how large a pixel is.", defaultValue=400.0,
    ),
    _option("evaluate", "--focal", "Focal length, pixels", hint="Of the camera.", defaultValue=1000.0),
    _option("evaluate", "--size", "Side of the image, pixels", hint="Of a square one.", defaultValue=1000),
    _option(
        "evaluate", "--noise", "How good the masks are",
        hint="Clean, as a network makes them (segmented), or poor.", defaultValue="segmented",
    ),
    *_fold(
        _option(
            "evaluate", "--count", "Masks to try",
            hint="More of them tell neighbouring places apart more surely, and take longer.", defaultValue=600,
        ),
        _option("locate", "--jobs", "Processes"),
    ),
    OUTPUT_FOLDER,
)  # fmt: skip

POINTS = (
    _raster("IMAGE", "Picture", "Any, of any number of bands."),
    Option(
        QgsProcessingParameterFile, "POINTS", "Control points",
        "Four or more, not on one line; a file of the Georeferencer, or of the panel to mend a place by hand.",
        settings={"extension": "points"},
    ),
    replace(PICTURE[1], hint="Empty: that of the points."),
    *PICTURE[2:4],
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
        "With that Python, in the folder below; takes some minutes, 1.3 GB, and the network.",
        settings={"defaultValue": False},
    ),
    *_fold(
        Option(
            QgsProcessingParameterString, "SOURCE", "What to install",
            "As pip takes it: roadgeo, or an address, a folder or a wheel that you have. [desktop] adds all "
            "that building references and photographs need.",
            settings={"defaultValue": "roadgeo[desktop]"},
        ),
        _folder(
            "FOLDER", "Folder of the environment", "Made if it is missing.",
            defaultValue=str(ENVIRONMENT), optional=True,
        ),
    ),
)  # fmt: skip
