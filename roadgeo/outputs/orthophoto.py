"""Georeferencing the picture itself: warped block by block onto a map grid in any CRS, a Cloud Optimized GeoTIFF."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.windows import Window

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.lens import Lens
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import transform
from roadgeo.geometry.warping import MapGrid, Transform, cover, source_pixels
from roadgeo.outputs.options import ImageOptions
from roadgeo.storage.crs import name_crs
from roadgeo.storage.orientation import UPRIGHT, read_orientation
from roadgeo.storage.rasters import open_raster, raster_size, read_palette, value_bands, writing_raster

__all__ = [
    "COMPRESSION",
    "Target",
    "choose_target",
    "image_homography",
    "read_preview",
    "warp_image",
]


_INTERPOLATION = {
    "nearest": cv2.INTER_NEAREST,
    "bilinear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_BLOCK = 512  # side of the blocks that are drawn one after another
_BORDER = cv2.BORDER_REPLICATE
_BANDS = 4  # that OpenCV looks up at a time
_SEEN = 255  # in OpenCV's masks
_LABELS = 16  # a picture whose values all lie below holds labels
_REACH = 8  # pixels around a block's source that interpolation may look at
_TILED_BYTES = 1 << 28  # larger pictures that can only be read from the top down are first copied into tiles
_MAX_SOURCE = 8192  # sides of a block's source beyond which it is read coarser
_OVERVIEW_SIDE = 512  # the smallest overview has no longer side
#: How results are compressed. Deflate is read everywhere; above level 1 it saves 2 % of a photograph in twice the time.
COMPRESSION: dict[str, dict[str, Any]] = {
    "deflate": {"compress": "DEFLATE", "predictor": "YES", "level": 1},
    "zstd": {"compress": "ZSTD", "predictor": "YES", "level": 1},
    "jpeg": {"compress": "JPEG", "quality": 90},
    "webp": {"compress": "WEBP", "quality": 90},
}
_DRAWABLE = tuple(np.dtype(name) for name in ("uint8", "uint16", "int16", "float32", "float64"))  # by OpenCV


def read_preview(path: str | os.PathLike[str], side: int) -> AnyArray:
    """Read a picture to look at: (h, w, 4) uint8, red, green, blue, alpha, neither side longer than `side` pixels.

    Values deeper than 8 bit, and labels, are stretched between the darkest and the brightest hundredth.

    Raises
    ------
    MaskError
        GDAL cannot read it.
    """
    with open_raster(path) as picture:
        factor = min(1.0, side / max(picture.width, picture.height))
        width, height = (max(round(length * factor), 1) for length in (picture.width, picture.height))
        bands, palette = value_bands(picture), read_palette(picture)
        bands = bands[:3] if len(bands) >= 3 else bands[:1]
        averaged = Resampling.average if palette is None else Resampling.nearest
        values = picture.read(bands, out_shape=(len(bands), height, width), resampling=averaged)
        valid = picture.dataset_mask(out_shape=(height, width))
    colors = np.moveaxis(values, 0, 2) if palette is None else palette[values[0]]
    if colors.dtype != np.uint8 or (palette is None and colors.max(initial=0) < _LABELS):
        low, high = np.nanpercentile(colors[valid > 0], (1, 99)) if valid.any() else (0.0, 1.0)
        colors = np.clip((np.nan_to_num(colors.astype(float)) - low) * (255.0 / max(high - low, 1e-9)), 0, 255)
    preview = np.empty((height, width, 4), np.uint8)
    preview[..., :3], preview[..., 3] = colors, valid
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
    # The sides of a reduced picture are rounded, so they may differ by a pixel's worth.
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
    """The CRS of the drawing and the transforms from and to the place's CRS; None where the two are one."""

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
    return Target(crs, partial(transform, place.crs, crs), partial(transform, crs, place.crs))


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
        _require_compressible(plan, options.compression)
        drawn = folder / "drawn.tif"
        with writing_raster(target):
            _draw(plan, drawn, crs, tags)
            _optimize(drawn, target, options)
    return grid


# --- the source -------------------------------------------------------------------------------------------------------


def _tile(path: str | os.PathLike[str], folder: Path) -> str | os.PathLike[str]:
    """Copy a large picture that is stored line by line into tiles; return the path to read."""
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


@dataclass(frozen=True)
class _Plan:
    """A picture and its placement on the output grid."""

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

    @cached_property
    def bands(self) -> list[int]:
        """Bands that are read: all but alpha, which is drawn anew."""
        return value_bands(self.picture)

    @cached_property
    def palette(self) -> AnyArray | None:
        """(256, 3) uint8 colours, where the picture has a palette."""
        return read_palette(self.picture)

    @property
    def colors(self) -> list[ColorInterp]:
        """Colours of the result's bands."""
        if self.palette is not None:
            kept = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
        else:
            kept = [self.picture.colorinterp[band - 1] for band in self.bands]
        return [*kept, *([ColorInterp.alpha] if self.has_alpha else [])]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of all bands."""
        name: str = self.picture.dtypes[0]
        return np.dtype(name)

    @property
    def has_alpha(self) -> bool:
        """Whether the result has an alpha band, else a nodata value."""
        return self.dtype in (np.dtype("uint8"), np.dtype("uint16"))

    def valid(self, window: Window, shape: tuple[int, int]) -> BoolArray | None:
        """Return where the picture knows its values in a window, read as (rows, columns); None: everywhere."""
        if all(MaskFlags.all_valid in flags for flags in self.picture.mask_flag_enums):
            return None
        valid = self.picture.dataset_mask(window=window, out_shape=shape, resampling=Resampling.nearest) > 0
        return None if valid.all() else np.asarray(valid, bool)

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
    """Draw a GeoTIFF, and its overviews beside it where there is an alpha band: far quicker than GDAL makes them."""
    with ExitStack() as stack:
        sinks = [stack.enter_context(rasterio.open(path, "w", **_profile(plan, crs)))]
        sinks[0].colorinterp = plan.colors
        sinks[0].update_tags(**tags)
        while plan.has_alpha and max(sinks[-1].shape) > _OVERVIEW_SIDE and 1 << len(sinks) <= _BLOCK:
            path = path.with_name(f"{path.name}.ovr")
            height, width = (math.ceil(side / 2) for side in sinks[-1].shape)
            sinks.append(stack.enter_context(rasterio.open(path, "w", **_profile(plan, None, (width, height)))))
        for column, row, block in _blocks(plan):
            for level, sink in enumerate(sinks):
                block = _halve(block, plan) if level else block
                window = Window(column >> level, row >> level, block.shape[1], block.shape[0])
                sink.write(np.moveaxis(block, 2, 0), window=window)


def _profile(plan: _Plan, crs: str | None, size: tuple[int, int] | None = None) -> dict[str, Any]:
    """Return the creation options of a GeoTIFF; one without CRS is an overview of `size` (width, height)."""
    grid = plan.grid
    width, height = size or (grid.width, grid.height)
    profile: dict[str, Any] = {"driver": "GTiff", "width": width, "height": height, "count": len(plan.colors)}
    profile |= {"dtype": plan.dtype.name, "interleave": "pixel", "sparse_ok": True, "bigtiff": "IF_SAFER"}
    profile |= {"tiled": True, "blockxsize": 512, "blockysize": 512}
    if crs is not None:
        transform = rasterio.Affine(*grid.to_crs_matrix()[:2].ravel().tolist())
        profile |= {"crs": crs, "transform": transform, "nodata": plan.nodata}
    return profile


def _halve(block: AnyArray, plan: _Plan) -> AnyArray:
    """Return a block (rows, columns, bands) at half the size; transparent pixels do not darken their neighbours."""
    if plan.interpolation == cv2.INTER_NEAREST:
        return np.ascontiguousarray(block[::2, ::2])
    opaque = np.iinfo(plan.dtype).max
    even = cv2.copyMakeBorder(block, 0, block.shape[0] % 2, 0, block.shape[1] % 2, _BORDER)
    half: AnyArray = cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA)
    at_edge = (half[..., -1] > 0) & (half[..., -1] < opaque)
    if at_edge.any():
        half[at_edge, :-1] = _cast(half[at_edge, :-1] * (opaque / half[at_edge, -1:]), plan.dtype)
        half[at_edge, -1] = opaque
    return half


def _require_compressible(plan: _Plan, compression: str) -> None:
    """Raise where a picture has other values than a lossy compression holds."""
    n_bands = len(plan.colors) - plan.has_alpha
    fits = plan.dtype == np.uint8 and n_bands in ((1, 3) if compression == "jpeg" else (3,))
    if compression in ("jpeg", "webp") and not fits:
        expected = "one band or three of 8 bits" if compression == "jpeg" else "three bands of 8 bits"
        raise MaskError(
            f"{compression} holds {expected}; the picture has {n_bands} of {plan.dtype.name}: choose deflate or zstd"
        )


def _optimize(drawn: Path, target: str | os.PathLike[str], options: ImageOptions) -> None:
    nearest = options.resampling == "nearest"
    with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="FALSE"):  # the overviews lie beside it
        rasterio.shutil.copy(
            drawn,
            target,
            driver="COG",
            num_threads="ALL_CPUS",
            bigtiff="IF_SAFER",
            overview_resampling="nearest" if nearest else "average",
            **COMPRESSION[options.compression],
        )


def _blocks(plan: _Plan) -> Iterator[tuple[int, int, AnyArray]]:
    """Draw block after block: column, row, and (rows, columns, bands); transparent ones are left out.

    All reading is done here, for GDAL's settings belong to a thread; a few blocks are drawn at a time.
    """
    n_threads = os.cpu_count() or 1
    with ThreadPoolExecutor(n_threads) as pool:
        begun: deque[tuple[int, int, Future[AnyArray]]] = deque()
        for column, row, size in _cut_up(plan.grid):
            pixels = source_pixels(plan.homography, plan.grid, column, row, size, plan.size, plan.to_place, plan.lens)
            inside = cv2.inRange(pixels, (0.0, 0.0), plan.size)
            if inside.any():
                part = _read_part(plan, pixels, inside)
                begun.append((column, row, pool.submit(_draw_block, plan, part, pixels, inside)))
            elif not plan.has_alpha:
                empty = (*size[::-1], len(plan.bands))
                begun.append((column, row, pool.submit(np.full, empty, plan.nodata, plan.dtype)))
            while len(begun) > 2 * n_threads:
                column, row, block = begun.popleft()
                yield column, row, block.result()
        yield from ((column, row, block.result()) for column, row, block in begun)


def _cut_up(grid: MapGrid) -> Iterator[tuple[int, int, tuple[int, int]]]:
    """Return column, row, and size (width, height) of the blocks of a grid."""
    for row in range(0, grid.height, _BLOCK):
        for column in range(0, grid.width, _BLOCK):
            yield column, row, (min(_BLOCK, grid.width - column), min(_BLOCK, grid.height - row))


class _Block(NamedTuple):
    """A window of a picture: (rows, columns, bands), and where they are known; None: everywhere."""

    window: Window
    values: AnyArray
    valid: BoolArray | None


def _read_part(plan: _Plan, pixels: FloatArray, inside: AnyArray) -> _Block:
    """Read what a block needs."""
    window = _source_window(plan, pixels, inside)
    shape, palette = _reduced_shape(plan, window), plan.palette
    averaged = Resampling.average if palette is None else Resampling.nearest
    values = np.empty(shape, plan.dtype)
    plan.picture.read(plan.bands, window=window, out=np.moveaxis(values, 2, 0), resampling=averaged)
    if palette is not None:
        values = palette[values[..., 0]]
    return _Block(window, values, plan.valid(window, shape[:2]))


def _draw_block(plan: _Plan, part: _Block, pixels: FloatArray, inside: AnyArray) -> AnyArray:
    window, values, valid = part
    across, along = values.shape[1] / window.width, values.shape[0] / window.height
    from_center = [[across, 0.0, -across * window.col_off - 0.5], [0.0, along, -along * window.row_off - 0.5]]
    maps = cv2.transform(pixels, np.array(from_center)).astype(np.float32)
    image = _sample(values, maps, valid, plan)
    if valid is not None:
        inside = cv2.min(inside, _remap(_SEEN * valid.view(np.uint8)[..., None], maps, cv2.INTER_NEAREST))
    image[inside == 0] = plan.nodata or 0
    return cv2.merge((image, inside * plan.dtype.type(np.iinfo(plan.dtype).max // _SEEN))) if plan.has_alpha else image


def _source_window(plan: _Plan, pixels: FloatArray, inside: AnyArray) -> Window:
    """Return the part of the picture that a block needs."""
    ends = [cv2.minMaxLoc(axis, inside)[:2] for axis in cv2.split(pixels)]
    left, top = (max(math.floor(low) - _REACH, 0) for low, _ in ends)
    right, bottom = (min(math.ceil(high) + _REACH, side) for (_, high), side in zip(ends, plan.size, strict=True))
    return Window(left, top, right - left, bottom - top)


def _reduced_shape(plan: _Plan, window: Window) -> tuple[int, int, int]:
    """Shape that a window is read at: its own, unless far more pixels are asked for than the block can show."""
    factor = max(1.0, window.width / _MAX_SOURCE, window.height / _MAX_SOURCE)
    return max(round(window.height / factor), 1), max(round(window.width / factor), 1), len(plan.bands)


def _sample(values: AnyArray, maps: AnyArray, valid: BoolArray | None, plan: _Plan) -> AnyArray:
    """Interpolate (rows, columns, bands); unknown pixels have no weight, so that they do not bleed into others."""
    drawable = values if values.dtype in _DRAWABLE else values.astype(np.float64)
    if valid is None or plan.interpolation == cv2.INTER_NEAREST:
        return _cast(_remap(drawable, maps, plan.interpolation), plan.dtype)
    valid = valid[..., None]
    weights = _remap(valid.astype(np.float32), maps, plan.interpolation)
    weighted = _remap(np.where(valid, drawable, 0).astype(np.float32), maps, plan.interpolation)
    return _cast(weighted / np.maximum(weights, 1e-3), plan.dtype)


def _remap(image: AnyArray, maps: AnyArray, interpolation: int) -> AnyArray:
    """Look up an image (rows, columns, bands) at `maps` (h, w, 2), a few bands at a time; (h, w, bands)."""
    columns, rows = cv2.split(maps)
    few = (np.ascontiguousarray(image[..., k : k + _BANDS]) for k in range(0, image.shape[2], _BANDS))
    return np.dstack([cv2.remap(part, columns, rows, interpolation, borderMode=_BORDER) for part in few])


def _cast(image: AnyArray, dtype: np.dtype[Any]) -> AnyArray:
    if image.dtype == dtype or dtype.kind == "f":
        return np.asarray(image, dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(image), limits.min, limits.max).astype(dtype)
