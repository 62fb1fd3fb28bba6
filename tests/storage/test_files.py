import os
from pathlib import Path

import pytest

from roadgeo.errors import OutputError
from roadgeo.storage.files import replacing, write_text


def test_the_old_file_stands_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_text(path, "old")

    def fail_halfway() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            assert temporary.suffix == ".json"
            assert path.read_text() == "old"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail_halfway()
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    assert path.read_text() == "old"
    write_text(path, "new\n")
    assert path.read_bytes() == b"new\n"


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"cannot write .*nowhere"):
        write_text(tmp_path / "nowhere" / "a.json", "")


def test_unfinished_files_of_writers_that_were_killed_are_removed(tmp_path: Path) -> None:
    old, fresh, other = (tmp_path / name for name in (".a.12.part.gpkg", ".a.13.part.gpkg", ".a.part.gpkg"))
    for path in (old, fresh, other):
        path.touch()
    for path in (old, other):
        os.utime(path, (0, 0))
    write_text(tmp_path / "a.json", "{}")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a.13.part.gpkg", ".a.part.gpkg", "a.json"]
