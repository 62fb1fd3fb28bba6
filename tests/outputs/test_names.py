"""What is given away does not show the folders of whoever made it."""

import json
import zipfile
from pathlib import Path

import cv2
import pytest
import rasterio
from worlds.demo import DRONE

from roadgeo._text import in_html
from roadgeo.cli import main
from roadgeo.outputs.names import bare_command, bare_name, bare_names, table_text, without_folders
from roadgeo.outputs.registry import ALSO


@pytest.mark.parametrize(
    ("path", "name"),
    [("/home/me/a.png", "a.png"), (r"C:\Users\me\a.png", "a.png"), ("a.png", "a.png"), ("maps/", "maps"), ("", "")],
)
def test_bare_names(path: str, name: str) -> None:
    assert bare_name(path) == name


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["/home/me/a/1.png", "/home/me/b/1.png", "/tmp/2.png"], ["a/1.png", "b/1.png", "2.png"]),
        (["/home/me/1.png", "/home/me/b/1.png"], ["1.png", "b/1.png"]),
        (["x/1.png", "1.png"], ["x/1.png", "1.png"]),
        (["/home/me/1.png", "1.png"], ["1.png", "1.png"]),
        ([], []),
    ],
)
def test_names_that_are_shared_keep_the_folders_in_which_they_differ(paths: list[str], names: list[str]) -> None:
    assert bare_names(paths) == names


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("/home/me/a.png: is empty", "a.png: is empty"),
        ("my own/a.png: is empty", "a.png: is empty"),
        (r"cannot write C:\Users\me\a.tif: full", "cannot write a.tif: full"),
        ("see https://example.org/a/b and 3/4", "see https://example.org/a/b and 3/4"),
    ],
)
def test_sentences_without_folders(text: str, left: str) -> None:
    assert without_folders(text, "my own/a.png") == left


def test_a_command_without_folders() -> None:
    command = "roadgeo locate '/home/me/my photo.png' -r /maps/porto.gpkg --near -8.6,41.1,500 --dem=../h.tif -q"
    assert bare_command(command) == "roadgeo locate 'my photo.png' -r porto.gpkg --near -8.6,41.1,500 --dem=h.tif -q"
    assert bare_command("roadgeo '/home/me") == "roadgeo 'me"


def test_no_file_shows_the_folders_of_whoever_made_it(
    porto: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Paths as they were typed stand in the JSON beside the others alone."""
    (tmp_path / "shown").mkdir()
    monkeypatch.chdir(tmp_path / "shown")
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "drone.png").write_bytes(DRONE.read_bytes())
    (tmp_path / "b" / "empty.png").touch()
    for part in (porto, porto.with_suffix(".index")):
        (tmp_path / part.name).write_bytes(part.read_bytes())
    masks = [str(tmp_path / name) for name in ("a/drone.png", "b/drone.png", "b/empty.png")]
    also = [word for name in ALSO for word in ("--also", name)]
    more = ["--plot", "--report", "--explain", *also]
    assert main(["locate", *masks, "-r", str(tmp_path / "porto"), "-o", ".", "-q", *more]) == 1
    assert main(["verify", "a_drone_gcps.tif", *masks[1:], "-r", str(tmp_path / "porto"), "-o", ".", "-q"]) == 1
    shown = {path.name for path in Path().iterdir() if tmp_path.name.encode() in _content(path)}
    assert shown == {"a_drone_location.json", "b_drone_location.json"}
    assert json.loads(Path("b_drone_location.json").read_text())["query"] == masks[1]
    with rasterio.open("b_drone_gcps.vrt") as seen:
        assert (seen.read(1) == cv2.imread(masks[1], cv2.IMREAD_UNCHANGED)).all()
    assert '<SourceFilename relativeToVRT="1">../b/drone.png<' in Path("b_drone_gcps.vrt").read_text()


def _content(path: Path) -> bytes:
    if path.suffix != ".kmz":
        return path.read_bytes()
    with zipfile.ZipFile(path) as packed:
        return b"".join(map(packed.read, packed.namelist()))


def test_control_characters_are_shown_in_tables_and_pages() -> None:
    assert table_text([["a\x1b[31m\u202egnp", 1]]) == "a\\x1b[31m\\u202egnp,1\n"
    assert in_html("<b>\x1b\u202e") == "&lt;b&gt;\\x1b\\u202e"
