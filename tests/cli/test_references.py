"""The library: listed, checked and emptied."""

import json
import re
from pathlib import Path

import pytest
from worlds.fenway import streets, write_streets, write_vector

from roadgeo.cli import main


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A library with two references, `bad` of which is damaged."""
    folder = tmp_path / "library"
    monkeypatch.setenv("ROADGEO_LIBRARY", str(folder))
    streets = write_streets(tmp_path / "streets.geojson")
    for name in ("bad", "good"):
        assert main(["index", "--roads", str(streets), "--name", name, "--quiet"]) == 0
    (folder / "bad.gpkg").write_bytes((folder / "bad.gpkg").read_bytes()[:5000])
    return folder


def test_what_is_damaged_is_said_and_the_rest_is_listed(library: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reference", "list", "--json"]) == 1
    output = capsys.readouterr()
    assert [json.loads(line)["name"] for line in output.out.splitlines()] == ["good"]
    assert output.err.startswith(f"Error: {library / 'bad.gpkg'}")
    assert len(output.err.splitlines()) == 1


def test_every_reference_is_checked(library: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reference", "check", "bad", "nonesuch", "good"]) == 1
    output = capsys.readouterr()
    assert output.out == "good: sound\n"
    first, *_, last = output.err.splitlines()
    assert first.startswith(f"Error: {library / 'bad.gpkg'}")
    assert last.startswith("Error: no reference 'nonesuch'")


@pytest.mark.parametrize(("typed", "left"), [("y\n", ["bad"]), ("n\n", ["bad", "good"]), ("", ["bad", "good"])])
def test_before_one_is_removed_it_is_asked(
    library: Path, typed: str, left: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = iter([typed.strip()] if typed else [])

    def answer(_: str) -> str:
        try:
            return next(answers)
        except StopIteration:
            raise EOFError from None

    monkeypatch.setattr("click.termui.visible_prompt_func", answer)
    assert main(["reference", "remove", "good"]) == (0 if typed == "y\n" else 130)
    assert sorted(path.stem for path in library.glob("*.gpkg")) == left


def test_an_empty_library_says_how_it_is_filled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path))
    assert main(["reference", "list"]) == 0
    assert capsys.readouterr() == ("", f"The library in {tmp_path} is empty; `roadgeo index` adds to it.\n")


def test_kinds_that_no_column_tells_are_not_claimed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    bare, known = (
        write_vector(tmp_path / "bare.gpkg", streets()[0], width=["4"] * len(streets()[0])),
        tmp_path / "a.gpkg",
    )
    write_streets(known)
    for files, reported in (
        ([bare], "not known, all lines of bare.gpkg were taken"),
        ([bare, known], "drivable; of bare"),
    ):
        named = [part for file in files for part in ("--roads", str(file))]
        assert main(["index", *named, "--out", str(tmp_path / "ref.gpkg"), "--replace"]) == 0
        capsys.readouterr()
        assert caplog.text.count("bare.gpkg: no column tells what kind of road a line is") == 1
        caplog.clear()
        assert main(["reference", "info", str(tmp_path / "ref.gpkg")]) == 0
        (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("kinds")]
        assert reported in line


def test_what_is_not_there_is_not_asked_about(
    library: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("click.termui.visible_prompt_func", lambda _: pytest.fail("asked"))
    assert main(["reference", "remove", "good", "none-such"]) == 1
    assert "no reference 'none-such'" in capsys.readouterr().err
    assert (library / "good.gpkg").exists()


def test_a_reference_is_replaced_only_if_the_user_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It used to be replaced with a message where nobody could be asked."""
    write_streets(tmp_path / "a.gpkg")
    made = tmp_path / "ref.gpkg"
    build = ["index", "--roads", str(tmp_path / "a.gpkg"), "--out", str(made)]
    assert main(build) == 0
    capsys.readouterr()
    before, inode = made.read_bytes(), made.stat().st_ino
    assert main(build) == 1
    output = capsys.readouterr().err
    assert re.fullmatch(
        rf"Error: {re.escape(str(made))}: is a reference of \d+ intersections; .* --replace.*\n", output
    )
    assert made.read_bytes() == before
    assert main([*build, "--replace", "--quiet"]) == 0
    assert made.stat().st_ino != inode
    made.write_bytes(b"damaged")
    assert main([*build, "--quiet"]) == 0
