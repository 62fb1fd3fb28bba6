"""What a command is given reaches the code that obeys it."""

import ast
import inspect
import sys
from dataclasses import fields
from pathlib import Path

import click
import pytest
from support.documents import commands

from roadgeo.cli import queries, shards
from roadgeo.cli.locate import locate_command
from roadgeo.cli.options import read_options
from roadgeo.cli.track import _frame_options, track_command
from roadgeo.cli.vectorize import vectorize_command
from roadgeo.cli.verify import _settings, verify_command
from roadgeo.flights.frames import FrameOptions
from roadgeo.matching.hints import HINTS
from roadgeo.outputs.registry import REGISTRY
from roadgeo.running.options import ReadOptions

ALL = [(name, command) for name, command in commands() if not isinstance(command, click.Group)]


def read_in(module: str) -> set[str]:
    """Names and texts that a module loads, and those that helpers of several commands take."""
    tree = ast.parse(Path(inspect.getfile(sys.modules[module])).read_text())
    for helper in (queries, shards):
        if f"{helper.__name__} import" in ast.unparse(tree):
            tree.body += ast.parse(Path(inspect.getfile(helper)).read_text()).body
    loaded = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    taken = loaded | texts
    if "read_options" in loaded:
        taken |= {field.name for field in fields(ReadOptions)}
    if "make_cluster" in loaded:
        taken |= {"engine", "scheduler", "divide_map"}
    if "find_tasks" in loaded:
        taken |= {"page", "recursive"}
    if "REGISTRY" in loaded:
        taken |= {output.option.removeprefix("--") for output in REGISTRY.values()}
    if "hinted" in loaded:
        taken |= {hint.goes_to for hint in HINTS.values()}
    return taken


@pytest.mark.parametrize(("name", "command"), ALL, ids=[name for name, _ in ALL])
def test_no_option_is_taken_and_dropped(name: str, command: click.Command) -> None:
    callback = inspect.unwrap(command.callback)
    if "publisher" in inspect.signature(callback).parameters:
        return  # all that it is given goes on
    taken = read_in(callback.__module__)
    own = {param.name for param in command.params if param.expose_value and not param.is_eager}
    assert own <= taken, name


READING = {
    "--threshold=0.25": ("threshold", 0.25),
    "--band=2": ("band", 2),
    "--segment=always": ("segment", "always"),
    "--class=road": ("class_name", "road"),
    "--bands=3,2,1": ("bands", (3, 2, 1)),
}


def given(command: click.Command, *more: str) -> dict[str, object]:
    return dict(command.make_context("name", ["image.tif", *READING, *more]).params)


def check(reading: ReadOptions, segmenter: str) -> None:
    for field, value in READING.values():
        assert getattr(reading, field) == value, field
    assert reading.segmenter == segmenter


def test_how_images_are_read_reaches_each_command(tmp_path: Path) -> None:
    model = str(tmp_path / "model.onnx")
    Path(model).touch()
    for command in (locate_command, vectorize_command):
        check(read_options(given(command, f"--segmenter={model}")), model)
    check(_settings(given(verify_command, f"--segmenter={model}"), 1).reading, model)
    frames = _frame_options(
        given(
            track_command,
            *(
                f"--segmenter={model}",
                "--recursive",
                "--gsd=0.3",
                "--motion-sigma=3",
                "--every=2",
                "--interval=4",
                "--aspect=1.2",
            ),
        )
    )
    check(frames.reading, model)
    assert frames.gsd_m is not None
    assert (frames.motion_px, frames.every_s, frames.interval_s, frames.recursive) == (3.0, 2.0, 4.0, True)
    usual = FrameOptions()
    changed = {
        field.name for field in fields(FrameOptions) if getattr(frames, field.name) != getattr(usual, field.name)
    }
    assert changed == {field.name for field in fields(FrameOptions)} - {"motion"}


def test_what_locate_alone_reads() -> None:
    reported = given(locate_command, "--mirror", "--aspect=1.5", "--units=metres", "--layer=roads")
    reading = read_options(reported, jobs=2)
    assert (reading.mirror, reading.aspect, reading.units, reading.layer) == (True, 1.5, "metres", ("roads",))
    assert reading.threads == 1
