"""The algorithms: parameters, one call of roadgeo, what is loaded."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputString,
    QgsProcessingOutputVectorLayer,
)
from qgis.PyQt.QtCore import QUrl
from qgis.PyQt.QtGui import QIcon

from .parameters import (
    BATCH,
    CAMERA,
    ITS_MASK,
    LOCALIZABILITY,
    MASK_VALUES,
    OUTPUT_FOLDER,
    PICTURE,
    PIXEL_SIZE,
    QUERY,
    REFERENCE,
    REPORT,
    ROADS,
    SEGMENT,
    Option,
    Values,
)
from .session import Session
from .settings import NOT_FOUND, locate_executable

__all__ = [
    "ALGORITHMS",
    "BuildReference",
    "GeoreferenceImage",
    "LocateMask",
    "LocateMasks",
    "MapLocalizability",
    "VectorizeMask",
]


class RoadgeoAlgorithm(QgsProcessingAlgorithm):
    """What the algorithms share: each has a name, a help text, options, outputs and its `work`."""

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
        """Return what the options say on the command line."""
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
        """Whether roadgeo is there, and what to do if not."""
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
        self.session = Session(context, feedback)
        return self.work(Values(self, parameters, context, feedback), self.session)

    def postProcessAlgorithm(self, context: Any, feedback: Any) -> dict[str, Any]:  # noqa: ARG002 (QGIS's signature)
        """Open the pages that were asked for; QGIS calls this in the thread of its window."""
        self.session.open_pages()
        return {}


class BuildReference(RoadgeoAlgorithm):
    """Roads in, a reference out."""

    NAME, TITLE = "buildreference", "Build road reference"
    TAGS = "index roads osm openstreetmap map database"
    HELP = (
        "Draws the roads of a place as a mask shows them, and indexes their intersections. Done once per place; "
        "the other algorithms then search it. Give one source: a layer of road lines, a place, or an extent. "
        "Roads of OpenStreetMap are © OpenStreetMap contributors, ODbL."
    )
    OPTIONS = ROADS
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {}

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Build it; load its roads and intersections."""
        path = values.get("FileOutput", "OUTPUT")
        name = [f"--name={Path(path).stem}"] if values.given("ROADS") and not values.given("NAME") else []
        session.call("index", f"--out={path}", *name, *self.arguments(values))
        for layer in ("coverage", "roads", "intersections"):
            session.show(Path(path), f"{Path(path).stem} {layer}", layer)
        return {"OUTPUT": path}


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
    OPTIONS = (QUERY, REFERENCE, REPORT, *MASK_VALUES, *SEGMENT, *CAMERA, OUTPUT_FOLDER)
    OUTPUTS = _LOCATION_OUTPUTS

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate it; load mask, footprint, roads and matches."""
        mask, folder = values.raster("MASK"), values.get("String", "OUTPUT_FOLDER")
        found = session.call("locate", mask, "--json", f"--out-dir={folder}", *self.arguments(values))
        shown = _show_location(found, Path(folder) / Path(mask).stem, session)
        return {"OUTPUT_FOLDER": folder, **shown, **_show_report(values, Path(folder) / Path(mask).stem, session)}


class GeoreferenceImage(RoadgeoAlgorithm):
    """The picture itself."""

    NAME, TITLE = "georeferenceimage", "Georeference image"
    TAGS = "warp photo orthorectify gcp control points"
    HELP = (
        "Finds where the road mask of an image lies on a road reference, and draws the image itself there: a Cloud "
        "Optimized GeoTIFF, transparent outside its footprint. Without a mask a network finds the roads of the image. "
        "The ground is taken for a plane. An image that is not surely found is refused, with the reason."
    )
    OPTIONS = (PICTURE[0], ITS_MASK, REFERENCE, REPORT, *PICTURE[1:], *MASK_VALUES, *SEGMENT, *CAMERA, OUTPUT_FOLDER)
    OUTPUTS = _LOCATION_OUTPUTS

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate the mask and warp the image; load both results."""
        image, folder = values.raster("IMAGE"), values.get("String", "OUTPUT_FOLDER")
        mask = values.raster("MASK") if values.given("MASK") else image
        to = ["--json", f"--out-dir={folder}", *([f"--image={image}"] if values.given("MASK") else [])]
        found = session.call("locate", mask, *to, *self.arguments(values))
        shown = _show_location(found, Path(folder) / Path(mask).stem, session)
        return {"OUTPUT_FOLDER": folder, **shown, **_show_report(values, Path(folder) / Path(mask).stem, session)}


class LocateMasks(RoadgeoAlgorithm):
    """A folder of masks."""

    NAME, TITLE = "locatemasks", "Locate masks (batch)"
    TAGS = "georeference geolocate footprints many folder"
    HELP = (
        "Locates every road mask in a folder, and gathers their footprints in one layer. "
        "A mask that cannot be read is reported; the others are finished."
    )
    OPTIONS = (*BATCH, *CAMERA, OUTPUT_FOLDER)
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {
        "LOCATED": (QgsProcessingOutputNumber, "Located"),
        "NOT_LOCATED": (QgsProcessingOutputNumber, "Not located, or ambiguous"),
        "FAILED": (QgsProcessingOutputNumber, "Failed"),
        "SUMMARY": (QgsProcessingOutputVectorLayer, "All footprints"),
    }

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Locate them; load the footprints."""
        masks, folder = values.get("String", "MASKS"), values.get("String", "OUTPUT_FOLDER")
        to = ["--json", f"--out-dir={folder}"]
        found = session.call("locate", masks, *to, *self.arguments(values), some_may_fail=True)
        results = {"OUTPUT_FOLDER": folder, **_count(found)}
        summary = Path(folder) / "roadgeo_summary.gpkg"
        if results["LOCATED"] and summary.exists():
            results["SUMMARY"] = session.show(summary, "Footprints", "footprints")
        return results


class VectorizeMask(RoadgeoAlgorithm):
    """What the program sees."""

    NAME, TITLE = "vectorizemask", "Vectorize mask or photograph"
    TAGS = "skeleton centre lines trace roads intersections"
    HELP = (
        "Shows what roads and intersections are seen in a road mask or a photograph: the first thing to look at when "
        "one was not located. The layers are in pixels and lie on the image where it has no georeference."
    )
    OPTIONS = (QUERY, *MASK_VALUES, *SEGMENT, *PIXEL_SIZE, OUTPUT_FOLDER)
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {"VECTORIZED": (QgsProcessingOutputVectorLayer, "Roads as seen")}

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Vectorize it; load roads and intersections."""
        mask, folder = values.raster("MASK"), values.get("String", "OUTPUT_FOLDER")
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
    OPTIONS = LOCALIZABILITY
    OUTPUTS: ClassVar[dict[str, tuple[Any, str]]] = {"MAP": (QgsProcessingOutputRasterLayer, "Where it would work")}

    def work(self, values: Values, session: Session) -> dict[str, Any]:
        """Try masks all over the map; load what that shows."""
        reference, folder = values.get("File", "REFERENCE"), values.get("String", "OUTPUT_FOLDER")
        session.call("evaluate", reference, "--map", "--json", f"--out-dir={folder}", *self.arguments(values))
        path = Path(folder) / f"{Path(reference).stem}_localizability.tif"
        return {"OUTPUT_FOLDER": folder, "MAP": session.show(path, f"{Path(reference).stem}: where it would work")}


def _show_report(values: Values, stem: Path, session: Session) -> dict[str, Any]:
    """Return the report that was asked for, to be opened in the browser."""
    page = stem.with_name(f"{stem.name}_report.html")
    if not values.get("Boolean", "REPORT") or not page.exists():
        return {}
    session.pages.append(page)
    return {"REPORT_PAGE": str(page)}


def _show_location(found: list[dict[str, Any]], stem: Path, session: Session) -> dict[str, Any]:
    """Return the outputs of a location, and load the layers of one that was found."""
    if not found:
        return {}
    location = found[0]
    results = {"STATUS": location["status"], "REASON": location["reason"]}
    if location["status"] != "located":
        session.feedback.pushWarning(f"{stem.name}: {location['reason']}")
        return results
    footprint, package = stem.with_name(f"{stem.name}_footprint.tif"), stem.with_name(f"{stem.name}_location.gpkg")
    name = stem.name
    session.show(package, f"{name} matches", "matches", name)
    session.show(package, f"{name} residuals", "residuals", name)
    session.show(package, f"{name} roads", "query_roads", name)
    return {
        **results,
        "LONGITUDE": location["center"]["lon"],
        "LATITUDE": location["center"]["lat"],
        "GSD": location["gsd_m"],
        "ROTATION": location["rotation_deg"],
        "LOG10_ODDS": location["log10_odds"],
        "LOCATION": session.show(package, f"{name} footprint", "footprint", name),
        "FOOTPRINT": session.show(footprint, name, group=name),
    }


def _count(found: list[dict[str, Any]]) -> dict[str, Any]:
    statuses = [location["status"] for location in found]
    located, failed = statuses.count("located"), statuses.count("error")
    return {"LOCATED": located, "NOT_LOCATED": len(statuses) - located - failed, "FAILED": failed}


ALGORITHMS = (BuildReference, LocateMask, LocateMasks, VectorizeMask, GeoreferenceImage, MapLocalizability)
