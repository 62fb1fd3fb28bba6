"""Every example in the docstrings of what `roadgeo` offers runs, and gives what it shows."""

import doctest
import importlib
import inspect
from pathlib import Path

import cv2
import pytest

import roadgeo
from roadgeo.evaluation.demo import PHOTO, ROADS, demo_masks

MODULES = (
    "roadgeo",
    "roadgeo.api",
    "roadgeo.running.answers",
    "roadgeo.workflows",
    "roadgeo.reference.reference",
    "roadgeo.outputs.schemas",
)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the examples speak of: the demonstration's map and masks, and frames of a short flight."""
    folder = tmp_path_factory.mktemp("desk")
    roadgeo.index(ROADS, "porto", path=folder / "porto.gpkg")
    for source in (ROADS, PHOTO, *(mask.path for mask in demo_masks())):
        (folder / source.name).write_bytes(source.read_bytes())
    roadgeo.locate(folder / "drone.png", folder / "porto.gpkg").write(folder)
    (folder / "frames").mkdir()
    sheet = cv2.imread(str(folder / "map_sheet.png"), cv2.IMREAD_GRAYSCALE)
    for k in range(3):
        cv2.imwrite(str(folder / "frames" / f"{k}.png"), sheet[100 : 100 + 700, 40 * k : 40 * k + 700])
    return folder


@pytest.mark.parametrize("name", MODULES)
def test_examples_give_what_they_show(name: str, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    module = importlib.import_module(name)
    found = doctest.testmod(module, extraglobs={"roadgeo": roadgeo}, optionflags=doctest.ELLIPSIS)
    assert found.failed == 0
    assert found.attempted


def test_every_public_function_has_an_example() -> None:
    functions = [getattr(roadgeo, name) for name in roadgeo.__all__]
    functions = [function for function in functions if inspect.isfunction(function)]
    assert len(functions) > 7
    assert [function.__name__ for function in functions if ">>>" not in (function.__doc__ or "")] == []
