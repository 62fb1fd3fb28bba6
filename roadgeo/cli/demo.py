"""`roadgeo demo`: the whole way, on data that ships with the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from roadgeo._options import take
from roadgeo.cli import ERROR
from roadgeo.cli.options import Once, Shared, command
from roadgeo.cli.printing import complain, echo
from roadgeo.outputs.wording import format_lonlat

if TYPE_CHECKING:
    from roadgeo.evaluation.demo import DemoMask
    from roadgeo.running.locating import Outcome

__all__ = ["demo_command"]


@dataclass(frozen=True, kw_only=True)
class Demo:
    """The parameters of `roadgeo demo`."""

    out_dir: str = take(Shared, "out_dir", help="Where everything is written; made if missing.",
        default="roadgeo_demo", show_default=True)  # fmt: skip


@command("demo", Demo, Once)
def demo_command(asked: Demo) -> int:
    """Show the whole way on real data: build references, locate, write every output, compare with the truth.

    The maps are the streets of Berkeley, and a piece of Porto from OpenStreetMap. An aerial photograph is searched for
    on both, with its scale given. Four masks show parts of Porto as cameras and a road segmenter would; the fifth shows
    another city and has to be refused. Roads, masks and photographs are put beside the results, to go on with:
    docs/tutorial.md does.

    \b
    Examples:
      roadgeo demo
      roadgeo demo --out-dir porto
    """
    from roadgeo.api import index
    from roadgeo.cli.compilation import compile_once
    from roadgeo.evaluation.demo import (
        ATTRIBUTION,
        PHOTO,
        ROADS,
        STREETS,
        STREETS_ATTRIBUTION,
        demo_masks,
        demo_photo,
    )
    from roadgeo.matching.hints import HINTS, apply_hints
    from roadgeo.matching.options import LocateOptions
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.outputs.registry import OVERLAY
    from roadgeo.running.batch import locate_masks
    from roadgeo.running.options import BatchOptions
    from roadgeo.running.tasks import Task
    from roadgeo.storage.files import make_folder, write_bytes

    # the sources of the demonstration are left beside its results
    folder, masks, photo = Path(asked.out_dir), demo_masks(), demo_photo()
    make_folder(folder / "masks")
    sources = [(path, path.name) for path in (ROADS, STREETS, PHOTO, photo.path)]
    for source, name in [*sources, *((mask.path, f"masks/{mask.path.name}") for mask in masks)]:
        write_bytes(folder / name, source.read_bytes())
    compile_once()
    for roads, name, attribution in ((STREETS, "berkeley", STREETS_ATTRIBUTION), (ROADS, "porto", ATTRIBUTION)):
        started = perf_counter()
        path = folder / f"{name}.gpkg"
        # the city's file has no kinds of roads
        reference = index(
            roads, name, path=path, kinds="all" if roads == STREETS else "drivable", attribution=attribution
        )
        seconds = perf_counter() - started
        echo(f"{name.title()}, {attribution}: {len(reference.index):,} intersections, indexed in {seconds:.1f} s")
    # each result is judged as soon as it is there
    berkeley, porto = (str(folder / f"{name}.gpkg") for name in ("berkeley", "porto"))
    wrong = 0
    for queries, references in (([photo], [berkeley, porto]), (masks, [porto])):
        gsd_m = queries[0].gsd_m
        search = apply_hints(LocateOptions(), {} if gsd_m is None else {"gsd_m": HINTS["gsd"].read(gsd_m)})
        options = BatchOptions(search, OutputOptions(products=(OVERLAY.name,)))
        tasks = [Task(str(query.path), query.path.stem) for query in queries]
        for query, outcome in zip(queries, locate_masks(tasks, references, folder, options), strict=True):
            right, text = _judge(outcome, query)
            wrong += not right
            echo(f"\n{query.path.name}: {query.title}\n  {text}")
    echo(
        f"\nLook at {folder / 'berkeley_photo_overlay.png'}. In QGIS, open {folder / 'berkeley_photo_footprint.tif'} "
        f"and {folder / 'berkeley_photo_location.gpkg'} over {folder / 'berkeley.gpkg'}."
    )
    command = f"roadgeo locate {folder / photo.path.name} -r {berkeley} -r {porto} --gsd {photo.gsd_m} --report"
    echo(
        f"\nNext, the same with a report: `{command}`. With a photograph of your own: first `roadgeo index --osm"
        ' "Your town"`, once; then `roadgeo locate photo.jpg --report`.'
    )
    if wrong:
        complain(f"{wrong} results came out wrong; please report it")
    return ERROR if wrong else 0


def _judge(outcome: Outcome, mask: DemoMask) -> tuple[bool, str]:
    """Compare with the truth; return whether it is right, and a sentence."""
    from roadgeo.evaluation.scoring import score
    from roadgeo.evaluation.truth import Truth

    answer = outcome.document
    if outcome.status == "error":
        return False, str(answer["reason"])
    if outcome.status != "located":
        right = not mask.in_map
        return (
            right,
            f"{'refused, as it should be' if right else 'not found, although it is there'}: {answer['reason']}",
        )
    if not mask.in_map:
        return False, f"located, although it is not on this map: {answer['reason']}"
    truth = Truth(mask.path.name, "mask", mask.homography, mask.crs, tuple(answer["size"]))
    scored = score(truth, answer)
    where = format_lonlat(answer["center"]["lon"], answer["center"]["lat"])
    seconds = answer["seconds"]
    return scored.center_m < mask.known_to_m, (
        f"found at {where}: the middle is {scored.center_m:.1f} m off, the corners {scored.corners_rms_m:.1f} m; "
        f"{answer['n_matched']} intersections matched, {seconds['total'] - seconds['open'] - seconds['write']:.2f} s"
    )
