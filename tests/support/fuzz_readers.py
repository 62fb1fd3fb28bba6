"""Feed bytes of every kind to a reader of files from strangers; it may only read them or refuse them in a line.

    python tests/support/fuzz_readers.py READER NEW_CORPUS tests/corpus/READER -runs=100000 -max_len=20000

READER is one of those in `readers.py`. Guided by the coverage of roadgeo's own Python code (atheris, from PyPI, is
needed). Any error but roadgeo's own, and any crash, is a failure; atheris then writes the bytes to a file here.
"""

import os
import sys
import tempfile
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[1]))

with atheris.instrument_imports(include=["roadgeo"]):
    from support.readers import READERS, drivers_registered_once, feed


def main() -> None:
    """Fuzz the reader that is named first; the rest is libFuzzer's."""
    reader = READERS[sys.argv.pop(1)]
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    folder = Path(tempfile.mkdtemp(prefix="roadgeo-fuzz-", dir=memory))
    with drivers_registered_once():
        atheris.Setup(sys.argv, feed(reader, folder))
        atheris.Fuzz()


if __name__ == "__main__":
    main()
