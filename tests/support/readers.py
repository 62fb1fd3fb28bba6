"""The readers of files that may come from strangers, each with the name that its file has when it is fuzzed.

`tests/support/fuzz_readers.py` feeds them mutants, `tests/test_corpus.py` replays what is kept in `tests/corpus`.
"""

import contextlib
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from roadgeo.errors import RoadgeoError
from roadgeo.evaluation.truth import read_truth
from roadgeo.reference.index_file import read_index
from roadgeo.reference.network_file import read_network
from roadgeo.sources import vectors
from roadgeo.sources.exif import estimate_gsd, read_focal_length
from roadgeo.sources.lines import read_lines
from roadgeo.sources.masks import read_mask
from roadgeo.sources.segmentation.card import read_card
from roadgeo.sources.segmentation.onnx_file import read_onnx

CORPUS = Path(__file__).parents[1] / "corpus"


class Reader(NamedTuple):
    """What reads the bytes, as a file of which name, beside which other files of `corpus/beside`."""

    read: Callable[[Path], object]
    name: str
    beside: tuple[str, ...] = ()


def read_exif(path: Path) -> None:
    estimate_gsd(path)
    read_focal_length(path)


def read_model(path: Path) -> None:
    read_card(read_onnx(path), path)


def read_mask_beside(path: Path) -> None:
    read_mask(path.with_suffix("").with_suffix(""))


def read_model_beside(path: Path) -> None:
    read_model(path.with_suffix(".onnx"))


def read_shapes(path: Path) -> None:
    read_lines(path.with_suffix(".shp"))


_SHAPES = ("roads.shp", "roads.shx", "roads.dbf")

READERS = {
    "mask": Reader(read_mask, "mask.png"),
    "sidecar": Reader(read_mask_beside, "mask.png.aux.xml", ("mask.png",)),
    "exif": Reader(read_exif, "photo.jpg"),
    "onnx": Reader(read_model, "model.onnx"),
    "stac": Reader(read_model_beside, "model.json", ("model.onnx",)),
    "index": Reader(read_index, "a.index"),
    "reference": Reader(read_network, "a.gpkg"),
    "truth": Reader(read_truth, "truth.csv"),
    "geojson": Reader(read_lines, "roads.geojson"),
    "osm": Reader(read_lines, "roads.osm"),
    "pbf": Reader(read_lines, "roads.osm.pbf"),
    "gpkg": Reader(read_lines, "roads.gpkg"),
    "graphml": Reader(read_lines, "roads.graphml"),
    "parquet": Reader(read_lines, "roads.parquet"),
    "shp": Reader(read_shapes, "roads.shp", _SHAPES),
    "shx": Reader(read_shapes, "roads.shx", _SHAPES),
    "dbf": Reader(read_shapes, "roads.dbf", _SHAPES),
}


def feed(reader: Reader, folder: Path) -> Callable[[bytes], None]:
    """Return what has bytes read as a file in a folder: they may be read, or refused in one line."""
    for name in reader.beside:
        (folder / name).write_bytes((CORPUS / "beside" / name).read_bytes())
    path = folder / reader.name

    def one(content: bytes) -> None:
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reader.read(path)
        except RoadgeoError as error:
            if "\n" in str(error):
                raise AssertionError("more than a line") from error

    return one


@contextmanager
def drivers_registered_once() -> Iterator[None]:
    """Leave GDAL's few drivers registered between files: registering them takes longer than most files do."""
    with vectors._few_drivers():
        vectors._few_drivers, kept = contextlib.nullcontext, vectors._few_drivers
        try:
            yield
        finally:
            vectors._few_drivers = kept


def seeds(name: str) -> list[Path]:
    """Files of the corpus for one reader."""
    return sorted(path for path in (CORPUS / name).iterdir() if path.is_file())
