"""The one place that opens rasters of strangers.

The driver follows from the file's first bytes and is the only one that GDAL may use. Files beside the file, its
overviews elsewhere, and the network are left alone (`storage.gdal`). A GDAL virtual raster names other files, and is
opened only inside the fence (`storage.fence`), or where the user allows it. Pictures that are to be turned are turned
here (`storage.orientation`). Rasterio is imported only here and late: it takes longer than to read a mask.
"""

from __future__ import annotations

import contextlib
import html
import os
import re
import shutil
import stat
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.errors import MaskError, OutputError
from roadgeo.storage.fence import is_inside, remedy
from roadgeo.storage.gdal import CONSENT, NETWORK, SEALED, allowed_drivers
from roadgeo.storage.memory import bounded
from roadgeo.storage.orientation import (
    UPRIGHT,
    read_orientation,
    stored_from_upright,
    tiff_pages,
    tiff_values,
    turn_upright,
)
from roadgeo.storage.tables import decode

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = [
    "MAX_SIDE",
    "RAW",
    "count_frames",
    "is_raster",
    "name_page",
    "open_array",
    "open_raster",
    "page_of",
    "pages_of",
    "raster_size",
    "read_beside",
    "read_palette",
    "read_sidecar",
    "require_file",
    "require_there",
    "sidecar_attributes",
    "sidecar_nodata",
    "value_bands",
    "writing_raster",
]

#: Pixels, of the largest raster that anything is read of: a photograph.
MAX_SIDE = 60_000

#: An axis of an array no longer than this holds bands: a mask has at least 32 rows and columns.
_MAX_BANDS = 16

#: First bytes of the formats that are read, and GDAL's names of their drivers, where it has one; others become arrays.
_DRIVERS = (
    (rb"\x93NUMPY", "NumPy"),
    (rb"P[1-47]\s|P[Ff]\s", "OpenCV"),
    (rb"II[*+]\0|MM\0[*+]", "GTiff"),
    (rb"\x89PNG\r\n\x1a\n", "PNG"),
    (rb"\xff\xd8\xff", "JPEG"),
    (rb"BM", "BMP"),
    (rb"RIFF....WEBP", "WEBP"),
    (rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51", "JP2OpenJPEG"),
    (rb"P[56]\s", "PNM"),
    (rb"GIF8[79]a", "GIF"),
    (rb"EHFA_HEADER_TAG", "HFA"),
    (rb"\s*(<\?xml[^>]*>\s*)?<VRTDataset", "VRT"),
)
#: Drivers that write our results, from the pixels of others.
_WRITTEN = ("MEM", "COG")
_NAMES = "GeoTIFF, PNG, JPEG, JPEG 2000, WebP, BMP, PNM, GIF, Erdas Imagine, .npy"

_CACHE_BYTES = 256 << 20  # of decoded blocks; GDAL's own is a twentieth of the machine's memory
_HEAD_BYTES = 8192
_LITTLE_SPACE = 8 << 20

#: Endings of raw photographs, and tags of TIFF by which they are known: GDAL reads only their thumbnail.
RAW = (".dng", ".nef", ".cr2", ".cr3", ".arw", ".orf", ".raf", ".rw2", ".pef", ".srw")
_DNG_VERSION, _SUB_IFDS, _SUBFILE_TYPE, _OLD_SUBFILE_TYPE = 50706, 330, 254, 255
_IN_PART = 0b101  # bits of a type: a reduced picture, a mask of transparency
_CANON = b"CR"  # at byte 8
_PAGE = re.compile(r"GTIFF_DIR:(\d+):(.+)", re.DOTALL)  # GDAL's name of a page
_BREAKS_OFF = re.compile(r"IReadBlock failed|Premature end|DGifSlurp|Failed to read directory at")  # GDAL's words
_STILL = re.compile(rb"(?s)....ftyp(?:hei|hev|mif1|msf1|avi)")  # HEIC and AVIF
_FRAMES = re.compile(rb"(?s)\x89PNG(?:(?!IDAT).)*acTL(....)")  # their number, in an animated PNG
_BOXES_OF_BOXES = (b"jp2h", b"res ", b"asoc", b"jpch", b"jplh")  # of JPEG 2000


@contextmanager
def open_raster(
    path: str | os.PathLike[str], name: str | None = None, *, is_ours: bool = False, upright: bool = True
) -> Iterator[DatasetReader]:
    """Open a raster that may lack a georeference; errors while it is open are raised like errors of opening it.

    One that is to be turned (see `storage.orientation`) is turned, and its georeference with it: in memory, by another
    driver. Rasters to be written meanwhile are opened with `writing_raster`.

    Parameters
    ----------
    path : path
        A regular file, a page of one (see `name_page`), or a name in a GDAL file system (/vsizip/, /vsicurl/, ...) that
        the user typed.
    name : str, optional
        Name for messages.
    is_ours : bool
        We wrote it just now: it may be a virtual raster.
    upright : bool
        False: as it is stored.

    Raises
    ------
    MaskError
        It is missing, no regular file, of a format that is not read, damaged, too large to be turned, or refers to
        other files.
    """
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    name = name or os.fspath(path)
    remote = _is_remote(path)
    page = _PAGE.fullmatch(os.fspath(path)) if isinstance(path, str) else None
    path = page[2] if page else path
    if remote:
        drivers = allowed_drivers() + [driver for _, driver in _DRIVERS[2:-1]]
    else:
        require_file(path, name)
        drivers = _drivers(Path(path), name, allowed_drivers() + ["VRT"] * is_ours)
        if drivers == ["JP2OpenJPEG"]:
            _require_boxes(Path(path), name)
        if drivers == ["PNG"]:
            _require_chunks(Path(path), name)
        if page and drivers != ["GTiff"]:
            raise MaskError(f"{name}: holds no pages; only TIFFs do: leave --page out")
        if not page and drivers == ["GTiff"]:
            page = _PAGE.fullmatch(pages_of(path)[0].removeprefix("GTIFF_DIR:1:"))
    if drivers[0] in ("NumPy", "OpenCV"):
        with open_array(_read_array(path, name), name) as dataset:
            yield dataset
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            # Absolute, for a name may look like the text of a virtual raster, which GDAL takes in place of a path.
            where = os.fspath(path) if remote else str(Path(path).absolute())
            # What a virtual raster of a stranger names is read inside the fence, but not fetched.
            may_fetch = remote or (drivers == ["VRT"] and (is_ours or "VRT" in allowed_drivers()))
            with _opened(f"GTIFF_DIR:{page[1]}:{where}" if page else where, drivers, may_fetch) as dataset:
                if dataset.tags(ns="OVERVIEWS"):
                    raise MaskError(
                        f"{name}: names a file elsewhere as its overviews; remove that (gdal_edit.py -unsetmd)"
                    )
                orientation = _orientation(dataset, path, remote) if upright else UPRIGHT
                if orientation == UPRIGHT:
                    yield dataset
                else:
                    with _turned(dataset, orientation) as turned:
                        yield turned
        except UnicodeEncodeError as error:
            raise MaskError(f"{name}: its name is not valid text; rename it") from error
        except UnicodeDecodeError as error:
            raise MaskError(f"{name}: its metadata are not valid text; save it without them") from error
        except (RasterioError, CPLE_BaseError) as error:
            reason = " ".join(str(error.__cause__ or error).split())[:300]  # libtiff's own words, where it has some
            remedied = remedy(reason) or "; give an image or GeoTIFF"
            if _BREAKS_OFF.search(reason):
                raise MaskError(f"{name}: damaged or cut short; copy or export it again") from error
            raise MaskError(f"{name}: not a raster that can be read ({reason}){remedied}") from error


def raster_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Return (width, height) of an upright raster, without turning it.

    Raises
    ------
    MaskError
        As of `open_raster`.
    """
    with open_raster(path, upright=False) as dataset:
        orientation = _orientation(dataset, path, _is_remote(path))
        width, height = dataset.width, dataset.height
    return (width, height) if orientation < 5 else (height, width)


@contextmanager
def writing_raster(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn an error of GDAL in the block, which writes `path`, into one line, also where another raster is open.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import CRSError, RasterioError

    try:
        yield
    except (RasterioError, CPLE_BaseError, CRSError) as error:
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        raise OutputError(f"cannot write {os.fspath(path)}: {reason}{_likely_cause(reason, Path(path))}") from error


def _likely_cause(reason: str, path: Path) -> str:
    """Return the likely cause of an error of GDAL's, where there is evidence for one."""
    if "proj.db" in reason:
        return "; PROJ's data are missing: unset PROJ_DATA and PROJ_LIB, or install rasterio again"
    with contextlib.suppress(OSError):
        free = shutil.disk_usage(path.parent).free
        if free < _LITTLE_SPACE:
            return f"; the disk is full: {free / 1e6:.0f} MB are left"
    if re.search(r"read|decod|corrupt|premature|truncat", reason, re.IGNORECASE):
        return "; is the picture damaged?"
    if re.search(r"\bwrit|space|quota|file too large", reason, re.IGNORECASE):
        return "; is the disk full?"
    return ""


def _is_remote(path: str | os.PathLike[str]) -> bool:
    """Whether the user typed a GDAL file system (/vsicurl/, /vsizip/, ...): then its network is wanted."""
    return os.fspath(path).startswith("/vsi") and not Path(path).exists()


def require_there(path: str) -> None:
    """Raise `MaskError` where the file of a picture, or of a page of one, is missing; what is remote may be there."""
    if not _is_remote(path):
        require_file(_file_of(path), path)


def _file_of(name: str) -> str:
    """Return the path of a raster's file, of which this may be a page."""
    page = _PAGE.fullmatch(name)
    return page[2] if page else name


def require_file(path: str | os.PathLike[str], name: str) -> None:
    """Raise `MaskError` unless there is a regular file: a pipe may never end, a device may do anything."""
    try:
        mode = os.stat(path).st_mode  # noqa: PTH116 (names may hold what Path refuses)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MaskError(f"{name}: no such file; check the path") from error
    except (OSError, ValueError) as error:
        raise MaskError(f"{name}: cannot be read ({error}); check the path and its permissions") from error
    if stat.S_ISDIR(mode):
        raise MaskError(f"{name}: is a folder; give a raster file")
    if not stat.S_ISREG(mode):
        raise MaskError(f"{name}: is a pipe or device; expected a regular file: save the raster first")


def read_palette(dataset: DatasetReader, band: int = 1, channels: int = 3) -> AnyArray | None:
    """Return the colours that the values of a band stand for, (256, 3) RGB or (256, 4) RGBA; None where they do not."""
    if dataset.colorinterp[band - 1].name != "palette":
        return None
    colors = dataset.colormap(band)
    return np.array([colors.get(i, (0, 0, 0, 255))[:channels] for i in range(256)], np.uint8)


def value_bands(dataset: DatasetReader) -> list[int]:
    """Return the numbers of all bands but transparency; of a GIF, where each is a picture, the first."""
    if dataset.driver == "GIF":
        return [1]
    return [i for i, color in zip(dataset.indexes, dataset.colorinterp, strict=True) if color.name != "alpha"]


def sidecar_nodata(path: str | os.PathLike[str]) -> float | None:
    """Return the nodata value in the `.aux.xml` beside a raster."""
    try:
        return float(read_sidecar(path, "NoDataValue"))
    except ValueError:
        return None


def read_sidecar(path: str | os.PathLike[str], name: str) -> str:
    """Return the text of an element in the `.aux.xml` beside a raster; "" without one. No more is taken of it."""
    match = re.search(rf"<{name}\b[^<>]*+>([^<]++)</", _sidecar(path))
    return html.unescape(match[1]).strip() if match else ""


def sidecar_attributes(path: str | os.PathLike[str], name: str) -> list[dict[str, str]]:
    """Return the attributes of each element of a name in the `.aux.xml` beside a raster."""
    elements = re.findall(rf"<{name}\b([^<>]*+)", _sidecar(path))
    stated = (re.findall(r'(\w++)="([^"]*+)"', element) for element in elements)
    return [{key: html.unescape(value) for key, value in pairs} for pairs in stated]


def _sidecar(path: str | os.PathLike[str]) -> str:
    return read_beside(path, Path(os.fspath(path) + ".aux.xml"))


def read_beside(path: str | os.PathLike[str], beside: Path) -> str:
    """Return the text of a file beside a raster; "" without one.

    Raises
    ------
    MaskError
        It takes too much memory.
    """
    with bounded(path, MaskError):
        return decode(beside.read_bytes(), "replace") if beside.is_file() else ""


#: Suffixes of images, which no text has.
_IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".jp2", ".bmp", ".gif"}


def is_raster(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins as a picture, of a format that is read here or as phones take them."""
    with open(path, "rb") as file:  # noqa: PTH123 (names may hold what Path refuses)
        head = file.read(_HEAD_BYTES)
    return _driver_of(head) is not None or _STILL.match(head) is not None


def _driver_of(head: bytes) -> str | None:
    """Return the driver for a file that begins so."""
    return next((driver for magic, driver in _DRIVERS if re.match(magic, head, re.DOTALL)), None)


def _drivers(path: Path, name: str, more: list[str]) -> list[str]:
    """Name the drivers that may read a file: the one of its first bytes, or those that the user allows besides."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise MaskError(f"{name}: is empty; copy or export it again")
    driver = _driver_of(head)
    if driver == "VRT" and "VRT" not in more and not is_inside():
        raise MaskError(
            f"{name}: a GDAL virtual raster, which names other files to read: give those, "
            f"or set {CONSENT}=VRT if you trust it"
        )
    if path.suffix.lower() in RAW or (driver == "GTiff" and _is_raw(path, head)):
        raise MaskError(
            f"{name}: a raw photograph ({path.suffix.lower()}), of which only a thumbnail could be read; develop it: "
            "save it as JPEG or TIFF"
        )
    if driver == "WEBP" and head[12:16] == b"VP8X" and head[20] & 2:
        raise MaskError(f"{name}: an animated WebP, which is not read; save its pictures, or an animated GIF or PNG")
    if driver is None and not more and Path(name).suffix.lower() == ".npz":
        raise MaskError(f"{name}: an archive of arrays; save the one that is the mask with numpy.save")
    if driver is None and not more:
        if Path(name).suffix.lower() in _IMAGES and head and not re.search(rb"[^\t\n\f\r -\x7e\x80-\xff]", head):
            raise MaskError(
                f"{name}: is text, whatever its name says; expected an image of a format that is read ({_NAMES})"
            )
        if _STILL.match(head):
            raise MaskError(f"{name}: a picture in HEIC or AVIF, which is not read; save it as JPEG or TIFF")
        raise MaskError(
            f"{name}: not a raster of a format that is read here ({_NAMES}); convert it to GeoTIFF (of a video "
            f"`roadgeo track` takes frames), or name GDAL's driver for it, if you trust the file: {CONSENT}=netCDF"
        )
    return [driver] if driver else more


def _is_raw(path: Path, head: bytes) -> bool:
    """Whether a TIFF is a camera's raw photograph, whatever its name: its first picture is a thumbnail."""
    with path.open("rb") as file, contextlib.suppress(struct.error):
        kind, subs, version = (
            next(tiff_values(file, 0, tag), None) for tag in (_SUBFILE_TYPE, _SUB_IFDS, _DNG_VERSION)
        )
        is_thumbnail = kind is not None and int.from_bytes(kind[1][:4], "little" if kind[2] == "<" else "big") & 1
        return head[8:10] == _CANON or version is not None or bool(is_thumbnail and subs)
    return False


def _whole_pages(path: Path) -> list[int]:
    """Return the pages of a TIFF, counted from 1, that are neither reduced pictures nor masks; none of another file."""
    with path.open("rb") as file, contextlib.suppress(struct.error):
        if _driver_of(file.read(_HEAD_BYTES)) != "GTiff":
            return []
        kinds = list(zip(*(tiff_pages(file, tag) for tag in (_SUBFILE_TYPE, _OLD_SUBFILE_TYPE)), strict=False))
        return [number for number, (kind, old) in enumerate(kinds, 1) if not (kind & _IN_PART or old == 2)]
    return []


def name_page(path: str, page: int | None) -> str:
    """Return the name by which a page of a TIFF, counted from 1, is opened; without one the path itself."""
    return path if page is None or _PAGE.fullmatch(path) else f"GTIFF_DIR:{page}:{Path(path).absolute()}"


def pages_of(path: str | os.PathLike[str]) -> list[str]:
    """Return the names by which the pages of a TIFF are opened, but for reduced pictures and masks; else the path."""
    name = os.fspath(path)
    if _is_remote(path):
        with open_raster(path, upright=False) as dataset:
            return [page for page in dataset.subdatasets if _PAGE.fullmatch(page)] or [name]
    numbers = [] if _PAGE.fullmatch(name) else _whole_pages(Path(path))
    return [name] if numbers in ([], [1]) else [name_page(name, number) for number in numbers]


def count_frames(path: str | os.PathLike[str]) -> int:
    """Return of how many pictures an animation consists, GIF or PNG; 1 of other files."""
    if _is_remote(path) or _PAGE.fullmatch(os.fspath(path)):
        return 1
    with open(path, "rb") as file:  # noqa: PTH123 (names may hold what Path refuses)
        head = file.read(_HEAD_BYTES)
    if head.startswith(b"GIF8"):
        with open_raster(path) as dataset:
            return int(dataset.count)
    stated = _FRAMES.match(head)
    return int.from_bytes(stated[1], "big") if stated else 1


def page_of(path: str | os.PathLike[str]) -> str:
    """Return which picture of a file with several is read, for people: "page 1 of 2"; "" where it has one."""
    pages, frames = [_PAGE.fullmatch(name) for name in pages_of(path)], count_frames(path)
    first, last = pages[0], pages[-1]
    if first and last:
        return f"page {first[1]}" + f" of {last[1]}" * (first != last)
    return f"picture 1 of {frames}" if frames > 1 else ""


def _require_boxes(path: Path, name: str) -> None:
    """Refuse a JPEG 2000 whose boxes do not lie within each other: one in a header without an end, GDAL reads forever.

    ISO/IEC 15444-1, I.4: four bytes of size, four of kind; size 1 means that eight more bytes hold it, 0 that the box
    reaches to the end of the file, which only the last may.
    """
    with path.open("rb") as file:
        if file.read(8)[4:] != b"jP  ":
            return
        within = [(0, path.stat().st_size)]
        while within:
            at, end = within.pop()
            while at + 8 <= end:
                file.seek(at)
                size, kind, large = struct.unpack(">I4sQ", file.read(16).ljust(16, b"\0"))
                size, head = (large, 16) if size == 1 else (size, 8)
                if size == 0 and end == path.stat().st_size and kind not in _BOXES_OF_BOXES:
                    break
                if not head <= size <= end - at:
                    raise MaskError(f"{name}: a JPEG 2000 that is damaged or cut short; copy or export it again")
                within += [(at + head, at + size)] * (kind in _BOXES_OF_BOXES)
                at += size


def _require_chunks(path: Path, name: str) -> None:
    """Refuse a PNG whose chunks do not lie within it, the last of them too: GDAL reads what is missing as black."""
    with path.open("rb") as file:
        at, end, kind = file.seek(8), path.stat().st_size, b""
        while kind != b"IEND" and at <= end:
            size, kind = struct.unpack(">I4s", file.read(8).ljust(8, b"\0"))
            at = file.seek(at + 12 + size)
        if at > end:
            raise MaskError(f"{name}: a PNG that is damaged or cut short; copy or export it again")


@contextmanager
def _opened(path: str, drivers: list[str], may_fetch: bool) -> Iterator[DatasetReader]:
    """Open a dataset with the first of some drivers that takes it."""
    import rasterio
    from rasterio.errors import RasterioIOError

    if drivers == ["VRT"] and is_inside():
        _keep_few_drivers()
    with rasterio.Env(
        GDAL_CACHEMAX=_CACHE_BYTES,
        **{key: value for key, value in SEALED.items() if not (may_fetch and key in NETWORK)},
    ):
        for last, driver in enumerate(drivers, 1 - len(drivers)):
            try:
                dataset = _reader()(path, driver=driver)
            except RasterioIOError:
                if last == 0:
                    raise
                continue
            with dataset:
                yield dataset
            return


@cache
def _reader() -> type[DatasetReader]:
    """Return rasterio's class of open rasters, which opens and reads them within the bound on memory."""
    from rasterio import DatasetReader

    def within(act: Callable[..., Any]) -> Callable[..., Any]:
        def bounded_act(raster: DatasetReader, *args: Any, **kwargs: Any) -> Any:
            name = str(args[0]) if act is DatasetReader.__init__ else raster.name
            with bounded(_file_of(name), MaskError):
                return act(raster, *args, **kwargs)

        return bounded_act

    acts = ("__init__", "read", "read_masks", "dataset_mask")
    return type("BoundedReader", (DatasetReader,), {name: within(getattr(DatasetReader, name)) for name in acts})


@cache
def _keep_few_drivers() -> None:
    """Have rasterio's GDAL forget all drivers but those above, whatever build it is: for what a virtual raster names.

    It is for good, as the fence is. GDAL reads which drivers to leave out when it registers them. rasterio registers
    them once in a process and has no public way to do so again, hence its private flag.
    """
    from rasterio import _env

    env = _env.GDALEnv()
    skipped = ""
    for _ in range(2):  # all are registered, and then the others left out
        env.update_config_options(GDAL_SKIP=f"{skipped},")
        _env._have_registered_drivers = False
        env.start()
        kept = {*_WRITTEN, *allowed_drivers(), *(driver for _, driver in _DRIVERS)}
        skipped = ",".join(env.drivers().keys() - kept)
        env.stop()
    env.clear_config_options()


@contextmanager
def open_array(array: AnyArray, name: str, labels: Sequence[str] = ()) -> Iterator[DatasetReader]:
    """Copy an array into memory as a raster: (H, W), or with bands, which may have labels, first or last.

    Raises
    ------
    MaskError
        It has another shape, holds no numbers, or takes too much memory.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    values, hidden = (_bands_first(part) for part in (np.ma.getdata(array), np.ma.getmaskarray(array)))
    if values is None or values.dtype.kind not in "biuf":
        raise MaskError(
            f"{name}: an array of {array.dtype} of shape {array.shape}; expected (rows, columns) of real "
            "numbers or booleans, with bands first or last"
        )
    kind = "uint8" if values.dtype.kind == "b" else "float32" if values.dtype == np.float16 else values.dtype.name
    kind = "float64" if values.dtype.kind == "f" and values.dtype.itemsize > 8 else kind
    count, height, width = values.shape
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with bounded(name, MaskError):
            kept = rasterio.open("", "w+", driver="MEM", count=count, height=height, width=width, dtype=kind)
            raster = stack.enter_context(kept)
            for band in range(count):
                raster.write(np.asarray(values[band], kind), band + 1)
            if hidden is not None and hidden.any():
                raster.write_mask(~hidden.any(axis=0))
        if len(labels) == count:
            raster.descriptions = labels
        raster.transform = rasterio.Affine.identity()
        yield raster


def _read_array(path: str | os.PathLike[str], name: str) -> AnyArray:
    """Read the array of a file of NumPy's, or what GDAL does not read of the family of PNM."""
    try:
        with bounded(path, MaskError), open(path, "rb") as file:  # noqa: PTH123 (names may hold what Path refuses)
            if file.read(1) != b"P":
                return np.lib.format.open_memmap(path, mode="r")  # unpickles nothing
            file.seek(0)
            stored = np.frombuffer(file.read() + b"\n", np.uint8)  # OpenCV has the last number end
            array = cv2.imdecode(stored, cv2.IMREAD_UNCHANGED)
    except (ValueError, OSError, OverflowError, SyntaxError, TypeError, EOFError) as error:
        reason = " ".join(str(error).split())[:200]
        raise MaskError(f"{name}: no array that can be read ({reason}); expected numbers") from error
    if array is None:
        raise MaskError(f"{name}: damaged or cut short; copy or export it again")
    return array if array.ndim == 2 else array[..., 2::-1]  # blue comes first


def _bands_first(array: AnyArray) -> AnyArray | None:
    """Return an array as (bands, H, W), of which the short axis holds the bands; None of another shape."""
    if array.ndim == 2 and array.size:
        return array[None]
    if array.ndim != 3 or not array.size:
        return None
    return array if array.shape[0] <= _MAX_BANDS < array.shape[2] or array.shape[0] == 1 else np.moveaxis(array, 2, 0)


def _orientation(dataset: DatasetReader, path: str | os.PathLike[str], remote: bool) -> int:
    """Return the orientation of a raster; for a remote one GDAL reports it, of JPEGs alone."""
    if not remote:
        return read_orientation(path)
    stated = dataset.tags().get("EXIF_Orientation", "")
    return int(stated) if stated in list("12345678") else UPRIGHT


@contextmanager
def _turned(dataset: DatasetReader, orientation: int) -> Iterator[DatasetReader]:
    """Make an upright copy of a raster in memory, with all its metadata."""
    import rasterio
    from rasterio.control import GroundControlPoint
    from rasterio.enums import ColorInterp, MaskFlags

    height, width = dataset.shape if orientation < 5 else dataset.shape[::-1]
    matrix = stored_from_upright(orientation, (width, height))
    profile = {"count": dataset.count, "dtype": np.result_type(*dataset.dtypes), "nodata": dataset.nodata}
    with ExitStack() as stack:
        with bounded(_file_of(dataset.name), MaskError):
            copy = stack.enter_context(rasterio.open("", "w+", driver="MEM", width=width, height=height, **profile))
            for band in dataset.indexes:
                copy.write(turn_upright(dataset.read(band), orientation), band)
        copy.colorinterp, copy.descriptions = dataset.colorinterp, dataset.descriptions
        if dataset.colorinterp[0] == ColorInterp.palette:
            copy.write_colormap(1, dataset.colormap(1))
        if dataset.mask_flag_enums[0] == [MaskFlags.per_dataset]:
            copy.write_mask(turn_upright(dataset.read_masks(1), orientation) > 0)
        for namespace in (None, "EXIF", "xml:XMP"):
            tags = {key: value for key, value in dataset.tags(ns=namespace).items() if key != "EXIF_Orientation"}
            copy.update_tags(ns=namespace, **tags)
        points, crs = dataset.gcps
        if points:
            there = (np.array([(p.col, p.row, 1.0) for p in points]) @ np.linalg.inv(matrix).T).tolist()
            turned = [GroundControlPoint(q[1], q[0], p.x, p.y, p.z) for p, q in zip(points, there, strict=True)]
            copy.gcps = turned, crs
        placed = np.array(dataset.transform, float).reshape(3, 3) @ matrix
        copy.transform = rasterio.Affine(*(np.eye(3) if dataset.transform.is_identity else placed)[:2].ravel())
        if dataset.crs:
            copy.crs = dataset.crs
        yield copy
