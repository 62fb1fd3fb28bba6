"""Where things are kept, on each platform."""

import os
import tempfile
from pathlib import Path

import pytest

from roadgeo.storage.folders import cache_dir, is_private, private_temporary_dir, writable

HOME = Path("/home/somebody")
SETTINGS = ("ROADGEO_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA")


@pytest.mark.parametrize(
    ("platform", "settings", "expected"),
    [
        ("linux", {}, HOME / ".cache/roadgeo"),
        ("linux", {"XDG_CACHE_HOME": "/fast"}, Path("/fast/roadgeo")),
        ("darwin", {"XDG_CACHE_HOME": "/fast"}, HOME / "Library/Caches/roadgeo"),
        ("win32", {}, HOME / "AppData/Local/roadgeo/cache"),
        ("win32", {"LOCALAPPDATA": "/users/local"}, Path("/users/local/roadgeo/cache")),
        ("win32", {"ROADGEO_CACHE": "~/here"}, HOME / "here"),
    ],
)
def test_what_can_be_made_again_lies_where_the_platform_keeps_it(
    platform: str, settings: dict[str, str], expected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in SETTINGS:
        monkeypatch.delenv(name, raising=False)
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(HOME))
    monkeypatch.setattr("sys.platform", platform)
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    assert cache_dir() == expected


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.skipif(os.name == "nt", reason="permission bits of POSIX")
class TestPrivateTemporaryDir:
    def test_it_is_the_users_alone_and_stays_the_same(self, temporary: Path) -> None:
        folder = private_temporary_dir()
        assert folder == private_temporary_dir() == temporary / f"roadgeo-{os.getuid()}"
        assert folder.stat().st_mode & 0o777 == 0o700

    def test_one_that_others_may_write_to_is_not_used(self, temporary: Path) -> None:
        taken = temporary / f"roadgeo-{os.getuid()}"
        taken.mkdir()
        taken.chmod(0o777)
        folder = private_temporary_dir()
        assert folder != taken
        assert folder.stat().st_mode & 0o777 == 0o700

    def test_a_file_in_its_place_is_no_fault(self, temporary: Path) -> None:
        """Another user may have put it there; the next name is taken, and found again."""
        (temporary / f"roadgeo-{os.getuid()}").touch()
        folder = private_temporary_dir()
        assert folder == private_temporary_dir() == temporary / f"roadgeo-{os.getuid()}-1"

    def test_where_all_names_are_taken_another_is_made(self, temporary: Path) -> None:
        for ending in ["", *(f"-{n}" for n in range(1, 16))]:
            (temporary / f"roadgeo-{os.getuid()}{ending}").touch()
        assert private_temporary_dir().stat().st_mode & 0o777 == 0o700

    def test_a_link_is_not_followed(self, temporary: Path) -> None:
        (temporary / "elsewhere").mkdir(mode=0o700)
        (temporary / f"roadgeo-{os.getuid()}").symlink_to(temporary / "elsewhere")
        assert private_temporary_dir().resolve() != temporary / "elsewhere"


def test_without_users_the_temporary_folder_is_private_already(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "getuid", raising=False)
    assert private_temporary_dir() == temporary / "roadgeo"


def test_a_folder_is_made_to_see_whether_it_can_be_written_to(tmp_path: Path) -> None:
    assert writable(tmp_path / "a/b")
    assert not list((tmp_path / "a/b").iterdir())
    (tmp_path / "file").touch()
    assert not writable(tmp_path / "file/c")


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root gives folders away")
def test_a_folder_whose_parent_is_somebody_elses_is_not_private(tmp_path: Path) -> None:
    """They may put another in its place."""
    (tmp_path / "theirs" / "mine").mkdir(mode=0o700, parents=True)
    assert is_private(tmp_path / "theirs" / "mine")
    os.chown(tmp_path / "theirs", 4321, -1)
    assert not is_private(tmp_path / "theirs" / "mine")
