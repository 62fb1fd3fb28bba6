import sys
from pathlib import Path

import pytest
from worlds.networks import grid_network

from roadgeo.errors import IndexFormatError, OutputError
from roadgeo.reference.files import write_reference
from roadgeo.reference.library import (
    library_dir,
    list_references,
    make_slug,
    new_reference,
    remove_reference,
    resolve_reference,
)
from roadgeo.roads.network import as_stored


@pytest.fixture(autouse=True)
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path / "shelf"))
    return tmp_path / "shelf"


def add(name: str) -> Path:
    network = as_stored(grid_network())
    return write_reference(new_reference(name), network, ({}, {"xy": network.intersections.xy})).geopackage


@pytest.mark.parametrize(
    ("name", "slug"),
    [
        ("Boston, MA", "boston-ma"),
        ("São Paulo", "sao-paulo"),
        ("Zürich / Straße_7", "zurich-strasse-7"),
        ("Москва", "москва"),
        ("../../etc/passwd", "etc-passwd"),
        ("...", "reference"),
        ("", "reference"),
        ("x" * 300, "x" * 80),
    ],
)
def test_slugs(name: str, slug: str) -> None:
    assert make_slug(name) == slug
    assert make_slug(slug) == slug


def test_an_empty_library_has_no_folder(shelf: Path) -> None:
    assert list_references() == []
    assert not shelf.exists()


def test_references_are_shelved_listed_found_and_removed(shelf: Path, tmp_path: Path) -> None:
    salem, boston = add("Salem / MA"), add("Boston, MA")
    assert (salem, boston) == (shelf / "salem-ma.gpkg", shelf / "boston-ma.gpkg")
    (shelf / ".roadgeo-0.tmp").mkdir()
    assert list_references() == [boston, salem]
    for name in ("Boston, MA", "boston-ma", "boston-ma.gpkg", str(boston), str(shelf / "boston-ma.index")):
        assert resolve_reference(name) == boston
    assert resolve_reference("Salem / MA") == salem
    boston.unlink()
    assert list_references() == [boston, salem]
    assert remove_reference("Boston, MA") == [shelf / "boston-ma.index"]
    assert remove_reference("salem-ma") == [shelf / "salem-ma.index", shelf / "salem-ma.gpkg"]
    assert list_references() == []


def test_a_file_comes_before_the_library(shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add("here")
    network = as_stored(grid_network())
    write_reference(tmp_path / "here", network, ({}, {}))
    monkeypatch.chdir(tmp_path)
    assert resolve_reference("here") == Path("here.gpkg")
    with pytest.raises(IndexFormatError, match="no reference"):
        resolve_reference(tmp_path)


def test_unknown_names_are_told_what_is_near() -> None:
    add("Boston, MA")
    with pytest.raises(IndexFormatError, match="did you mean boston-ma"):
        resolve_reference("bostom")
    with pytest.raises(IndexFormatError, match="roadgeo reference list"):
        resolve_reference("Tokyo")
    with pytest.raises(IndexFormatError, match="Tokyo"):
        remove_reference("Tokyo")


def test_a_folder_that_cannot_be_made_is_named(shelf: Path) -> None:
    shelf.touch()
    with pytest.raises(OutputError, match="shelf"):
        new_reference("Boston, MA")


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {}, "home/.local/share/roadgeo/references"),
        ("linux", {"XDG_DATA_HOME": "data"}, "data/roadgeo/references"),
        ("darwin", {}, "home/Library/Application Support/roadgeo/references"),
        ("win32", {"LOCALAPPDATA": "local"}, "local/roadgeo/references"),
        ("win32", {}, "home/AppData/Local/roadgeo/references"),
        ("linux", {"ROADGEO_LIBRARY": "~/maps"}, "home/maps"),
    ],
)
def test_where_the_library_lies(
    platform: str, variables: dict[str, str], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("ROADGEO_LIBRARY", "XDG_DATA_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(variable, raising=False)
    for variable, value in {"HOME": "home", "USERPROFILE": "home", **variables}.items():
        monkeypatch.setenv(variable, value)
    monkeypatch.setattr(sys, "platform", platform)
    assert library_dir() == Path(expected)
