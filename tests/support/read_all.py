"""Read each file of the corpus with its reader, in a folder and inside a fence; what is opened is for a tracer to see.

python tests/support/read_all.py FOLDER
"""

import contextlib
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import roadgeo
from support.readers import READERS, drivers_registered_once, feed, seeds

#: They listen to, or call, a server that they start.
_LEFT_OUT = {"request", "http", "overpass", "nominatim"}
#: Once it is opened, all libraries are loaded.
BEGIN = "/roadgeo-reads-strangers-files"


def main() -> None:
    """Read one file of each reader, then all: what libraries open when they are first used is left out."""
    folder = Path(sys.argv[1])
    roadgeo.fence(read=Path(__file__).parents[2], write=folder)
    with drivers_registered_once():
        for turn in range(2):
            if turn:
                os.path.exists(BEGIN)  # noqa: PTH110 - one call of the system
            for name in sorted(READERS.keys() - _LEFT_OUT):
                for path in seeds(name)[: None if turn else 1]:
                    within = folder / f"{turn}-{name}-{path.name}"
                    within.mkdir()
                    with contextlib.suppress(AssertionError):
                        feed(READERS[name], within)(path.read_bytes())


if __name__ == "__main__":
    main()
