"""What a command is given reaches the code that obeys it."""

import ast
import inspect
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import click
import pytest
from support.documents import commands

from roadgeo.cli import queries
from roadgeo.cli.locate import Locate, locate_command
from roadgeo.cli.options import Known, Method, Verbosity, fill, threaded
from roadgeo.cli.track import Track, _frame_options, track_command
from roadgeo.cli.vectorize import Vectorize, vectorize_command
from roadgeo.cli.verify import Verify, _settings, verify_command
from roadgeo.flights.frames import FrameOptions
from roadgeo.outputs import registry
from roadgeo.outputs.options import ImageOptions
from roadgeo.running.options import BatchOptions, ReadOptions
from roadgeo.serving.options import ServeOptions

ALL = [(name, command) for name, command in commands() if not isinstance(command, click.Group)]


def attributes(path: str) -> set[str]:
    """Attributes that a module reads, and texts, by which some are read."""
    nodes = list(ast.walk(ast.parse(Path(path).read_text())))
    named = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    return named | {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def own_fields(kind: type) -> set[str]:
    """Fields of what a command is asked, and of its parts that no other code takes whole."""
    parts = {each.name: each.metadata["part"][0] for each in fields(kind) if "part" in each.metadata}
    whole = {name for name, of in parts.items() if of is Verbosity}
    return {each.name for of in (kind, *parts.values()) if of not in WHOLE for each in fields(of)} - whole


#: What is read elsewhere: how images are read and drawn, hints, thresholds, and switches of whoever prints.
WHOLE = {BatchOptions, ImageOptions, Known, Method, ReadOptions, ServeOptions, Verbosity}


@pytest.mark.parametrize(("name", "command"), ALL, ids=[name for name, _ in ALL])
def test_no_option_is_taken_and_dropped(name: str, command: click.Command) -> None:
    run = inspect.unwrap(command.callback)
    if "vars(asked)" in inspect.getsource(run):
        return  # all that it is given goes on
    (kind,) = [value for value in get_type_hints(run).values() if is_dataclass(value)]
    home = sys.modules[run.__module__]
    helpers = [queries] if name in ("index", "simulate", "evaluate") else []
    taken = set.union(*(attributes(inspect.getfile(module)) for module in (home, *helpers)))
    taken |= {output.option.removeprefix("--") for output in registry.REGISTRY.values()} if name == "locate" else set()
    printed = {"as_json"}  # as the switches
    assert own_fields(kind) - printed <= taken, name


READING = {
    "--threshold=0.25": ("threshold", 0.25),
    "--band=2": ("band", 2),
    "--segment=always": ("segment", "always"),
    "--class=road": ("class_name", "road"),
    "--bands=3,2,1": ("bands", (3, 2, 1)),
}


def asked(command: click.Command, kind: type, *more: str) -> Any:
    return fill(kind, dict(command.make_context("name", ["image.tif", *READING, *more]).params))


def check(reading: ReadOptions, segmenter: str) -> None:
    for field, value in READING.values():
        assert getattr(reading, field) == value, field
    assert reading.segmenter == segmenter


def test_how_images_are_read_reaches_each_command(tmp_path: Path) -> None:
    model = str(tmp_path / "model.onnx")
    Path(model).touch()
    for command, kind in ((locate_command, Locate), (vectorize_command, Vectorize)):
        check(asked(command, kind, f"--segmenter={model}").reading, model)
    check(_settings(asked(verify_command, Verify, f"--segmenter={model}")).reading, model)
    more = ("--recursive", "--gsd=0.3", "--motion-sigma=3", "--every=2", "--interval=4", "--aspect=1.2")
    frames = _frame_options(asked(track_command, Track, f"--segmenter={model}", *more))
    check(frames.reading, model)
    assert frames.gsd_m is not None
    assert (frames.motion_px, frames.every_s, frames.interval_s, frames.recursive) == (3.0, 2.0, 4.0, True)
    usual = FrameOptions()
    changed = {
        field.name for field in fields(FrameOptions) if getattr(frames, field.name) != getattr(usual, field.name)
    }
    assert changed == {field.name for field in fields(FrameOptions)} - {"motion"}


def test_what_locate_alone_reads() -> None:
    reported = asked(locate_command, Locate, "--mirror", "--aspect=1.5", "--units=metres", "--layer=roads")
    reading = threaded(reported.reading, jobs=2)
    assert (reading.mirror, reading.aspect, reading.units, reading.layer) == (True, 1.5, "metres", ("roads",))
    assert reading.threads == 1
