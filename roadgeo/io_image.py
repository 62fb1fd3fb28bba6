"""Georeferencing the picture itself: warped block by block onto a map grid in any CRS, a Cloud Optimized GeoTIFF."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window

from roadgeo.errors import CrsError, MaskError
from roadgeo.homography import Homography
from roadgeo.io_outputs import Placement
from roadgeo.typing import AnyArray, FloatArray
from roadgeo.warping import MapGrid, choose_grid

__all__ = ["ImageOptions", "ImageSize", "image_homography", "warp_image"]

ResamplingName = Literal["nearest", "bilinear", "cubic", "lanczos"]

_INTERPOLATION = {
    "nearest": cv2.INTER_NEAREST,
    "bilinear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_BLOCK = 1024  # side of the blocks that are drawn one after another
_REACH = 8  # pixels around a block's source that interpolation may look at
_GRID_STEP = 64  # CRS transformations are computed at every 64th pixel and interpolated between
_TILED_BYTES = 1 << 28  # larger pictures that can only be read from the top down are first copied into tiles
_MAX_SOURCE = 8192  # sides of a block's source beyond which it is read coarser


@dataclass(frozen=True)
class ImageOptions:
    """How a picture is drawn on the map.

    Attributes
    ----------
    crs : str or None
        Target CRS; None: the location's own, metric one.
    resolution : float or None
        Pixel size in units of the target CRS; None: the picture's own at its centre.
    resampling : {"nearest", "bilinear", "cubic", "lanczos"}
        How values between pixels are found.
    max_pixels : int
        A larger result is made coarser.
    """

    crs: str | None = None
    resolution: float | None = None
    resampling: ResamplingName = "cubic"
    max_pixels: int = 400_000_000


@dataclass(frozen=True)
class ImageSize:
    """Width and height of a picture, and how many times it is the mask's size."""

    width: int
    height: int
    scale: float


def image_homography(
    place: Placement, mask_size: tuple[int, int], path: str | os.PathLike[str]
) -> tuple[FloatArray, ImageSize]:
    """Return the homography (3, 3) from a picture's pixels to the CRS, given its mask's, and the picture's size.

    The picture shows the frame of the mask at any number of pixels.

    Raises
    ------
    MaskError
        The picture cannot be read, or its sides are in another proportion than the mask's.
    """
    with _open(path) as picture:
        width, height = picture.width, picture.height
    factors = np.array([mask_size[0] / width, mask_size[1] / height])
    # The sides of a reduced picture are rounded, so a pixel's worth of difference is none.
    if abs(factors[0] / factors[1] - 1) > 1.5 / min(*mask_size, width, height) + 1e-9:
        raise MaskError(
            f"{path} is {width} x {height} pixels, its mask {mask_size[0]} x {mask_size[1]}: expected the same frame, "
            "at any scale; crop or pad the picture as the mask was made"
        )
    return place.homography @ np.diag([*factors, 1.0]), ImageSize(width, height, float(1 / factors.mean()))


def warp_image(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    place: Placement,
    homography: FloatArray,
    tags: Mapping[str, str],
    options: ImageOptions | None = None,
) -> MapGrid:
    """Draw a picture on the map as a Cloud Optimized GeoTIFF; return the grid it was drawn on.

    Bands, their type and their colours are kept. Ground that the picture does not show is transparent: an alpha band
    for 8 and 16 bit pictures, the nodata value (the picture's own, else NaN or the least value) for others.

    Parameters
    ----------
    homography : (3, 3) float64
        From the picture's pixels (column, row; GDAL corner convention) to the place's CRS.

    Raises
    ------
    MaskError
        The picture cannot be read.
    CrsError
        The target CRS is unknown or not made for this place.
    """
    options = options or ImageOptions()
    crs = options.crs or place.crs
    with ExitStack() as stack:
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=256))
        folder = Path(stack.enter_context(TemporaryDirectory(dir=Path(target).parent, prefix=".roadgeo-")))
        picture = stack.enter_context(_open(_tile(source, folder)))
        to_target = _transformation(place.crs, crs)
        grid = _choose_grid(homography, picture, to_target, options)
        plan = _Plan(picture, homography, _transformation(crs, place.crs), grid, _INTERPOLATION[options.resampling])
        drawn = folder / "drawn.tif"
        with rasterio.open(drawn, "w", **_profile(plan, crs)) as sink:
            sink.colorinterp = _colors(plan)
            sink.update_tags(**tags)
            for window, block in _blocks(plan):
                sink.write(block, window=window)
        rasterio.shutil.copy(
            drawn,
            target,
            driver="COG",
            compress="DEFLATE",
            level=6,
            predictor="YES",
            bigtiff="IF_SAFER",
            overview_resampling="nearest" if options.resampling == "nearest" else "average",
        )
    return grid


# --- the source -------------------------------------------------------------------------------------------------------


def _open(path: str | os.PathLike[str]) -> Any:
    try:
        with warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning):  # that is why we are here
            return rasterio.open(path)
    except RasterioError as error:
        raise MaskError(f"cannot read the picture {path}: {error}; give a raster that GDAL reads") from error


def _tile(path: str | os.PathLike[str], folder: Path) -> str | os.PathLike[str]:
    """Copy a large picture that can only be read from the top down into tiles; return what to read."""
    with _open(path) as picture:
        item = np.dtype(picture.dtypes[0]).itemsize
        size = picture.width * picture.height * picture.count * item
        whole_rows = picture.block_shapes[0][1] == picture.width
    if not whole_rows or size < _TILED_BYTES:
        return path
    copy = folder / "tiles.tif"
    with _open(path) as picture:
        rasterio.shutil.copy(
            picture, copy, driver="GTiff", tiled=True, blockxsize=512, blockysize=512, bigtiff="IF_SAFER"
        )
    return copy


@dataclass(frozen=True)
class _Plan:
    """What is drawn, on what."""

    picture: Any
    homography: FloatArray
    to_place: Any  # target CRS to the place's CRS, or None
    grid: MapGrid
    interpolation: int

    @property
    def bands(self) -> list[int]:
        """Bands that are drawn: all but alpha, which is drawn anew."""
        return [
            i for i, c in zip(self.picture.indexes, self.picture.colorinterp, strict=True) if c != ColorInterp.alpha
        ]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of all bands."""
        name: str = self.picture.dtypes[0]
        return np.dtype(name)

    @property
    def has_alpha(self) -> bool:
        """Whether the result has an alpha band, else a nodata value."""
        return self.dtype in (np.dtype("uint8"), np.dtype("uint16"))

    @property
    def nodata(self) -> float | None:
        """Value of unknown ground where there is no alpha band."""
        if self.has_alpha:
            return None
        if self.picture.nodata is not None:
            return float(self.picture.nodata)
        return math.nan if self.dtype.kind == "f" else float(np.iinfo(self.dtype).min)


def _profile(plan: _Plan, crs: str) -> dict[str, Any]:
    grid = plan.grid
    return {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": len(plan.bands) + plan.has_alpha,
        "dtype": plan.dtype.name,
        "nodata": plan.nodata,
        "crs": crs,
        "transform": rasterio.Affine(grid.resolution, 0.0, grid.west, 0.0, -grid.resolution, grid.north),
        "tiled": True,
        "blockxsize": 512,
        "blockysize": 512,
        "compress": "LZW",
        "bigtiff": "IF_SAFER",
    }


def _colors(plan: _Plan) -> list[ColorInterp]:
    kept = [plan.picture.colorinterp[band - 1] for band in plan.bands]
    kept = [ColorInterp.gray if color == ColorInterp.palette else color for color in kept]
    return [*kept, *([ColorInterp.alpha] if plan.has_alpha else [])]


# --- the grid ---------------------------------------------------------------------------------------------------------


def _transformation(source: str, target: str) -> Any:
    """Return a pyproj transformer, or None where the two are one."""
    if source == target:
        return None
    import pyproj

    try:
        return pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise CrsError(f"unknown CRS {target[:60]!r}; give an EPSG code such as EPSG:3857") from error


def _choose_grid(homography: FloatArray, picture: Any, to_target: Any, options: ImageOptions) -> MapGrid:
    """Lay a grid over the footprint's outline, with the picture's own resolution at its centre unless told another."""
    corners = np.array([[0, 0], [picture.width, 0], [picture.width, picture.height], [0, picture.height]], float)
    outline = np.concatenate(
        [np.linspace(a, b, 33)[:-1] for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    center = corners.mean(axis=0)
    around = center + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]])
    outline, around = (_map(points, homography, to_target) for points in (outline, around))
    if not np.isfinite(outline).all() or not np.isfinite(around).all():
        raise CrsError(f"the footprint lies outside what {options.crs} is made for; choose another --crs")
    sides = np.hypot(*(around[1] - around[0])), np.hypot(*(around[3] - around[2]))
    return choose_grid(outline, options.resolution or float(np.sqrt(sides[0] * sides[1])), options.max_pixels)


def _map(pixels: FloatArray, homography: FloatArray, to_target: Any) -> FloatArray:
    xy = Homography(homography)(pixels)
    return xy if to_target is None else np.stack(to_target.transform(xy[:, 0], xy[:, 1]), axis=1)


# --- drawing ----------------------------------------------------------------------------------------------------------


def _blocks(plan: _Plan) -> Iterator[tuple[Window, AnyArray]]:
    """Draw block after block, (bands, rows, columns); blocks that show nothing are left out."""
    for row in range(0, plan.grid.height, _BLOCK):
        for column in range(0, plan.grid.width, _BLOCK):
            width, height = min(_BLOCK, plan.grid.width - column), min(_BLOCK, plan.grid.height - row)
            pixels = _source_pixels(plan, column, row, width, height)
            inside = np.all((pixels > 0) & (pixels < (plan.picture.width, plan.picture.height)), axis=2)
            window = Window(column, row, width, height)
            if inside.any():
                yield window, _draw_block(plan, pixels, inside)
            elif not plan.has_alpha:
                yield window, np.full((len(plan.bands), height, width), plan.nodata, plan.dtype)


def _source_pixels(plan: _Plan, column: int, row: int, width: int, height: int) -> FloatArray:
    """Picture pixels (rows, columns, 2; corner convention) whose ground lies at the centres of a block's pixels."""
    to_pixel = Homography(plan.homography).inverse()
    to_crs = plan.grid.to_crs_matrix(column, row)
    if plan.to_place is None:
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return (to_pixel @ Homography(to_crs))(np.stack([columns, rows], axis=2))
    # The coarse grid reaches to the block's outer edges; between its nodes a CRS transformation is as good as bilinear.
    columns, rows = (np.linspace(0, size, size // _GRID_STEP + 2) for size in (width, height))
    nodes = Homography(to_crs)(np.stack(np.meshgrid(columns, rows), axis=2))
    x, y = plan.to_place.transform(nodes[..., 0], nodes[..., 1])
    fine = []
    for coarse in (x, y):
        offset = coarse[0, 0]
        at_columns = np.array([np.interp(np.arange(width) + 0.5, columns, line) for line in coarse - offset])
        at_rows = np.array([np.interp(np.arange(height) + 0.5, rows, line) for line in at_columns.T]).T
        fine.append(at_rows + offset)
    return to_pixel(np.stack(fine, axis=2))


def _draw_block(plan: _Plan, pixels: FloatArray, inside: AnyArray) -> AnyArray:
    window, source_pixels = _source_window(plan, pixels, inside)
    shape = _reduced(plan, window)
    values = plan.picture.read(plan.bands, window=window, out_shape=shape, resampling=Resampling.average)
    known = plan.picture.dataset_mask(window=window, out_shape=shape[1:], resampling=Resampling.nearest) > 0
    scale = np.array(shape[:0:-1]) / (window.width, window.height)
    maps = (source_pixels * scale - 0.5).astype(np.float32)
    image = np.moveaxis(_sample(np.moveaxis(values, 0, 2), maps, known, plan), 2, 0)
    seen = inside & (_remap(known.astype(np.uint8), maps, cv2.INTER_NEAREST)[..., 0] > 0)
    if plan.has_alpha:
        image[:, ~seen] = 0
        opaque = np.where(seen, plan.dtype.type(np.iinfo(plan.dtype).max), plan.dtype.type(0))
        return np.concatenate([image, opaque[None]])
    image[:, ~seen] = plan.nodata
    return image


def _source_window(plan: _Plan, pixels: FloatArray, inside: AnyArray) -> tuple[Window, FloatArray]:
    """Return the part of the picture that a block needs, and the block's pixels counted from that part's corner."""
    low = np.maximum(np.floor(pixels[inside].min(axis=0)) - _REACH, 0).astype(int)
    high = np.minimum(np.ceil(pixels[inside].max(axis=0)) + _REACH, (plan.picture.width, plan.picture.height)).astype(
        int
    )
    window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    return window, np.where(inside[..., None], pixels - low, 0.0)


def _reduced(plan: _Plan, window: Window) -> tuple[int, int, int]:
    """Shape that a window is read at: its own, unless far more pixels are asked for than the block can show."""
    factor = max(1.0, window.width / _MAX_SOURCE, window.height / _MAX_SOURCE)
    return len(plan.bands), max(round(window.height / factor), 1), max(round(window.width / factor), 1)


def _sample(values: AnyArray, maps: AnyArray, known: AnyArray, plan: _Plan) -> AnyArray:
    """Interpolate (rows, columns, bands); unknown pixels have no weight, so that they do not bleed into others."""
    drawable = values if values.dtype in _REMAPPABLE else values.astype(np.float64)
    if known.all() or plan.interpolation == cv2.INTER_NEAREST:
        return _cast(_remap(drawable, maps, plan.interpolation), plan.dtype)
    weights = _remap(known.astype(np.float32), maps, plan.interpolation)
    weighted = _remap(np.where(known[..., None], drawable, 0).astype(np.float32), maps, plan.interpolation)
    return _cast(weighted / np.maximum(weights, 1e-3), plan.dtype)


_REMAPPABLE = tuple(np.dtype(name) for name in ("uint8", "uint16", "int16", "float32", "float64"))


def _remap(image: AnyArray, maps: AnyArray, interpolation: int) -> AnyArray:
    """Look up an image (rows, columns[, bands]) at `maps` (h, w, 2); (h, w, bands)."""
    drawn = cv2.remap(image, maps[..., 0], maps[..., 1], interpolation, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn).reshape(*maps.shape[:2], -1)


def _cast(image: AnyArray, dtype: np.dtype[Any]) -> AnyArray:
    if image.dtype == dtype or dtype.kind == "f":
        return np.asarray(image, dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(image), limits.min, limits.max).astype(dtype)
