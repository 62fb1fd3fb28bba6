"""Georeferencing the picture itself: warped block by block onto a map grid in any CRS, a Cloud Optimized GeoTIFF."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp, Resampling
from rasterio.windows import Window

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.lens import Lens
from roadgeo.geometry.warping import MapGrid, Transform, cover, source_pixels
from roadgeo.outputs.paths import Placement
from roadgeo.storage.crs import name_crs
from roadgeo.storage.orientation import UPRIGHT, read_orientation
from roadgeo.storage.rasters import open_raster, raster_size, read_palette, writing_raster

__all__ = ["ImageOptions", "Target", "choose_target", "image_homography", "read_preview", "warp_image"]

ResamplingName = Literal["nearest", "bilinear", "cubic", "lanczos"]

_INTERPOLATION = {
    "nearest": cv2.INTER_NEAREST,
    "bilinear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_BLOCK = 1024  # side of the blocks that are drawn one after another
_REMAPPED = 4  # bands that OpenCV interpolates at a time
_BORDER = cv2.BORDER_REPLICATE
_REACH = 8  # pixels around a block's source that interpolation may look at
_TILED_BYTES = 1 << 28  # larger pictures that can only be read from the top down are first copied into tiles
_MAX_SOURCE = 8192  # sides of a block's source beyond which it is read coarser
_DRAWABLE = tuple(np.dtype(name) for name in ("uint8", "uint16", "int16", "float32", "float64"))  # by OpenCV


@dataclass(frozen=True)
class ImageOptions:
    """How a picture is drawn on the map.

    Attributes
    ----------
    crs : str or None
        Target CRS, as pyproj takes it; None: the location's own, metric one.
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


def read_preview(path: str | os.PathLike[str], side: int) -> AnyArray:
    """Read a picture to look at: (h, w, 4) uint8, red, green, blue, alpha, neither side longer than `side` pixels.

    Values deeper than 8 bit are stretched between the darkest and the brightest hundredth.

    Raises
    ------
    MaskError
        GDAL cannot read it.
    """
    with open_raster(path) as picture:
        factor = min(1.0, side / max(picture.width, picture.height))
        width, height = (max(round(length * factor), 1) for length in (picture.width, picture.height))
        bands, palette = _value_bands(picture), read_palette(picture)
        bands = bands[:3] if len(bands) >= 3 else bands[:1]
        averaged = Resampling.average if palette is None else Resampling.nearest
        values = picture.read(bands, out_shape=(len(bands), height, width), resampling=averaged)
        known = picture.dataset_mask(out_shape=(height, width))
    colors = np.moveaxis(values, 0, 2) if palette is None else palette[values[0]]
    if colors.dtype != np.uint8:
        low, high = np.nanpercentile(colors[known > 0], (1, 99)) if known.any() else (0.0, 1.0)
        colors = np.clip((np.nan_to_num(colors.astype(float)) - low) * (255.0 / max(high - low, 1e-9)), 0, 255)
    preview = np.empty((height, width, 4), np.uint8)
    preview[..., :3], preview[..., 3] = colors, known
    return preview


def image_homography(
    place: Placement, mask_size: tuple[int, int], path: str | os.PathLike[str]
) -> tuple[FloatArray, tuple[int, int]]:
    """Return the homography (3, 3) from a picture's pixels to the CRS, given its mask's size, and the picture's size.

    The picture shows the frame of the mask, at any number of pixels.

    Raises
    ------
    MaskError
        The picture cannot be read, or its sides are in another proportion than the mask's.
    """
    width, height = raster_size(path)
    factors = np.array([mask_size[0] / width, mask_size[1] / height])
    # The sides of a reduced picture are rounded, so a pixel's worth of difference is none.
    if abs(factors[0] / factors[1] - 1) > 1.5 / min(*mask_size, width, height):
        orientation = read_orientation(path)
        remedy = "crop or pad the picture as the mask was made"
        if orientation != UPRIGHT:
            remedy = f"make the mask of the upright picture, which its file turns (EXIF orientation {orientation})"
        raise MaskError(
            f"{path} is {width} x {height} pixels, its mask {mask_size[0]} x {mask_size[1]}: expected the same frame, "
            f"at any scale; {remedy}"
        )
    return place.homography @ np.diag([*factors, 1.0]), (width, height)


class Target(NamedTuple):
    """A CRS to draw in, what takes the place's CRS to it, and what takes it back; None where the two are one."""

    crs: str
    to_target: Transform
    to_place: Transform


def choose_target(place: Placement, options: ImageOptions) -> Target:
    """Choose the CRS to draw in.

    Raises
    ------
    CrsError
        It is unknown.
    """
    crs = place.crs if options.crs is None else name_crs(options.crs)
    if crs == place.crs:
        return Target(crs, None, None)
    from roadgeo.geometry.projection import transformer

    there, back = (transformer(*pair) for pair in ((place.crs, crs), (crs, place.crs)))

    def to_target(xy: FloatArray) -> FloatArray:
        return np.stack(there.transform(xy[..., 0], xy[..., 1]), axis=-1)

    def to_place(xy: FloatArray) -> FloatArray:
        return np.stack(back.transform(xy[..., 0], xy[..., 1]), axis=-1)

    return Target(crs, to_target, to_place)


def warp_image(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    place: Placement,
    homography: FloatArray,
    tags: Mapping[str, str],
    options: ImageOptions | None = None,
) -> MapGrid:
    """Draw a picture on the map as a Cloud Optimized GeoTIFF; return the grid it was drawn on.

    Bands, their type and their colours are kept (a palette becomes red, green and blue). Ground that the picture does
    not show is transparent: an alpha band for 8 and 16 bit pictures, the nodata value (the picture's own, else NaN or
    the least value) for others.

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
    OutputError
        The disk is full or the folder not writable.
    """
    options = options or ImageOptions()
    crs, to_target, to_place = choose_target(place, options)
    with ExitStack() as stack:
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=256 << 20))  # bytes
        folder = Path(stack.enter_context(TemporaryDirectory(dir=Path(target).parent, prefix=".roadgeo-")))
        picture = stack.enter_context(open_raster(_tile(source, folder)))
        size = (picture.width, picture.height)
        grid = cover(size, homography, options.resolution, options.max_pixels, to_target)
        if grid.width == 0:
            raise CrsError(f"the footprint lies outside what {crs} is made for; choose another --crs")
        interpolation, lens = _INTERPOLATION[options.resampling], place.lens(size)
        plan = _Plan(picture, homography, to_place, grid, interpolation, lens)
        drawn = folder / "drawn.tif"
        with writing_raster(target):
            _draw(plan, drawn, crs, tags)
            _optimize(drawn, target, options)
    return grid


# --- the source -------------------------------------------------------------------------------------------------------


def _tile(path: str | os.PathLike[str], folder: Path) -> str | os.PathLike[str]:
    """Copy a large picture that can only be read from the top down into tiles; return what to read."""
    with open_raster(path) as picture:
        size = picture.width * picture.height * picture.count * np.dtype(picture.dtypes[0]).itemsize
        if size < _TILED_BYTES or picture.block_shapes[0][1] != picture.width:
            return path
        copy = folder / "tiles.tif"
        with writing_raster(copy):
            rasterio.shutil.copy(
                picture, copy, driver="GTiff", tiled=True, blockxsize=512, blockysize=512, bigtiff="IF_SAFER"
            )
        return copy


def _value_bands(picture: Any) -> list[int]:
    return [
        band for band, color in zip(picture.indexes, picture.colorinterp, strict=True) if color != ColorInterp.alpha
    ]


@dataclass(frozen=True)
class _Plan:
    """What is drawn, on what."""

    picture: Any
    homography: FloatArray
    to_place: Transform
    grid: MapGrid
    interpolation: int
    lens: Lens | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture."""
        return self.picture.width, self.picture.height

    @property
    def bands(self) -> list[int]:
        """Bands that are read: all but alpha, which is drawn anew."""
        return _value_bands(self.picture)

    @property
    def palette(self) -> AnyArray | None:
        """(256, 3) uint8 colours, where the picture has a palette."""
        return read_palette(self.picture)

    @property
    def colors(self) -> list[ColorInterp]:
        """Of the result's bands."""
        if self.palette is not None:
            kept = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
        else:
            kept = [self.picture.colorinterp[band - 1] for band in self.bands]
        return [*kept, *([ColorInterp.alpha] if self.has_alpha else [])]

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


# --- drawing ----------------------------------------------------------------------------------------------------------


def _draw(plan: _Plan, path: Path, crs: str, tags: Mapping[str, str]) -> None:
    grid = plan.grid
    profile = {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": len(plan.colors),
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
    with rasterio.open(path, "w", **profile) as sink:
        sink.colorinterp = plan.colors
        sink.update_tags(**tags)
        for window, block in _blocks(plan):
            sink.write(block, window=window)


def _optimize(drawn: Path, target: str | os.PathLike[str], options: ImageOptions) -> None:
    rasterio.shutil.copy(
        drawn,
        target,
        driver="COG",
        compress="DEFLATE",
        predictor="YES",
        bigtiff="IF_SAFER",
        overview_resampling="nearest" if options.resampling == "nearest" else "average",
    )


def _blocks(plan: _Plan) -> Iterator[tuple[Window, AnyArray]]:
    """Draw block after block, (bands, rows, columns); where there is alpha, blocks that show nothing are left out."""
    for row in range(0, plan.grid.height, _BLOCK):
        for column in range(0, plan.grid.width, _BLOCK):
            size = min(_BLOCK, plan.grid.width - column), min(_BLOCK, plan.grid.height - row)
            pixels = source_pixels(plan.homography, plan.grid, column, row, size, plan.to_place)
            pixels = pixels if plan.lens is None else plan.lens.bend(pixels)
            inside = np.all((pixels > 0) & (pixels < plan.size), axis=2)
            window = Window(column, row, *size)
            if inside.any():
                yield window, _draw_block(plan, pixels, inside)
            elif not plan.has_alpha:
                yield window, np.full((len(plan.bands), *size[::-1]), plan.nodata, plan.dtype)


def _draw_block(plan: _Plan, pixels: FloatArray, inside: AnyArray) -> AnyArray:
    window, source = _source_window(plan, pixels, inside)
    shape = _reduced_shape(plan, window)
    palette = plan.palette
    averaged = Resampling.average if palette is None else Resampling.nearest
    values = np.moveaxis(plan.picture.read(plan.bands, window=window, out_shape=shape, resampling=averaged), 0, 2)
    known = plan.picture.dataset_mask(window=window, out_shape=shape[1:], resampling=Resampling.nearest) > 0
    if palette is not None:
        values = palette[values[..., 0]]
    maps = (source * (np.array(shape[:0:-1]) / (window.width, window.height)) - 0.5).astype(np.float32)
    image = np.moveaxis(_sample(values, maps, known, plan), 2, 0)
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
    high = np.minimum(np.ceil(pixels[inside].max(axis=0)) + _REACH, plan.size).astype(int)
    window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    return window, np.where(inside[..., None], pixels - low, 0.0)


def _reduced_shape(plan: _Plan, window: Window) -> tuple[int, int, int]:
    """Shape that a window is read at: its own, unless far more pixels are asked for than the block can show."""
    factor = max(1.0, window.width / _MAX_SOURCE, window.height / _MAX_SOURCE)
    return len(plan.bands), max(round(window.height / factor), 1), max(round(window.width / factor), 1)


def _sample(values: AnyArray, maps: AnyArray, known: AnyArray, plan: _Plan) -> AnyArray:
    """Interpolate (rows, columns, bands); unknown pixels have no weight, so that they do not bleed into others."""
    drawable = values if values.dtype in _DRAWABLE else values.astype(np.float64)
    if known.all() or plan.interpolation == cv2.INTER_NEAREST:
        return _cast(_remap(drawable, maps, plan.interpolation), plan.dtype)
    weights = _remap(known.astype(np.float32), maps, plan.interpolation)
    weighted = _remap(np.where(known[..., None], drawable, 0).astype(np.float32), maps, plan.interpolation)
    return _cast(weighted / np.maximum(weights, 1e-3), plan.dtype)


def _remap(image: AnyArray, maps: AnyArray, interpolation: int) -> AnyArray:
    """Look up an image (rows, columns[, bands]) at `maps` (h, w, 2); (h, w, bands)."""
    bands = image if image.ndim == 3 else image[..., None]
    drawn = [
        cv2.remap(bands[..., i : i + _REMAPPED], maps[..., 0], maps[..., 1], interpolation, borderMode=_BORDER)
        for i in range(0, bands.shape[2], _REMAPPED)
    ]
    return np.concatenate([one.reshape(*maps.shape[:2], -1) for one in drawn], axis=2)


def _cast(image: AnyArray, dtype: np.dtype[Any]) -> AnyArray:
    if image.dtype == dtype or dtype.kind == "f":
        return np.asarray(image, dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(image), limits.min, limits.max).astype(dtype)
