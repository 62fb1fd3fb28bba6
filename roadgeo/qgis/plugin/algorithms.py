"""The algorithms: parameters, one call of roadgeo, layers to load."""

from __future__ import annotations

import json
import os
import re
from html import unescape
from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputString,
    QgsProcessingOutputVectorLayer,
)
from qgis.PyQt.QtCore import QUrl
from qgis.PyQt.QtGui import QIcon
from qgis.utils import iface

from . import parameters as given
from .environment import ask_version, install
from .library import list_places, list_references
from .parameters import Option, Values
from .runner import find_program
from .session import PICTURE_KEPT, POINTS_KEPT, Finding, LayerGroup, Session
from .settings import (
    NOT_FOUND,
    configure,
    locate_executable,
    propose_executable,
    remember_reference,
    remembered_references,
)

__all__ = ["ALGORITHMS"]

#: Name of the layer of residuals, whose arrows are drawn longer than they are.
_RESIDUALS = "residuals × 20"

#: The help page: title and text of each algorithm, by its name. QGIS makes a paragraph of every line.
_PAGE = Path(__file__).parent / "help.html"
_SECTION = r'<h2 id="(\w+)">(.*?)</h2>\s*(.*?)\s*(?=<h2|</body)'
_HELP: dict[str, tuple[str, str]] = {
    name: (unescape(title), text.replace("\n", " "))
    for name, title, text in re.findall(_SECTION, _PAGE.read_text("utf-8"), re.DOTALL)
}


class RoadgeoAlgorithm(QgsProcessingAlgorithm):
    """The base of the algorithms: each has a name, a section of the help page, options, outputs and its `work`."""

    session: Session
    NAME: ClassVar[str]
    TAGS: ClassVar[str]
    OPTIONS: ClassVar[tuple[Option, ...]]
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {}

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Call roadgeo and return the results."""
        raise NotImplementedError

    def arguments(self, values: Values) -> list[str]:
        """Return the options as arguments of the command line."""
        return [argument for option in self.OPTIONS for argument in option.arguments(values)]

    def name(self) -> str:
        """Name within the provider."""
        return self.NAME

    def displayName(self) -> str:
        """Name in the toolbox."""
        return _HELP[self.NAME][0]

    def shortDescription(self) -> str:
        """First sentence of the help."""
        return unescape(re.sub(r"<[^>]+>", "", _HELP[self.NAME][1])).split(". ")[0] + "."

    def shortHelpString(self) -> str:
        """Text beside the parameters: the help, then every parameter with its hint."""
        hints = (f"<p><b>{option.label}</b><br>{option.hint}</p>" for option in self.OPTIONS)
        return _HELP[self.NAME][1] + "".join(hints)

    def helpUrl(self) -> str:
        """Page behind the button Help: it ships with the plugin, and needs no network."""
        page = QUrl.fromLocalFile(str(_PAGE))
        page.setFragment(self.NAME)
        return str(page.toString())

    def tags(self) -> list[str]:
        """Other words to find it by."""
        return self.TAGS.split()

    def icon(self) -> Any:
        """Show the provider's own."""
        return QIcon(str(Path(__file__).parent / "icon.png"))

    def createInstance(self) -> RoadgeoAlgorithm:
        """Make another one, for each run."""
        return type(self)()

    def canExecute(self) -> tuple[bool, str]:
        """Whether roadgeo is there; if not, the remedy."""
        is_installed = locate_executable() is not None
        return is_installed, "" if is_installed else NOT_FOUND

    def initAlgorithm(self, configuration: Any = None) -> None:  # noqa: ARG002 (QGIS's signature)
        """Declare parameters and outputs."""
        for option in self.OPTIONS:
            self.addParameter(option.define())
        for name, (kind, label) in self.OUTPUTS.items():
            self.addOutput(kind(name, label))

    def processAlgorithm(self, parameters: dict[str, Any], context: Any, feedback: Any) -> dict[str, Any]:
        """Run."""
        # Of parameters that write the same option the first lends its label.
        labels = {option.flag: option.label for option in reversed(self.OPTIONS)}
        self.session = Session(context, feedback, labels)
        return self.work(Values(self, parameters, context, feedback), self.session)

    def postProcessAlgorithm(self, context: Any, feedback: Any) -> dict[str, Any]:  # noqa: ARG002 (QGIS's signature)
        """Report the result, and open the pages that were asked for; QGIS calls this in the thread of its window."""
        self.session.open_pages()
        if iface is not None and self.session.finding is not None:
            from .messages import announce

            announce(self.name(), self.session.finding)
        return {}


class BuildReference(RoadgeoAlgorithm):
    """Roads in, a reference out."""

    NAME = "buildreference"
    TAGS = "index roads osm openstreetmap map database"
    OPTIONS = given.ROADS

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Build it; load its roads and intersections."""
        lines, place, box = (values.given(source) for source in ("ROADS", "PLACE", "EXTENT"))
        if lines + place + (box and not lines) != 1:
            raise QgsProcessingException("Give one source of roads: road lines, a place, or an extent")
        path, name = values.path("FileOutput", "OUTPUT"), values.get("String", "NAME")
        if path:
            name = name or ("" if place else Path(path).stem)
        else:
            name = name or values.get("String", "PLACE") or values.layer_name("ROADS")
            if not name:
                raise QgsProcessingException("Give the reference a name")
        to = ([f"--out={path}", "--replace"] if path else []) + ([f"--name={name}"] if name else [])
        session.call("index", *to, *self.arguments(values))
        if session.feedback.isCanceled():
            return {}
        if path:
            remember_reference(path)
        else:
            path = max((one.file for one in list_references(fresh=True) if one.file), key=os.path.getmtime)
        for layer in ("coverage", "roads", "intersections"):
            session.show(Path(path), f"{Path(path).stem} {layer}", layer)
        return {"OUTPUT": path}


def _references(values: Values) -> list[str]:
    """Name the reference that was chosen; where none was, all that QGIS knows of."""
    if values.given("REFERENCE"):
        return [f"--reference={values.reference()}"]
    shelved = list_references() if remembered_references() else []  # by itself the program searches its whole library
    return [f"--reference={reference.value}" for reference in shelved]


_LOCATION_OUTPUTS = {
    "STATUS": (QgsProcessingOutputString, "located, ambiguous or not_located"),
    "REASON": (QgsProcessingOutputString, "Reason"),
    "LONGITUDE": (QgsProcessingOutputNumber, "Longitude of the middle"),
    "LATITUDE": (QgsProcessingOutputNumber, "Latitude of the middle"),
    "GSD": (QgsProcessingOutputNumber, "Pixel size, metres"),
    "ROTATION": (QgsProcessingOutputNumber, "Heading of the top, degrees clockwise from north"),
    "LOG10_ODDS": (QgsProcessingOutputNumber, "Score, powers of ten"),
    "FOOTPRINT": (QgsProcessingOutputRasterLayer, "On the map"),
    "LOCATION": (QgsProcessingOutputVectorLayer, "Footprint, matched intersections, roads"),
    "REPORT_PAGE": (QgsProcessingOutputFile, "Report"),
}


class LocateMask(RoadgeoAlgorithm):
    """One mask."""

    NAME = "locatemask"
    TAGS = "georeference geolocate footprint position match roads photo"
    OPTIONS = (given.QUERY, *given.SEARCH, given.OUTPUT_FOLDER)
    OUTPUTS = _LOCATION_OUTPUTS

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate it; load mask, footprint, roads and matches."""
        mask = values.raster("MASK")
        return _locate(mask, mask, self.arguments(values), values, session)


class GeoreferenceImage(RoadgeoAlgorithm):
    """The picture itself."""

    NAME = "georeferenceimage"
    TAGS = "warp photo orthorectify gcp control points"
    OPTIONS = (given.IMAGE, given.ITS_MASK, *given.SEARCH, *given.DRAWING, given.PRODUCTS, given.OUTPUT_FOLDER)
    OUTPUTS = _LOCATION_OUTPUTS

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate the mask and warp the image; load both results."""
        image, has_mask = values.raster("IMAGE"), values.given("MASK")
        drawn = [f"--image={image}"] if has_mask else []
        mask = values.raster("MASK") if has_mask else image
        return _locate(mask, image, [*drawn, *self.arguments(values)], values, session)


class LocateMasks(RoadgeoAlgorithm):
    """A folder of masks."""

    NAME = "locatemasks"
    TAGS = "georeference geolocate footprints many folder"
    OPTIONS = given.BATCH
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {
        "LOCATED": (QgsProcessingOutputNumber, "Located"),
        "NOT_LOCATED": (QgsProcessingOutputNumber, "Not located, or ambiguous"),
        "FAILED": (QgsProcessingOutputNumber, "Failed"),
        "SUMMARY": (QgsProcessingOutputVectorLayer, "All footprints"),
    }

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate them; load the footprints."""
        masks, folder = values.path("String", "MASKS"), values.path("String", "OUTPUT_FOLDER")
        to = ["--json", f"--out-dir={folder}", *_references(values)]
        result = session.call("locate", masks, *to, *self.arguments(values), some_may_fail=True)
        statuses = [location["status"] for location in result]
        located, failed = statuses.count("located"), statuses.count("error")
        results = {"OUTPUT_FOLDER": folder, "LOCATED": located, "FAILED": failed}
        results["NOT_LOCATED"] = len(statuses) - located - failed
        summary = Path(folder) / "roadgeo_summary.gpkg"
        if located and summary.exists():
            results["SUMMARY"] = session.show(summary, "Footprints", "footprints")
        return results


class VectorizeMask(RoadgeoAlgorithm):
    """Roads as the program sees them."""

    NAME = "vectorizemask"
    TAGS = "skeleton centre lines trace roads intersections"
    OPTIONS = given.VECTORIZE
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {"VECTORIZED": (QgsProcessingOutputVectorLayer, "Roads as seen")}

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Vectorize it; load roads and intersections."""
        mask, folder = values.raster("MASK"), values.path("String", "OUTPUT_FOLDER")
        session.call("vectorize", mask, f"--out-dir={folder}", *self.arguments(values))
        path = Path(folder) / f"{Path(mask).stem}_vectorized.gpkg"
        group = LayerGroup(Path(mask).stem)
        roads = session.show(path, "Roads as seen", "roads", group)
        session.show(path, "Intersections as seen", "intersections", group)
        return {"OUTPUT_FOLDER": folder, "VECTORIZED": roads}


class MapLocalizability(RoadgeoAlgorithm):
    """Where it would work."""

    NAME = "maplocalizability"
    TAGS = "localizability promise evaluate simulate plan flight where"
    OPTIONS = given.LOCALIZABILITY
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {"MAP": (QgsProcessingOutputRasterLayer, "Where it would work")}

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Try masks all over the map; load what that shows."""
        reference, folder = values.reference(), values.path("String", "OUTPUT_FOLDER")
        session.call("evaluate", reference, "--map", "--json", f"--out-dir={folder}", *self.arguments(values))
        path = Path(folder) / f"{Path(reference).stem}_localizability.tif"
        return {"OUTPUT_FOLDER": folder, "MAP": session.show(path, f"{Path(reference).stem}: where it would work")}


def _locate(mask: str, picture: str, options: list[str], values: Values, session: Session) -> dict[str, Any]:
    """Locate a mask, load the result, and keep it for the message bar."""
    folder = Path(values.path("String", "OUTPUT_FOLDER"))
    to = ["--json", f"--out-dir={folder}", "--also=match-points", *_references(values)]
    results: dict[str, Any] = {"OUTPUT_FOLDER": str(folder)}
    locations = session.call("locate", mask, *to, *options)
    if not locations:
        return results
    location, name = locations[0], Path(mask).stem
    results |= {"STATUS": location["status"], "REASON": location["reason"]}
    page, points = folder / f"{name}_report.html", folder / f"{Path(picture).name}_matches.points"
    if values.get("Boolean", "REPORT") and page.exists():
        session.pages.append(page)
        results["REPORT_PAGE"] = str(page)
    points_there, page_there = (str(path) if path.exists() else "" for path in (points, page))
    session.finding = Finding(name, picture, points_there, page_there, location, values.parameters)
    if location["status"] not in ("located", "chosen"):
        for name_of_map in dict.fromkeys(place.map for place in list_places(location)):
            session.show_map(name_of_map)
        session.feedback.pushWarning(f"{name}: {location['reason']}")
        return results
    session.show_map(values.reference() or location["reference"])
    kept = {PICTURE_KEPT: picture, POINTS_KEPT: points_there}
    return {**results, **_show_location(location, folder / name, kept, session)}


def _show_location(location: dict[str, Any], stem: Path, kept: dict[str, str], session: Session) -> dict[str, Any]:
    """Return the outputs of a location, and load its layers."""
    name, package = stem.name, stem.with_name(f"{stem.name}_location.gpkg")
    group = LayerGroup(name)
    for title, layer in (("matches", "matches"), (_RESIDUALS, "residuals"), ("roads", "query_roads")):
        session.show(package, f"{name} {title}", layer, group)
    return {
        "LONGITUDE": location["center"]["lon"],
        "LATITUDE": location["center"]["lat"],
        "GSD": location["gsd_m"],
        "ROTATION": location["rotation_deg"],
        "LOG10_ODDS": location["log10_odds"],
        "LOCATION": session.show(package, f"{name} footprint", "footprint", group, kept),
        "FOOTPRINT": session.show(stem.with_name(f"{name}_footprint.tif"), name, group=group),
    }


class PlaceByPoints(RoadgeoAlgorithm):
    """A picture by control points that somebody set."""

    NAME = "placebypoints"
    TAGS = "georeference warp gcp homography projective refit"
    OPTIONS = given.POINTS
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {
        "FOOTPRINT": (QgsProcessingOutputRasterLayer, "On the map"),
        "RMS": (
            QgsProcessingOutputNumber,
            "Root mean square of the residuals, map units; 0 of four points, which fit any picture",
        ),
    }

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Fit the homography, and have the picture drawn by it."""
        from .placing import make_location

        picture, folder = values.raster("IMAGE"), values.path("String", "OUTPUT_FOLDER")
        location, rms = make_location(picture, values.get("File", "POINTS"))
        name = Path(picture).stem
        path = Path(folder) / f"{name}_placed.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(location), "utf-8")
        session.call("apply", str(path), picture, f"--out-dir={folder}", *self.arguments(values))
        drawn = session.show(Path(folder) / f"{name}_footprint.tif", f"{name} by points")
        return {"OUTPUT_FOLDER": folder, "FOOTPRINT": drawn, "RMS": rms}


class SetUp(RoadgeoAlgorithm):
    """The program itself."""

    NAME = "setup"
    TAGS = "install environment python pip first run"
    OPTIONS = given.SETUP
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {
        "FOUND": (QgsProcessingOutputString, "The program, or the Python that has it"),
        "VERSION": (QgsProcessingOutputString, "Its version"),
    }

    def canExecute(self) -> tuple[bool, str]:
        """Whatever is there."""
        return True, ""

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Find or install it, and call it."""
        named = values.get("File", "PROGRAM")
        program = find_program(named, os.environ) if named else ""
        if program is None:
            raise QgsProcessingException(f"{named} is not a program of this computer: give its full path")
        if values.get("Boolean", "INSTALL"):
            source, folder = values.get("String", "SOURCE"), values.path("File", "FOLDER")
            result = install(program, source, Path(folder), session)
        else:
            result = program or locate_executable() or ""
        if not result:
            advice = f"To install it, tick “{given.SETUP[1].label}”, or name it above"
            proposed = propose_executable()
            advice += f": there is {proposed}, if that is yours." if proposed else "."
            raise QgsProcessingException(f"The program roadgeo was not found on this computer. {advice}")
        self.program = {"FOUND": result, "VERSION": ask_version(result, session)}
        return self.program

    def postProcessAlgorithm(self, context: Any, feedback: Any) -> dict[str, Any]:
        """Remember it, where QGIS keeps its settings."""
        configure(self.program["FOUND"])
        if iface is not None:
            from .messages import announce_ready

            announce_ready(self.program["VERSION"])
        return super().postProcessAlgorithm(context, feedback)


ALGORITHMS = tuple(RoadgeoAlgorithm.__subclasses__())
