"""Files that fuzzing started from, and those that it broke readers with: each is read, or refused in one line."""

from pathlib import Path

import pytest
from support.readers import READERS, drivers_registered_once, feed, seeds

FILES = [(name, path) for name in READERS for path in seeds(name)]


@pytest.fixture(scope="module", autouse=True)
def _gdal():
    with drivers_registered_once():
        yield


@pytest.mark.parametrize(("name", "path"), FILES, ids=lambda item: item.name if isinstance(item, Path) else item)
def test_each_is_read_or_refused(name: str, path: Path, tmp_path: Path) -> None:
    feed(READERS[name], tmp_path)(path.read_bytes())


def test_every_reader_has_a_file() -> None:
    assert {name for name, _ in FILES} == READERS.keys()
