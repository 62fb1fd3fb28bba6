"""All outputs of a result: name, file name, writer, purpose.

One list determines the rest: the files of a run and the outdated files of an earlier one, which files of a folder are
results and not masks, the help texts, the choices in QGIS. To add an output, write a function that takes a path and a
`Subject`, and list it here. Other packages offer theirs as entry points (see `roadgeo.plugins`).

The modules that write are imported when something is written, so that `--help` need not load them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roadgeo.errors import PluginError

__all__ = [
    "ALSO",
    "ALWAYS",
    "LOCALIZABILITY",
    "REGISTRY",
    "VECTORIZED",
    "Output",
    "find_outputs",
    "is_result",
    "offered",
    "result_endings",
]

#: Endings of the names of further results, before their suffixes: of `vectorize` and `evaluate --map`.
VECTORIZED, LOCALIZABILITY = "_vectorized", "_localizability"


@dataclass(frozen=True)
class Output:
    """One file that a result becomes.

    Attributes
    ----------
    name : str
        Name on the command line; a plugin's is its entry point's.
    ending : str
        End of the file's name, after the result's stem; "{picture}" stands for the picture's own name instead.
    write : callable
        Writes the file.
    summary : str
        Its purpose.
    needs_place : bool
        Whether only a located mask has it.
    needs_camera : bool
        Whether only a mask has it that a camera above the ground may have taken.
    option : str
        Option that asks for it on the command line; "" where none is needed.
    """

    name: str
    ending: str
    write: Callable[[Path, Any], None]  # of a `Subject`, which knows the outputs
    summary: str
    needs_place: bool = True
    option: str = ""
    needs_camera: bool = False

    def suits(self, on_map: bool, has_camera: bool) -> bool:
        """Whether a result has it, that is drawn on the map or not, and whose camera is known or not."""
        return (on_map or not self.needs_place) and (has_camera or not self.needs_camera)

    def path(self, folder: Path, stem: str, picture: str = "") -> Path:
        """Name the file."""
        return folder / (self.ending.replace("{picture}", picture) if "{" in self.ending else stem + self.ending)


def _own(name: str, ending: str, writer: str, summary: str, **more: Any) -> Output:
    """Return an output of this package; `writer` is "module.function", imported when something is written."""
    module, _, function = writer.rpartition(".")

    def write(path: Path, subject: Any) -> None:
        getattr(importlib.import_module(f"roadgeo.outputs.{module}"), function)(path, subject)

    return Output(name, ending, write, summary, **more)


JSON = _own(
    "json", "_location.json", "location_files.write_json",
    "place, homography, score; also written, with a reason, where nothing was found", needs_place=False,
)  # fmt: skip
FOOTPRINT = _own(
    "footprint", "_footprint.tif", "footprint.write_footprint",
    "the mask, or its --image, on the map (Cloud Optimized GeoTIFF)",
)  # fmt: skip
STYLE = _own("style", "_footprint.qml", "footprint.write_style", "how QGIS draws a mask's footprint")
GEOPACKAGE = _own(
    "geopackage", "_location.gpkg", "location_layers.write_geopackage",
    "footprint, matched intersections, roads: opens styled in QGIS",
)  # fmt: skip
OVERLAY = _own(
    "overlay", "_overlay.png", "overlay.write_overlay", "the mask and its place, to look at", option="--plot"
)
REPORT = _own(
    "report", "_report.html", "report.page.write_report",
    "map, mask, residuals and numbers; also where nothing was found", needs_place=False, option="--report",
)  # fmt: skip
EXPLANATION = _own(
    "explanation", "_explain.json", "explanation_sheet.write_explanation", "the same for programs",
    needs_place=False, option="--explain",
)  # fmt: skip
EXPLANATION_PICTURE = _own(
    "explanation-picture", "_explain.png", "explanation_sheet.write_explanation_picture",
    "why it was found there, or nowhere", needs_place=False, option="--explain",
)  # fmt: skip

GCPS = _own(
    "gcps", "_gcps.tif", "control_points.write_gcps",
    "the picture's own pixels with 25 control points, GeoTIFF",
)  # fmt: skip
VRT = _own("vrt", "_gcps.vrt", "control_points.write_vrt", "the same as a GDAL virtual raster: no pixels are copied")
POINTS = _own("points", "{picture}.points", "control_points.write_points", "control points for the QGIS Georeferencer")
MATCHES = _own(
    "matches", "_matches.csv", "control_points.write_matches",
    "the matched intersections, in pixels and on the map, with residuals (CSV)",
)  # fmt: skip
MATCH_POINTS = _own(
    "match-points", "{picture}_matches.points", "control_points.write_match_points",
    "the matched intersections for the QGIS Georeferencer, with residuals",
)  # fmt: skip
ODM = _own("odm", "_gcp_list.txt", "control_points.write_odm", "control points for OpenDroneMap")
WORLD_FILE = _own("worldfile", "_footprint.tfw", "footprint.write_world_file", "world file of the drawn raster")
GEOJSON = _own("geojson", "_footprint.geojson", "outlines.write_geojson", "footprint as GeoJSON (RFC 7946)")
STAC = _own("stac", "_stac.json", "outlines.write_stac", "STAC Item of the drawn raster")
KMZ = _own("kmz", "_overlay.kmz", "kmz.write_kmz", "ground overlay for Google Earth")

#: Written for every located mask; of these only the JSON where there is no place.
ALWAYS = (JSON, FOOTPRINT, STYLE, GEOPACKAGE)
_FURTHER = (GCPS, VRT, POINTS, MATCHES, MATCH_POINTS, ODM, WORLD_FILE, GEOJSON, STAC, KMZ)
#: Written where `--also` asks for them, by the names under which pyproject.toml registers them too.
ALSO = {output.name: output for output in _FURTHER}
#: All of our own.
REGISTRY = {
    output.name: output for output in (*ALWAYS, OVERLAY, REPORT, EXPLANATION_PICTURE, EXPLANATION, *ALSO.values())
}


def offered() -> list[str]:
    """Names that `--also` takes: ours, and plugins' names."""
    from roadgeo.plugins import OUTPUTS, find_plugins

    return sorted({*ALSO, *find_plugins(OUTPUTS)})


def find_outputs(names: Iterable[str]) -> list[Output]:
    """Return outputs by their names, each once: ours, or else plugins' outputs.

    Raises
    ------
    PluginError
        No output has that name, or what is offered under it is not an `Output`.
    """
    return [REGISTRY[name] if name in REGISTRY else _load(name) for name in dict.fromkeys(names)]


def _load(name: str) -> Output:
    from roadgeo.plugins import OUTPUTS, load_plugin

    output = load_plugin(OUTPUTS, name)
    if not isinstance(output, Output):
        raise PluginError(
            f"the output {name!r} is a {type(output).__name__}, expected a roadgeo.outputs.registry.Output"
        )
    return output


def result_endings() -> tuple[str, ...]:
    """Return how names of results end, ours and plugins'; all installed packages are asked for it."""
    return tuple(output.ending for output in (*REGISTRY.values(), *_installed()) if "{" not in output.ending)


def is_result(name: str, endings: tuple[str, ...]) -> bool:
    """Whether a file of this name is a result, by `result_endings`, rather than a mask."""
    stem, _, _ = name.rpartition(".")
    return name.lower().endswith(endings) or stem.endswith((VECTORIZED, LOCALIZABILITY))


def _installed() -> Iterable[Output]:
    """Yield the outputs of other packages, but for those that cannot be loaded: nobody has asked for them."""
    from roadgeo.plugins import OUTPUTS, find_plugins, package_of

    for name, plugin in find_plugins(OUTPUTS).items():
        if package_of(plugin) != "roadgeo":
            try:
                yield _load(name)
            except PluginError:
                continue
