"""Where a result leaves: the warped picture or mask, the GeoPackage, the JSON, what else is asked for; all or none."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._version import __version__
from roadgeo.errors import CrsError, OutputError, PluginError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask, plane_to_pixel
from roadgeo.geometry.warping import MapGrid, cover, warp
from roadgeo.location import Evidence, Location
from roadgeo.outputs.orthophoto import ImageOptions, choose_target, image_homography, warp_image
from roadgeo.outputs.paths import FIGURES, OutputPaths, Placement, attributes
from roadgeo.outputs.products import PRODUCTS, Product, Subject
from roadgeo.plugins import OUTPUTS, load_plugin
from roadgeo.storage.files import replacing
from roadgeo.storage.geopackage import Layer, write_layers
from roadgeo.storage.qml import draw_fill, draw_line, draw_marker, draw_palette

__all__ = ["OutputOptions", "write_location"]

#: Values of the warped mask, and how they are drawn: colour, alpha, label. Outside the footprint is nodata.
OUTSIDE, GROUND, ROAD = 0, 1, 2
PALETTE = {GROUND: ("#fdf6ec", 0, "no road"), ROAD: ("#e4572e", 255, "road")}

#: A warped mask is drawn in memory, so it is made coarser beyond this.
_MASK_MAX_PIXELS = 100_000_000

_FOOTPRINT_STYLE = draw_fill("31,111,180,20", "31,111,180", 0.7)
_ROADS_STYLE = draw_line("228,87,46", 0.5)
_MATCHES_STYLE = draw_marker("27,38,59", 2.2)


@dataclass(frozen=True)
class OutputOptions:
    """What is written for a located mask.

    Attributes
    ----------
    image : ImageOptions
        How the picture, or without one the mask, is drawn on the map; masks always with the nearest value.
    products : tuple of str
        Further forms, by the names of plugins: our own are those in `products.PRODUCTS`.
    """

    image: ImageOptions = field(default_factory=ImageOptions)
    products: tuple[str, ...] = ()


def write_location(
    location: Location,
    mask: RoadMask,
    paths: OutputPaths,
    options: OutputOptions | None = None,
    picture: str | os.PathLike[str] | None = None,
) -> tuple[Location, list[Path]]:
    """Write what a location asks for; return it with `seconds.write` set, and the files.

    A located mask gets every file but the overlay (see `outputs.overlay`); any other gets its JSON only. Files that
    an earlier run left under these names are removed, so that stale results are not mistaken for this run's.

    Parameters
    ----------
    picture : path, optional
        The photograph that the mask was made of: drawn on the map instead of the mask.

    Raises
    ------
    OutputError
        A file cannot be written; then none is.
    MaskError
        The picture cannot be read or shows another frame than the mask.
    CrsError
        The target CRS is unknown or not made for this place.
    PluginError
        There is no such product.
    """
    started = perf_counter()
    options = options or OutputOptions()
    source = Path(picture if picture is not None else mask.name or f"{paths.stem}.png")
    written = [paths.json]
    chosen = [_product(name) for name in options.products]
    if not location.located:
        ours = PRODUCTS.values()
        products = (product.path(paths.folder, paths.stem, source.name) for product in (*ours, *chosen))
        pages = [paths.report, paths.explanation, paths.explanation_picture]
        pictures = [paths.overlay, *map(paths.figure, FIGURES)]
        _remove([paths.footprint, paths.style, paths.geopackage, *pictures, *pages, *products])
    with ExitStack() as files:

        def stage(path: Path) -> Path:
            written.append(path)
            return files.enter_context(replacing(path, sync=False))

        # Entered first, renamed last: whoever sees the JSON finds the other files whole.
        report = files.enter_context(replacing(paths.json, sync=False))
        if location.located:
            place = Placement.of(location)
            if picture is None:
                homography, size = place.homography, mask.shape[::-1]
                grid = _write_mask(stage(paths.footprint), location, mask, options.image)
                stage(paths.style).write_text(draw_palette(PALETTE), encoding="utf-8")
            else:
                homography, size = image_homography(place, mask.shape[::-1], picture)
                tags = _tags(location, homography)
                grid = warp_image(picture, stage(paths.footprint), place, homography, tags, options.image)
            write_layers(stage(paths.geopackage), _layers(location))
            subject = Subject(location, place, source, size, homography, grid, options.image.crs or place.crs, paths)
            subject = replace(subject, mask=mask if picture is None else None)
            for product in chosen:
                product.write(stage(product.path(paths.folder, paths.stem, source.name)), subject)
        location = replace(location, seconds=replace(location.seconds, write=perf_counter() - started))
        report.write_text(json.dumps(location.to_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return location, written


def _product(name: str) -> Product:
    product = load_plugin(OUTPUTS, name)
    if not isinstance(product, Product):
        raise PluginError(
            f"the output {name!r} is a {type(product).__name__}, expected a roadgeo.outputs.products.Product"
        )
    return product


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot remove {path}, an earlier result that no longer holds: {error.strerror}; remove it yourself"
            ) from error


# --- the warped mask --------------------------------------------------------------------------------------------------


def _write_mask(path: Path, location: Location, mask: RoadMask, options: ImageOptions) -> MapGrid:
    """Draw the mask on the map: a Cloud Optimized GeoTIFF with a colour table, nodata outside the footprint."""
    import rasterio
    import rasterio.shutil

    place = Placement.of(location)
    crs, to_target, to_place = choose_target(place, options)
    max_pixels = min(options.max_pixels, _MASK_MAX_PIXELS)
    grid = cover(mask.shape[::-1], place.homography, options.resolution, max_pixels, to_target)
    if grid.width == 0:
        raise CrsError(f"the footprint lies outside what {crs} is made for; choose another --crs")
    size = grid.resolution
    profile = {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": 1,
        "dtype": "uint8",
        "nodata": OUTSIDE,
        "crs": crs,
        "transform": rasterio.Affine(size, 0.0, grid.west, 0.0, -size, grid.north),
    }
    with rasterio.MemoryFile() as memory, rasterio.MemoryFile(ext="tif") as optimized:
        with memory.open(**profile) as plain:
            plain.write(warp(_labels(mask), place.homography, grid, to_place), 1)
            plain.write_colormap(1, {value: _rgba(color) for value, (color, _, _) in PALETTE.items()})
            plain.update_tags(**_tags(location, place.homography))
            layout = {"compress": "DEFLATE", "level": 1, "overview_resampling": "nearest", "blocksize": 512}
            rasterio.shutil.copy(plain, optimized.name, driver="COG", **layout)
        path.write_bytes(optimized.read())
    return grid


def _labels(mask: RoadMask) -> AnyArray:
    """(H, W) uint8: OUTSIDE where nothing was observed, GROUND or ROAD elsewhere."""
    labels = np.where(mask.roads, np.uint8(ROAD), np.uint8(GROUND))
    if mask.observed is not None:
        labels[~mask.observed] = OUTSIDE
    return labels


def _rgba(color: str) -> tuple[int, int, int, int]:
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue, 255


def _tags(location: Location, homography: FloatArray) -> dict[str, str]:
    """Say where it comes from, for `gdalinfo`; the homography is that of what is drawn."""
    return {
        "TIFFTAG_SOFTWARE": f"roadgeo {__version__}",
        "ROADGEO_QUERY": location.query,
        "ROADGEO_REFERENCE": location.reference,
        "ROADGEO_HOMOGRAPHY": json.dumps(homography.tolist()),
        "ROADGEO_LOG10_ODDS": f"{location.log10_odds}",
        "ROADGEO_ATTRIBUTION": location.attribution,
    }


# --- the GeoPackage ---------------------------------------------------------------------------------------------------


def _layers(location: Location) -> list[Layer]:
    place = Placement.of(location)
    layers = [
        Layer(
            "footprint",
            "POLYGON",
            [place.footprint],
            {name: [value] for name, value in attributes(location).items()},
            place.crs,
            _FOOTPRINT_STYLE,
            "Ground that the image shows",
        )
    ]
    if location.evidence is not None:
        layers += [_road_layer(place, location.evidence), _match_layer(place, location.evidence)]
    return layers


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
