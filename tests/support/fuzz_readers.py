"""Feed bytes of every kind to a reader of files from strangers; it may only read them or refuse them in a line.

    python tests/support/fuzz_readers.py READER [CORPUS] -runs=100000 -max_len=20000

READER is one of those below. Guided by the coverage of roadgeo's own Python code (atheris, from PyPI, is needed). Any
error but roadgeo's own, and any crash, is a failure; atheris then writes the bytes to a file here.
"""

import os
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["roadgeo"]):
    from roadgeo.errors import RoadgeoError
    from roadgeo.reference.index_file import read_index
    from roadgeo.reference.network_file import read_network
    from roadgeo.sources.lines import read_lines
    from roadgeo.sources.masks import read_mask

#: What reads the bytes, as a file of which name.
READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "mask": (read_mask, "mask.png"),
    "index": (read_index, "a.index"),
    "reference": (read_network, "a.gpkg"),
    "geojson": (read_lines, "roads.geojson"),
    "osm": (read_lines, "roads.osm"),
    "pbf": (read_lines, "roads.osm.pbf"),
    "gpkg": (read_lines, "roads.gpkg"),
    "graphml": (read_lines, "roads.graphml"),
    "parquet": (read_lines, "roads.parquet"),
}


def main() -> None:
    """Fuzz the reader that is named first; the rest is libFuzzer's."""
    read, name = READERS[sys.argv.pop(1)]
    warnings.simplefilter("ignore")
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    path = Path(tempfile.mkdtemp(prefix="roadgeo-fuzz-", dir=memory)) / name

    def one(content: bytes) -> None:
        path.write_bytes(content)
        try:
            read(path)
        except RoadgeoError as error:
            if "\n" in str(error):
                raise AssertionError("more than a line") from error

    atheris.Setup(sys.argv, one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
