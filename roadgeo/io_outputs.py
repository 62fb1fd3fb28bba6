"""Where a result leaves: the warped mask, the GeoPackage and the JSON of a location, all of them or none."""

from __future__ import annotations

import json
import os
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from roadgeo._version import __version__
from roadgeo.errors import OutputError
from roadgeo.files import replacing
from roadgeo.geopackage import Layer, write_layers
from roadgeo.grid import PIXEL_TO_PLANE, RoadMask, plane_to_pixel
from roadgeo.homography import Homography
from roadgeo.location import Evidence, Location
from roadgeo.styles import draw_fill, draw_line, draw_marker, draw_palette
from roadgeo.typing import AnyArray, FloatArray
from roadgeo.warping import choose_grid, warp

__all__ = ["OutputOptions", "OutputPaths", "Placement", "output_paths", "write_location"]

#: Values of the warped mask, and how they are drawn: colour, alpha, label. Outside the footprint is nodata.
OUTSIDE, GROUND, ROAD = 0, 1, 2
PALETTE = {GROUND: ("#fdf6ec", 0, "no road"), ROAD: ("#e4572e", 255, "road")}

_FOOTPRINT_STYLE = draw_fill("31,111,180,20", "31,111,180", 0.7)
_ROADS_STYLE = draw_line("228,87,46", 0.5)
_MATCHES_STYLE = draw_marker("27,38,59", 2.2)


@dataclass(frozen=True)
class OutputOptions:
    """How the warped mask is drawn.

    Attributes
    ----------
    resolution_m : float or None
        Pixel size of the warped mask, metres; None: the mask's own at its centre.
    max_pixels : int
        Coarsen the warped mask beyond this size: a camera that looks far ahead sees much ground.
    """

    resolution_m: float | None = None
    max_pixels: int = 100_000_000


@dataclass(frozen=True)
class Placement:
    """What a located `Location` surely has; see there for shapes and frames."""

    crs: str
    homography: FloatArray
    footprint: FloatArray
    gsd_m: float

    @classmethod
    def of(cls, location: Location) -> Placement:
        """Take it from a location that has a place.

        Raises
        ------
        OutputError
            It has none.
        """
        crs, homography, footprint, gsd_m = location.crs, location.homography, location.footprint, location.gsd_m
        if crs is None or homography is None or footprint is None or gsd_m is None:
            raise OutputError(f"{location.query} has no place on the map to draw: it is {location.status}")
        return cls(crs, homography, footprint, gsd_m)


@dataclass(frozen=True)
class OutputPaths:
    """Names of the files that one mask's result may have."""

    footprint: Path
    style: Path
    geopackage: Path
    overlay: Path
    json: Path

    @property
    def georeferenced(self) -> tuple[Path, ...]:
        """Those that exist only for a located mask."""
        return self.footprint, self.style, self.geopackage, self.overlay


def output_paths(folder: str | os.PathLike[str], stem: str) -> OutputPaths:
    """Name the outputs of the mask `stem` in a folder."""
    base = Path(folder)
    return OutputPaths(
        base / f"{stem}_footprint.tif",
        base / f"{stem}_footprint.qml",
        base / f"{stem}_location.gpkg",
        base / f"{stem}_overlay.png",
        base / f"{stem}_location.json",
    )


def write_location(
    location: Location, mask: RoadMask, paths: OutputPaths, options: OutputOptions | None = None
) -> Location:
    """Write what a location asks for and return it with `seconds.write` set.

    A located mask gets every file but the overlay (see `roadgeo.plot`); any other gets its JSON only, and files that an
    earlier run left under these names are removed, lest a place that no longer holds be taken for the result.

    Raises
    ------
    OutputError
        A file cannot be written; then none is.
    """
    started = perf_counter()
    if not location.located:
        _remove(paths.georeferenced)
    with ExitStack() as files:
        # Entered first, renamed last: whoever sees the JSON finds the other files whole.
        report = files.enter_context(replacing(paths.json, sync=False))
        if location.located:
            footprint = files.enter_context(replacing(paths.footprint, sync=False))
            footprint.write_bytes(_draw_raster(location, mask, options or OutputOptions()))
            style = files.enter_context(replacing(paths.style, sync=False))
            style.write_text(draw_palette(PALETTE), encoding="utf-8")
            write_layers(files.enter_context(replacing(paths.geopackage, sync=False)), _layers(location))
        location = replace(location, seconds=replace(location.seconds, write=perf_counter() - started))
        report.write_text(json.dumps(location.to_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return location


def _remove(paths: tuple[Path, ...]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot remove {path}, an earlier result that no longer holds: {error.strerror}; remove it yourself"
            ) from error


# --- the warped mask --------------------------------------------------------------------------------------------------


def _draw_raster(location: Location, mask: RoadMask, options: OutputOptions) -> bytes:
    """Draw the mask on the map: a Cloud Optimized GeoTIFF with a colour table, nodata outside the footprint."""
    import rasterio
    import rasterio.shutil

    place = Placement.of(location)
    grid = choose_grid(place.footprint, options.resolution_m or place.gsd_m, options.max_pixels)
    labels = warp(_labels(mask), place.homography, grid)
    size = grid.resolution
    profile = {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": 1,
        "dtype": "uint8",
        "nodata": OUTSIDE,
        "crs": place.crs,
        "transform": rasterio.Affine(size, 0.0, grid.west, 0.0, -size, grid.north),
    }
    with rasterio.MemoryFile() as memory, rasterio.MemoryFile(ext="tif") as optimized:
        with memory.open(**profile) as plain:
            plain.write(labels, 1)
            plain.write_colormap(1, {value: _rgba(color) for value, (color, _, _) in PALETTE.items()})
            plain.update_tags(**_tags(location))
            rasterio.shutil.copy(
                plain,
                optimized.name,
                driver="COG",
                compress="DEFLATE",
                level=1,
                overview_resampling="mode",
                blocksize=512,
            )
        return bytes(optimized.read())


def _labels(mask: RoadMask) -> AnyArray:
    """(H, W) uint8: OUTSIDE where nothing was observed, GROUND or ROAD elsewhere."""
    labels = np.where(mask.roads, np.uint8(ROAD), np.uint8(GROUND))
    if mask.observed is not None:
        labels[~mask.observed] = OUTSIDE
    return labels


def _rgba(color: str) -> tuple[int, int, int, int]:
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue, 255


def _tags(location: Location) -> dict[str, str]:
    """Provenance, for `gdalinfo`."""
    homography = [] if location.homography is None else location.homography.tolist()
    return {
        "TIFFTAG_SOFTWARE": f"roadgeo {__version__}",
        "ROADGEO_QUERY": location.query,
        "ROADGEO_REFERENCE": location.reference,
        "ROADGEO_HOMOGRAPHY": json.dumps(homography),
        "ROADGEO_LOG10_ODDS": f"{location.log10_odds}",
    }


# --- the GeoPackage ---------------------------------------------------------------------------------------------------


def _layers(location: Location) -> list[Layer]:
    place = Placement.of(location)
    layers = [
        Layer(
            "footprint",
            "POLYGON",
            [place.footprint],
            _attributes(location),
            place.crs,
            _FOOTPRINT_STYLE,
            "Ground that the image shows",
        )
    ]
    if location.evidence is not None:
        layers += [_road_layer(place, location.evidence), _match_layer(place, location.evidence)]
    return layers


def _attributes(location: Location) -> dict[str, list[Any]]:
    names = ["query", "status", "reason", "reference", "gsd_m", "rotation_deg", "tilt_deg", "n_intersections"]
    names += ["n_matched", "inlier_ratio", "log10_odds"]
    sigma = location.corner_sigma_m
    worst = None if sigma is None else float(sigma.max())
    return {**{name: [getattr(location, name)] for name in names}, "max_corner_sigma_m": [worst]}


def _road_layer(place: Placement, evidence: Evidence) -> Layer:
    """Draw the mask's roads on the map. A homography keeps lines straight, so mapping their vertices is exact."""
    to_crs = Homography(place.homography @ PIXEL_TO_PLANE)
    lines = [line for line in map(to_crs, evidence.query_graph.polylines()) if np.isfinite(line).all()]
    lengths = [float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines]
    return Layer(
        "query_roads",
        "LINESTRING",
        lines,
        {"length_m": lengths},
        place.crs,
        _ROADS_STYLE,
        "Roads of the mask, as vectorized",
    )


def _match_layer(place: Placement, evidence: Evidence) -> Layer:
    """Show matched intersections where the map has them, with the way from the mask's to the map's."""
    pixels = plane_to_pixel(evidence.query_xy)
    offset = evidence.reference_xy - Homography(place.homography)(pixels)
    columns = {
        "column": pixels[:, 0],
        "row": pixels[:, 1],
        "residual_m": evidence.residual_m,
        "dx_m": offset[:, 0],
        "dy_m": offset[:, 1],
    }
    return Layer(
        "matches",
        "POINT",
        evidence.reference_xy,
        columns,
        place.crs,
        _MATCHES_STYLE,
        "Intersections found both in the mask and on the map",
    )
