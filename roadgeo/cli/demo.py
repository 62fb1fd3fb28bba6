"""`roadgeo demo`: the whole way, on data that ships with the package."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import click

from roadgeo.cli import ERROR
from roadgeo.cli.options import out_dir_option
from roadgeo.cli.printing import echo
from roadgeo.outputs.wording import format_lonlat

if TYPE_CHECKING:
    from roadgeo.evaluation.demo import DemoMask
    from roadgeo.running.batch import Outcome

__all__ = ["demo_command"]

#: A middle farther off than this is wrong.
MAX_ERROR_M = 5.0


@click.command("demo", short_help="Locate five masks in Porto: needs no network and no data.")
@out_dir_option("Where everything is written; made if missing.", "roadgeo_demo", show_default=True)
def demo_command(out_dir: str) -> int:
    """Show the whole way on real data: build a reference, locate masks, write every output, compare with the truth.

    The map is a piece of Porto from OpenStreetMap. Four masks show parts of it as cameras and a road segmenter would;
    the fifth shows another city and has to be refused. Roads, masks and a photograph are put beside the results, to go
    on with: docs/tutorial.md does.

    \b
    Examples:
      roadgeo demo
      roadgeo demo --out-dir porto
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.evaluation.demo import ATTRIBUTION, PHOTO, ROADS, demo_masks
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.outputs.registry import OVERLAY
    from roadgeo.running.batch import locate_masks
    from roadgeo.running.options import BatchOptions
    from roadgeo.running.tasks import Task
    from roadgeo.storage.files import make_folder, write_bytes
    from roadgeo.workflows import build_reference

    # the sources of the demonstration are left beside its results
    folder, masks = Path(out_dir), demo_masks()
    make_folder(folder / "masks")
    for source, name in [(ROADS, ROADS.name), (PHOTO, PHOTO.name), *((m.path, f"masks/{m.path.name}") for m in masks)]:
        write_bytes(folder / name, source.read_bytes())
    compile_once(quiet=False)
    started = perf_counter()
    reference = build_reference(ROADS, "porto", path=folder / "porto.gpkg", attribution=ATTRIBUTION)
    seconds = perf_counter() - started
    echo(f"Porto, {ATTRIBUTION}: {len(reference.index):,} intersections, indexed in {seconds:.1f} s")
    # each mask is judged as soon as it is done
    tasks = [Task(str(mask.path), mask.path.stem) for mask in masks]
    options = BatchOptions(outputs=OutputOptions(products=(OVERLAY.name,)))
    wrong = 0
    outcomes = locate_masks(tasks, [str(folder / "porto.gpkg")], out_dir, options)
    for mask, outcome in zip(masks, outcomes, strict=True):
        right, text = _judge(outcome, mask)
        wrong += not right
        echo(f"\n{mask.path.name}: {mask.title}\n  {text}")
    echo(
        f"\nLook at {folder / 'drone_overlay.png'}. In QGIS, open {folder / 'drone_footprint.tif'} and "
        f"{folder / 'drone_location.gpkg'} over {folder / 'porto.gpkg'}. The masks are in {folder / 'masks'}."
    )
    command = f"roadgeo locate {folder / PHOTO.name} -r {folder / 'porto.gpkg'} --report"
    echo(
        f"\nNext, on this map: `{command}`. With a photograph of your own: first `roadgeo index --osm"
        ' "Your town"`, once; then `roadgeo locate photo.jpg --report`.'
    )
    if wrong:
        echo(f"Error: {wrong} masks came out wrong; please report it", err=True)
    return ERROR if wrong else 0


def _judge(outcome: Outcome, mask: DemoMask) -> tuple[bool, str]:
    """Compare with the truth; return whether it is right, and a sentence."""
    from roadgeo.evaluation.scoring import score
    from roadgeo.evaluation.truth import Truth

    found = outcome.document
    if outcome.status == "error":
        return False, str(found["reason"])
    if outcome.status != "located":
        right = not mask.in_map
        return right, f"{'refused, as it should be' if right else 'not found, although it is there'}: {found['reason']}"
    if not mask.in_map:
        return False, f"located, although it is not on this map: {found['reason']}"
    truth = Truth(mask.path.name, "mask", mask.homography, mask.crs, tuple(found["size"]))
    scored = score(truth, found)
    where = format_lonlat(found["center"]["lon"], found["center"]["lat"])
    seconds = found["seconds"]
    return scored.center_m < MAX_ERROR_M, (
        f"found at {where}: the middle is {scored.center_m:.1f} m off, the corners {scored.corners_rms_m:.1f} m; "
        f"{found['n_matched']} intersections matched, {seconds['total'] - seconds['open'] - seconds['write']:.2f} s"
    )
