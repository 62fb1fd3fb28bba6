"""The algorithms: parameters, one call of roadgeo, layers to load."""

from __future__ import annotations

import json
import os
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
from .parameters import Option, Values
from .runner import find_program
from .session import PICTURE_KEPT, POINTS_KEPT, Finding, Session, library
from .settings import NOT_FOUND, configure, locate_executable, remember_reference, remembered_references

__all__ = ["ALGORITHMS"]


class RoadgeoAlgorithm(QgsProcessingAlgorithm):
    """The base of the algorithms: each has a name, a help text, options, outputs and its `work`."""

    session: Session
    NAME: ClassVar[str]
    TITLE: ClassVar[str]
    TAGS: ClassVar[str]
    HELP: ClassVar[str]
    OPTIONS: ClassVar[tuple[Option, ...]]
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]]

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
        return self.TITLE

    def shortDescription(self) -> str:
        """First sentence of the help."""
        return self.HELP.split(". ")[0] + "."

    def shortHelpString(self) -> str:
        """Text beside the parameters: the help, then every parameter with its hint."""
        hints = (f"<p><b>{option.label}</b><br>{option.hint}</p>" for option in self.OPTIONS)
        return f"<p>{self.HELP}</p>" + "".join(hints)

    def helpUrl(self) -> str:
        """Page behind the button Help: it ships with the plugin, and needs no network."""
        page = QUrl.fromLocalFile(str(Path(__file__).parent / "help.html"))
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
        found = locate_executable() is not None
        return found, "" if found else NOT_FOUND

    def initAlgorithm(self, configuration: Any = None) -> None:  # noqa: ARG002 (QGIS's signature)
        """Declare parameters and outputs."""
        for option in self.OPTIONS:
            self.addParameter(option.define())
        for name, (kind, label) in self.OUTPUTS.items():
            self.addOutput(kind(name, label))

    def processAlgorithm(self, parameters: dict[str, Any], context: Any, feedback: Any) -> dict[str, Any]:
        """Run."""
        self.session = Session(context, feedback, {option.flag: option.label for option in self.OPTIONS})
        return self.work(Values(self, parameters, context, feedback), self.session)

    def postProcessAlgorithm(self, context: Any, feedback: Any) -> dict[str, Any]:  # noqa: ARG002 (QGIS's signature)
        """Report the result, and open the pages that were asked for; QGIS calls this in the thread of its window."""
        self.session.open_pages()
        if iface is not None and self.session.finding is not None:
            from .messages import tell

            tell(self.name(), self.session.finding)
        return {}


class BuildReference(RoadgeoAlgorithm):
    """Roads in, a reference out."""

    NAME, TITLE = "buildreference", "Build road reference"
    TAGS = "index roads osm openstreetmap map database"
    HELP = (
        "Draws the roads of a place as a mask shows them, and indexes their intersections. Done once per place; "
        "the other algorithms then offer it in their lists. Give one source: a layer of road lines, a place, or an "
        "extent. "
        "Roads of OpenStreetMap are © OpenStreetMap contributors, ODbL."
    )
    OPTIONS = given.ROADS
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {}

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
            files = (file for one in library(fresh=True) for file in one.files if file.endswith(".gpkg"))
            path = max(files, key=os.path.getmtime)
        for layer in ("coverage", "roads", "intersections"):
            session.show(Path(path), f"{Path(path).stem} {layer}", layer)
        return {"OUTPUT": path}


def _references(values: Values) -> list[str]:
    """Name the reference that was chosen; where none was, all that QGIS knows of."""
    if values.given("REFERENCE"):
        return [f"--reference={values.reference()}"]
    beside = remembered_references()
    return [f"--reference={one}" for one in (*(one.name for one in library()), *beside)] if beside else []


_LOCATION_OUTPUTS = {
    "STATUS": (QgsProcessingOutputString, "located, ambiguous or not_located"),
    "REASON": (QgsProcessingOutputString, "Reason"),
    "LONGITUDE": (QgsProcessingOutputNumber, "Longitude of the middle"),
    "LATITUDE": (QgsProcessingOutputNumber, "Latitude of the middle"),
    "GSD": (QgsProcessingOutputNumber, "Pixel size, metres"),
    "ROTATION": (QgsProcessingOutputNumber, "Heading of the top, degrees clockwise from north"),
    "LOG10_ODDS": (QgsProcessingOutputNumber, "Odds against any other place, decimal logarithm"),
    "FOOTPRINT": (QgsProcessingOutputRasterLayer, "On the map"),
    "LOCATION": (QgsProcessingOutputVectorLayer, "Footprint, matched intersections, roads"),
    "REPORT_PAGE": (QgsProcessingOutputFile, "Report"),
}


class LocateMask(RoadgeoAlgorithm):
    """One mask."""

    NAME, TITLE = "locatemask", "Locate mask or photograph"
    TAGS = "georeference geolocate footprint position match roads photo"
    HELP = (
        "Finds where a road mask, or a photograph, lies on a road reference, with no position, heading, scale or "
        "camera known. In a photograph a network finds the roads first. What is located is drawn on the map, with its "
        "footprint, its roads and the intersections that matched. What is not surely found is refused, with the reason."
    )
    OPTIONS = (
        given.QUERY,
        given.REFERENCE,
        given.AREA,
        given.REPORT,
        *given.MASK_VALUES,
        *given.SEGMENT,
        *given.CAMERA,
        given.OUTPUT_FOLDER,
    )
    OUTPUTS = _LOCATION_OUTPUTS

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate it; load mask, footprint, roads and matches."""
        mask = values.raster("MASK")
        return _locate(mask, mask, self.arguments(values), values, session)


class GeoreferenceImage(RoadgeoAlgorithm):
    """The picture itself."""

    NAME, TITLE = "georeferenceimage", "Georeference image"
    TAGS = "warp photo orthorectify gcp control points"
    HELP = (
        "Finds where the road mask of an image lies on a road reference, and draws the image itself there: a Cloud "
        "Optimized GeoTIFF, transparent outside its footprint. Without a mask a network finds the roads of the image. "
        "The ground is taken for a plane. An image that is not surely found is refused, with the reason."
    )
    OPTIONS = (
        given.PICTURE[0],
        given.ITS_MASK,
        given.REFERENCE,
        given.AREA,
        given.REPORT,
        *given.PICTURE[1:],
        *given.MASK_VALUES,
        *given.SEGMENT,
        *given.CAMERA,
        given.OUTPUT_FOLDER,
    )
    OUTPUTS = _LOCATION_OUTPUTS

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate the mask and warp the image; load both results."""
        image = values.raster("IMAGE")
        mask = values.raster("MASK") if values.given("MASK") else image
        drawn = [f"--image={image}"] if values.given("MASK") else []
        return _locate(mask, image, [*drawn, *self.arguments(values)], values, session)


class LocateMasks(RoadgeoAlgorithm):
    """A folder of masks."""

    NAME, TITLE = "locatemasks", "Locate masks (batch)"
    TAGS = "georeference geolocate footprints many folder"
    HELP = (
        "Locates every road mask in a folder, and gathers their footprints in one layer. "
        "A mask that cannot be read is reported; the others are finished."
    )
    OPTIONS = (*given.BATCH, *given.CAMERA, given.OUTPUT_FOLDER)
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
        found = session.call("locate", masks, *to, *self.arguments(values), some_may_fail=True)
        results = {"OUTPUT_FOLDER": folder, **_count(found)}
        summary = Path(folder) / "roadgeo_summary.gpkg"
        if results["LOCATED"] and summary.exists():
            results["SUMMARY"] = session.show(summary, "Footprints", "footprints")
        return results


class VectorizeMask(RoadgeoAlgorithm):
    """Roads as the program sees them."""

    NAME, TITLE = "vectorizemask", "Vectorize mask or photograph"
    TAGS = "skeleton centre lines trace roads intersections"
    HELP = (
        "Shows what roads and intersections are seen in a road mask or a photograph: the first thing to look at when "
        "one was not located. The layers are in pixels and lie on the image where it has no georeference."
    )
    OPTIONS = (given.QUERY, *given.MASK_VALUES, *given.SEGMENT, *given.PIXEL_SIZE, given.OUTPUT_FOLDER)
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {"VECTORIZED": (QgsProcessingOutputVectorLayer, "Roads as seen")}

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Vectorize it; load roads and intersections."""
        mask, folder = values.raster("MASK"), values.path("String", "OUTPUT_FOLDER")
        session.call("vectorize", mask, f"--out-dir={folder}", *self.arguments(values))
        path = Path(folder) / f"{Path(mask).stem}_vectorized.gpkg"
        roads = session.show(path, "Roads as seen", "roads", Path(mask).stem)
        session.show(path, "Intersections as seen", "intersections", Path(mask).stem)
        return {"OUTPUT_FOLDER": folder, "VECTORIZED": roads}


class MapLocalizability(RoadgeoAlgorithm):
    """Where it would work."""

    NAME, TITLE = "maplocalizability", "Map where masks would be located"
    TAGS = "localizability promise evaluate simulate plan flight where"
    HELP = (
        "Says before a flight where it would be located: masks as the camera would see them are drawn from the "
        "reference's own roads, all over the map, and each is searched for. Takes some minutes."
    )
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
    folder = values.path("String", "OUTPUT_FOLDER")
    to = ["--json", f"--out-dir={folder}", "--also=match-points", *_references(values)]
    found = session.call("locate", mask, *to, *options)
    if not found:
        return {"OUTPUT_FOLDER": folder}
    location, stem = found[0], Path(folder) / Path(mask).stem
    page, points = stem.with_name(f"{stem.name}_report.html"), Path(folder) / f"{Path(picture).name}_matches.points"
    results = {"OUTPUT_FOLDER": folder, "STATUS": location["status"], "REASON": location["reason"]}
    if values.get("Boolean", "REPORT") and page.exists():
        session.pages.append(page)
        results["REPORT_PAGE"] = str(page)
    points_there, page_there = (str(path) if path.exists() else "" for path in (points, page))
    session.finding = Finding(stem.name, picture, points_there, page_there, location, values.parameters)
    if location["status"] != "located":
        session.feedback.pushWarning(f"{stem.name}: {location['reason']}")
        return results
    session.show_map(values.reference() or location["reference"])
    return {**results, **_show_location(location, stem, {PICTURE_KEPT: picture, POINTS_KEPT: points_there}, session)}


def _show_location(location: dict[str, Any], stem: Path, kept: dict[str, str], session: Session) -> dict[str, Any]:
    """Return the outputs of a location, and load its layers."""
    footprint, package = stem.with_name(f"{stem.name}_footprint.tif"), stem.with_name(f"{stem.name}_location.gpkg")
    name = stem.name
    session.show(package, f"{name} matches", "matches", name)
    session.show(package, f"{name} residuals", "residuals", name)
    session.show(package, f"{name} roads", "query_roads", name)
    return {
        "LONGITUDE": location["center"]["lon"],
        "LATITUDE": location["center"]["lat"],
        "GSD": location["gsd_m"],
        "ROTATION": location["rotation_deg"],
        "LOG10_ODDS": location["log10_odds"],
        "LOCATION": session.show(package, f"{name} footprint", "footprint", name, kept),
        "FOOTPRINT": session.show(footprint, name, group=name),
    }


def _count(found: list[dict[str, Any]]) -> dict[str, Any]:
    statuses = [location["status"] for location in found]
    located, failed = statuses.count("located"), statuses.count("error")
    return {"LOCATED": located, "NOT_LOCATED": len(statuses) - located - failed, "FAILED": failed}


class PlaceByPoints(RoadgeoAlgorithm):
    """A picture by control points that somebody set."""

    NAME, TITLE = "placebypoints", "Put picture on the map by control points"
    TAGS = "georeference warp gcp homography projective refit"
    HELP = (
        "Draws a picture where control points have it: by the homography with the least squared distances on the map, "
        "which is what a camera makes of level ground. The panel to mend a place by hand writes such points, and so "
        "does the Georeferencer."
    )
    OPTIONS = given.POINTS
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {
        "FOOTPRINT": (QgsProcessingOutputRasterLayer, "On the map"),
        "RMS": (QgsProcessingOutputNumber, "Root mean square of the residuals, map units"),
    }

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Fit the homography, and have the picture drawn by it."""
        from .placing import make_location

        picture, folder = values.raster("IMAGE"), values.path("String", "OUTPUT_FOLDER")
        location, rms = make_location(picture, values.get("File", "POINTS"))
        told = Path(folder) / f"{Path(picture).stem}_placed.json"
        told.parent.mkdir(parents=True, exist_ok=True)
        told.write_text(json.dumps(location), "utf-8")
        session.call("apply", str(told), picture, f"--out-dir={folder}", *self.arguments(values))
        name = Path(picture).stem
        drawn = session.show(Path(folder) / f"{name}_footprint.tif", f"{name} by points")
        return {"OUTPUT_FOLDER": folder, "FOOTPRINT": drawn, "RMS": rms}


class SetUp(RoadgeoAlgorithm):
    """The program itself."""

    NAME, TITLE = "setup", "Set up roadgeo"
    TAGS = "install environment python pip first run"
    HELP = (
        "Finds the program roadgeo, which does the work in a Python of its own, tries it, and remembers it. Or "
        "installs it, into an environment that is made for it: neither QGIS nor the system changes."
    )
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
            found = install(program, source, Path(folder), session)
        else:
            found = program or locate_executable() or ""
        if not found:
            told = f"To install it, tick “{given.SETUP[1].label}”, or name it above."
            raise QgsProcessingException(f"The program roadgeo was not found on this computer. {told}")
        self.found = {"FOUND": found, "VERSION": ask_version(found, session)}
        return self.found

    def postProcessAlgorithm(self, context: Any, feedback: Any) -> dict[str, Any]:
        """Remember it, where QGIS keeps its settings."""
        configure(self.found["FOUND"])
        if iface is not None:
            from .messages import tell_ready

            tell_ready(self.found["VERSION"])
        return super().postProcessAlgorithm(context, feedback)


ALGORITHMS = (
    BuildReference,
    LocateMask,
    LocateMasks,
    VectorizeMask,
    GeoreferenceImage,
    MapLocalizability,
    PlaceByPoints,
    SetUp,
)
