"""The readers of what may come from strangers, each with the name that its file has when it is fuzzed.

`tests/support/fuzz_readers.py` feeds them mutants, `tests/test_corpus.py` replays what is kept in `tests/corpus`.
"""

import contextlib
import json
import os
import shutil
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import pyproj
import shapely
from starlette.exceptions import HTTPException

from roadgeo._text import read_moment
from roadgeo.cli.options import Read
from roadgeo.cli.truths import read_truths
from roadgeo.errors import RoadgeoError
from roadgeo.evaluation.truth import read_truth
from roadgeo.flights.frames import FrameOptions, _video
from roadgeo.flights.motion import read_motion
from roadgeo.geometry.projection import LocalPlane, serves_as_plane, to_lonlat
from roadgeo.matching import hints
from roadgeo.outputs.location_document import read_location
from roadgeo.reference import index_file
from roadgeo.reference.index_file import read_index
from roadgeo.reference.inspection import _describe_shards
from roadgeo.reference.network_file import read_network
from roadgeo.reference.shards import open_shards
from roadgeo.running.applying import apply_location
from roadgeo.serving.requests import ending_of, read_query_string
from roadgeo.sources.camera import estimate_gsd
from roadgeo.sources.elevation import ground_heights
from roadgeo.sources.exif import read_focal_length
from roadgeo.sources.georeference import read_georeference, read_stated
from roadgeo.sources.masks import read_mask
from roadgeo.sources.overpass import FetchOptions, fetch_lines, find_place
from roadgeo.sources.roads import read_roads
from roadgeo.sources.segmentation.card import read_card
from roadgeo.sources.segmentation.onnx_file import open_onnx
from roadgeo.sources.segmentation.photograph import find_ground, open_photograph
from roadgeo.sources.streams import stream_lines
from roadgeo.storage import vectors
from roadgeo.storage.crs import crs_name
from roadgeo.storage.memory import MEMORY
from support.untrusted_web import answered, serve_request

CORPUS = Path(__file__).parents[1] / "corpus"
#: What may be raised: our own errors, and how the command line and the server say that something makes no sense.
REFUSALS = (RoadgeoError, click.UsageError, HTTPException)


def _as_it_is(content: bytes) -> bytes:
    return content


class Reader(NamedTuple):
    """What reads the bytes, as a file of which name, beside which other files of `corpus/beside`; see also `packed`."""

    read: Callable[[Path], object]
    name: str
    beside: tuple[str, ...] = ()
    packed: Callable[[bytes], bytes] = _as_it_is


# --- rasters ----------------------------------------------------------------------------------------------------------


def with_checksums(content: bytes) -> bytes:
    """Make the checksums of a PNG agree with its chunks: else mutants get no further than to the first of them."""
    if not content.startswith(b"\x89PNG\r\n\x1a\n"):
        return content
    made, at = bytearray(content), 8
    while at + 12 <= len(made):
        end = at + 8 + int.from_bytes(made[at : at + 4], "big")
        if end + 4 > len(made):
            break
        made[end : end + 4] = zlib.crc32(made[at + 4 : end]).to_bytes(4, "big")
        at = end + 4
    return bytes(made)


def with_digests(content: bytes) -> bytes:
    """Make the digests of an index's header and pickle agree with what they are of."""
    size = int.from_bytes(content[20:24], "little")
    manifest, data = content[64 : 64 + size], content[index_file._aligned(64 + size) :]
    with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
        document = json.loads(manifest)
        document["pickle"]["digest"] = index_file._digest(data[: document["pickle"]["size"]])
        manifest = json.dumps(document).encode()
    header = index_file._header(manifest)
    return header + bytes(-len(header) % 64) + data


def read_pixels(path: Path) -> None:
    """Read a mask, and leave out what is computed from its pixels alone, which `read_values` has done."""
    read_mask(path, voids=False)


def read_mask_beside(path: Path) -> None:
    read_mask(path.with_suffix("").with_suffix(""))


def refuse_mask(path: Path) -> None:
    """Read what names other files: it must not be read."""
    if b"<VRTDataset" in path.read_bytes():
        try:
            read_mask(path)
        except RoadgeoError:
            return
        raise AssertionError("a virtual raster was read")
    read_mask(path)


_TYPES = (np.uint8, np.uint16, np.int16, np.int32, np.float32, np.float64, np.bool_)


def read_values(path: Path) -> None:
    """Take bytes for the pixels of an array, after two that say which type and how many bands it has."""
    content = path.read_bytes().ljust(10, b"\0")
    kind, bands = _TYPES[content[0] % len(_TYPES)], 1 + content[1] % 4
    values = np.frombuffer(content[2 : 2 + (len(content) - 2) // 8 * 8], kind)
    read_mask(np.resize(values, (64, 64, bands)))


def read_exif(path: Path) -> None:
    estimate_gsd(path)
    read_focal_length(path)


def read_photograph(path: Path) -> None:
    with open_photograph(path) as photograph:
        find_ground(photograph, (64, 64))
        photograph.read(0.0, 0.0, 60.0, 60.0, (40, 40))


def read_place(path: Path) -> None:
    """Read where a raster says that it lies, as all that uses it does."""
    read_stated(path)
    found = read_georeference(path, "EPSG:32629")
    if found is not None:
        found.middle()
        found.control_points()
        plane = LocalPlane("EPSG:32629", (5e5, 4.5e6))
        found.moved(found.on_plane(plane), plane)


def read_world_file(path: Path) -> None:
    read_place(path.with_name("mask.png"))


def read_terrain(path: Path) -> None:
    ground_heights(path, np.array([(500_100.0, 4_500_100.0), (0.0, 0.0)]), "EPSG:32629")


def read_frames(path: Path) -> None:
    """Take the first frames of a video."""
    with ExitStack() as stack:
        list(islice(_video(str(path), FrameOptions(), stack), 3))


def read_crs(path: Path) -> None:
    """Read a CRS and go to degrees, as it is done with one out of any file."""
    with contextlib.suppress(pyproj.exceptions.ProjError):
        name = crs_name(path.read_bytes().decode("utf-8", "replace").replace("\0", ""))
        if name is not None:
            to_lonlat(name, np.array([[5e5, 4.5e6], [-8.6, 41.1]]))
            serves_as_plane(name, np.array([[-8.6, 41.1]]))


# --- documents --------------------------------------------------------------------------------------------------------


def read_model(path: Path) -> None:
    read_card(open_onnx(path))


def read_model_beside(path: Path) -> None:
    read_model(path.with_suffix(".onnx"))


def read_truth_beside(path: Path) -> None:
    read_truth(path.with_name("local.csv"))


def read_shards(path: Path) -> None:
    open_shards(path)
    _describe_shards(path)


def apply(path: Path) -> None:
    """Read a location and, for one in fifty, put a picture there; what is written goes away again."""
    location, out = read_location(path), path.with_name("out")
    if zlib.crc32(path.read_bytes()) % 50:
        return
    out.mkdir()
    try:
        apply_location(location, [str(path.with_name("mask.png"))], out, products=("points", "geojson"), stretch=True)
    finally:
        shutil.rmtree(out, ignore_errors=True)


_HINTS = {
    b"N": Read("near", hints.read_place).convert,
    b"B": Read("box", hints.read_box).convert,
    b"R": Read("range", hints.read_range).convert,
    b"C": Read("focal", hints.HINTS["focal"].read).convert,
    b"G": Read("gsd", hints.read_gsd).convert,
    b"M": Read("time", read_moment).convert,
    b"T": lambda text, *_: read_truths(text, explain=True),
}


def read_hint(path: Path) -> None:
    """Read what is typed behind an option, after a letter for which one."""
    content = path.read_bytes()
    if content[:1] in _HINTS:
        _HINTS[content[:1]](os.fsdecode(content[1:]), None, None)


def read_request(path: Path) -> None:
    """Read the parts of a request to the server, as far as they are one."""
    content = path.read_bytes()
    for part in (lambda body: read_query_string(body.decode("latin-1")), ending_of):
        with contextlib.suppress(HTTPException):
            part(content)


def serve(path: Path) -> None:
    answer = serve_request(path.read_bytes())
    assert answer.startswith((b"HTTP/1.1 ", b"")), answer[:80]


_OPTIONS = FetchOptions("http://127.0.0.1:9/api", "http://127.0.0.1:9", cache=False)


def read_overpass(path: Path) -> None:
    with answered(path.read_bytes()):
        fetch_lines(shapely.box(-8.61, 41.14, -8.60, 41.15), "drivable", False, _OPTIONS)


def read_nominatim(path: Path) -> None:
    with answered(path.read_bytes()):
        find_place("Porto", _OPTIONS)


# --- roads ------------------------------------------------------------------------------------------------------------


def read_map(path: Path) -> None:
    """Read roads onto a plane."""
    read_roads(path, which="all", crs="EPSG:4326" if path.suffix in (".csv", ".dxf") else None)


def read_in_parts(path: Path) -> None:
    for _ in stream_lines(path, most=2):
        pass


def read_shapes(path: Path) -> None:
    read_roads(path.with_suffix(".shp"), crs="EPSG:32629")


def read_prj(path: Path) -> None:
    read_roads(path.with_suffix(".shp"))


_SHAPES = ("roads.shp", "roads.shx", "roads.dbf")

READERS = {
    "png": Reader(read_mask, "mask.png", packed=with_checksums),
    "jpeg": Reader(read_pixels, "mask.jpg"),
    "tiff": Reader(read_pixels, "mask.tif"),
    "mask": Reader(read_pixels, "mask.gif"),  # of the other formats
    "vrt": Reader(refuse_mask, "mask.vrt"),
    "sidecar": Reader(read_mask_beside, "mask.png.aux.xml", ("mask.png",)),
    "values": Reader(read_values, "values.bin"),
    "exif": Reader(read_exif, "photo.jpg"),
    "photograph": Reader(read_photograph, "photo.tif"),
    "place": Reader(read_place, "photo.tif"),
    "worldfile": Reader(read_world_file, "mask.pgw", ("mask.png",)),
    "terrain": Reader(read_terrain, "dem.tif"),
    "video": Reader(read_frames, "flight.avi"),
    "onnx": Reader(read_model, "model.onnx"),
    "stac": Reader(read_model_beside, "model.json", ("model.onnx",)),
    "index": Reader(read_index, "a.index", packed=with_digests),
    "reference": Reader(read_network, "a.gpkg"),
    "shards": Reader(read_shards, "manifest.json"),
    "crs": Reader(read_crs, "crs.txt"),
    "truth": Reader(read_truth, "truth.csv"),
    "truth_crs": Reader(read_truth_beside, "meta.json", ("local.csv",)),
    "location": Reader(apply, "mask_location.json", ("mask.png",)),
    "motion": Reader(read_motion, "motion.csv"),
    "hints": Reader(read_hint, "hint.txt"),
    "request": Reader(read_request, "body.json"),
    "http": Reader(serve, "request.txt"),
    "overpass": Reader(read_overpass, "overpass.json"),
    "nominatim": Reader(read_nominatim, "nominatim.json"),
    "geojson": Reader(read_map, "roads.geojson"),
    "parts": Reader(read_in_parts, "roads.geojson"),
    "geojsonl": Reader(read_map, "roads.geojsonl"),
    "csv": Reader(read_map, "roads.csv"),
    "dxf": Reader(read_map, "roads.dxf"),
    "zip": Reader(read_map, "roads.zip"),
    "osm_json": Reader(read_map, "roads.json"),
    "gml": Reader(read_map, "roads.gml"),
    "kml": Reader(read_map, "roads.kml"),
    "gpx": Reader(read_map, "roads.gpx"),
    "mif": Reader(read_map, "roads.mif", ("roads.mid",)),
    "tab": Reader(read_map, "roads.tab"),
    "flatgeobuf": Reader(read_map, "roads.fgb"),
    "sqlite": Reader(read_map, "roads.sqlite"),
    "osm": Reader(read_map, "roads.osm"),
    "osm_parts": Reader(read_in_parts, "roads.osm.pbf"),
    "osm_gz": Reader(read_map, "roads.osm.gz"),
    "osm_bz2": Reader(read_map, "roads.osm.bz2"),
    "pbf": Reader(read_map, "roads.osm.pbf"),
    "gpkg": Reader(read_map, "roads.gpkg"),
    "graphml": Reader(read_map, "roads.graphml"),
    "parquet": Reader(read_map, "roads.parquet"),
    "shp": Reader(read_shapes, "roads.shp", _SHAPES),
    "prj": Reader(read_prj, "roads.prj", _SHAPES),
    "shx": Reader(read_shapes, "roads.shx", _SHAPES),
    "dbf": Reader(read_shapes, "roads.dbf", _SHAPES),
}


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def feed(reader: Reader, folder: Path) -> Callable[[bytes], None]:
    """Return what has bytes read as a file in a folder: they may be read, or refused in one line; nothing is left."""
    for name in reader.beside:
        (folder / name).write_bytes((CORPUS / "beside" / name).read_bytes())
    path, there = folder / reader.name, {reader.name, *reader.beside, *_names(folder)}

    def one(content: bytes) -> None:
        path.write_bytes(reader.packed(content))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reader.read(path)
        except REFUSALS as error:
            if "\n" in str(error):
                raise AssertionError("more than a line") from error
        left = _names(folder) - there
        assert not left, f"left behind: {left}"

    return one


@contextmanager
def drivers_registered_once() -> Iterator[None]:
    """Leave GDAL's few drivers registered between files: registering them takes longer than most files do.

    And bound the memory that each file takes, as inside a fence.
    """
    os.environ[MEMORY] = "1"
    try:
        with vectors.few_drivers():
            yield
    finally:
        del os.environ[MEMORY]


def seeds(name: str) -> list[Path]:
    """Files of the corpus for one reader."""
    return sorted(path for path in (CORPUS / name).iterdir() if path.is_file())
