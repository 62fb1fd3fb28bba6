"""`roadgeo verify`: options, one call, printing."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roadgeo._options import IMAGE, OTHERS, RESULTS, option, part, take
from roadgeo.cli import ERROR, NOT_LOCATED
from roadgeo.cli.command_line import made_by
from roadgeo.cli.options import Shared, Verbosity, argument, command, find_tasks, open_maps, threaded
from roadgeo.cli.printing import complain, echo, is_set, paint, plain, tell
from roadgeo.outputs.options import ImageOptions
from roadgeo.running.options import SEGMENTING, ReadOptions
from roadgeo.storage.files import make_folder

if TYPE_CHECKING:
    from roadgeo.reference.opening import AnyReference
    from roadgeo.running.verifying import Verified, VerifyRun

__all__ = ["describe", "verify_command"]

#: Exit status of this command alone.
OFF = 4

_COLORS = {"agrees": "green", "off": "red", "unknown": "yellow"}


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Verify:
    """The parameters of `roadgeo verify`."""

    images: tuple[str, ...] = argument("IMAGE...", many=True)
    references: tuple[str, ...] = take(Shared, "references",
        help="Map to hold them against: REF.gpkg, or a name in the library. Repeatable. Default: all of the library.")
    out_dir: str = take(Shared, "out_dir", help="Where files go; made if missing. Default: here.")
    as_json: bool = take(Shared, "as_json")
    report: bool = option("--report", "", RESULTS, "Of each image, a page for the browser: IMAGE_verify.html.")
    fix: bool = option("--fix", "", RESULTS,
        "For each image that is off, write IMAGE_fixed.tif: the same pixels with the corrected georeference; and "
        "IMAGE_fixed.points, for the QGIS Georeferencer.")
    in_place: bool = option("--in-place", "", RESULTS, "Correct the georeference of GeoTIFFs that are off themselves.")
    tolerance: float = option("--tolerance", "METRES", OTHERS,
        "An image agrees if, on average over the frame, it is off by less.",
        limits=(0.1, 100), default=3.0, show_default=True)
    reach: float = option("--reach", "METRES", OTHERS,
        "How far off it may be: nothing beyond is reported.",
        limits=(20, 2000), default=350.0, show_default=True, rare=True)
    max_turn: float = option("--max-turn", "DEG", OTHERS,
        "By how much it may be turned.", limits=(0, 45), default=6.0, show_default=True, rare=True)
    crs: str | None = take(ImageOptions, "crs", help="CRS of images that name none, such as EPSG:25832.", group=IMAGE)
    recursive: bool = take(Shared, "recursive")
    reading: ReadOptions = part(ReadOptions, *SEGMENTING)
    jobs: int = take(Shared, "jobs")
    verbosity: Verbosity = part(Verbosity)
# fmt: on


@command("verify", Verify)
def verify_command(asked: Verify) -> int:
    """Check whether georeferenced IMAGEs are where they claim to be, by the roads they show.

    An image is a road mask or a photograph with a place: a geotransform, control
    points, or a world file. Its roads are compared with a reference's at that place and within --reach of it; the
    rest of the map is searched only for a place that explains more. Each image

    \b
      agrees      within --tolerance
      is off      by metres east and north, degrees clockwise,
                  and its scale, with standard deviations; --fix writes it corrected
      is unknown  it cannot be judged, and why: few roads, another map, streets that repeat

    For several images also roadgeo_verify.csv, with a row each.

    \b
    Examples:
      roadgeo verify ortho.tif --report
      roadgeo verify tiles/ --reference boston-ma --fix --out-dir fixed
      roadgeo verify scan.jpg --crs EPSG:25832 --tolerance 10
      roadgeo verify *.tif --json --jobs 4 > verified.jsonl

    Exit status: 0 all agree, 4 at least one is off, 3 none is off but some are unknown, 1 error, 2 usage.
    """
    from roadgeo.cli.progress import count_up, name_counts
    from roadgeo.outputs.verification_files import write_table
    from roadgeo.running.processes import run

    tasks = find_tasks(asked.images, asked.recursive)
    settings = _settings(asked)
    opened = open_maps(settings.references)
    if asked.fix or asked.report or len(tasks) > 1:
        make_folder(asked.out_dir)
    results: list[Verified] = []
    with count_up(len(tasks)) as count:
        for task, verified in zip(tasks, run(tasks, settings, asked.jobs), strict=True):
            results.append(verified)
            count(verified.verdict)
            stem = Path(asked.out_dir) / task.stem
            pages = [_write_page(verified, task.mask, stem, opened, settings)] if asked.report else []
            files = [*pages, *_correct(verified, Path(task.mask), stem, asked.fix, asked.in_place)]
            _report(verified, files)
    documents = [verified.document for verified in results]
    counts = Counter(verified.verdict for verified in results)
    if len(tasks) > 1:
        write_table(Path(asked.out_dir) / "roadgeo_verify.csv", documents)
        tell(f"{name_counts(counts)}; all of them: {Path(asked.out_dir) / 'roadgeo_verify.csv'}", err=True)
    return ERROR if counts["error"] else OFF if counts["off"] else NOT_LOCATED if counts["unknown"] else 0


def _settings(asked: Verify) -> VerifyRun:
    """Put together what was asked."""
    from roadgeo.matching.checking import CheckOptions
    from roadgeo.running.verifying import VerifyRun

    usual = CheckOptions()
    search = replace(usual.search, reach_m=asked.reach, turn_deg=asked.max_turn)
    options = replace(usual, tolerance_m=asked.tolerance, search=search)
    return VerifyRun(asked.references, options, threaded(asked.reading, asked.jobs), asked.crs)


def _write_page(
    verified: Verified, image: str, stem: Path, opened: Sequence[AnyReference], settings: VerifyRun
) -> Path:
    """Write the report of an image."""
    from roadgeo.outputs.report.verification import write_verification
    from roadgeo.sources.georeference import read_georeference

    page = stem.with_name(f"{stem.name}_verify.html")
    place = None if verified.verdict == "error" else read_georeference(image, settings.crs)
    indexes = [] if place is None else [index for each in opened for index in each.indexes_at([place.middle()])]
    index = next((index for index in indexes if index.name == verified.document.get("reference")), None)
    said = plain(describe(verified.document)).removeprefix(f"{image}: {verified.verdict}: ")
    write_verification(page, verified.document, said, place, verified.corrected, index)
    return page


def _correct(verified: Verified, image: Path, stem: Path, fix: bool, in_place: bool) -> list[Path]:
    """Write the corrected files of an image that is off, as far as they are asked for."""
    from roadgeo.outputs.verification_files import write_fixed, write_in_place, write_points
    from roadgeo.storage.orientation import read_orientation

    if verified.corrected is None:
        return []
    files = []
    if fix:
        files = [stem.with_name(f"{stem.name}_fixed{ending}") for ending in (".tif", ".points")]
        write_fixed(image, files[0], verified.corrected)
        write_points(files[1], verified.corrected.of_stored(read_orientation(image)))
    if in_place:
        write_in_place(image, verified.corrected)
        files.append(image)
    return files


def describe(document: dict[str, Any]) -> str:
    """Print the result of an image, in a line."""
    verdict, offset = document["verdict"], document.get("displacement")
    word = paint(verdict, _COLORS.get(verdict))
    if verdict == "off" and offset is not None:
        return (
            f"{document['image']}: {word}: move it {offset['east_m']:+.1f} m east, {offset['north_m']:+.1f} m north"
            f" (± {offset['sigma_m']:.1f} m), turn it {offset['turn_deg']:+.2f}°, scale it by {offset['scale']:.4f};"
            f" {document['agreeing']:.0%} of the roads agree then, {document['agreeing_as_given']:.0%} as it is"
        )
    return f"{document['image']}: {word}: {document['reason']}"


def _report(verified: Verified, files: list[Path]) -> None:
    document = verified.document
    if is_set("as_json"):
        echo(json.dumps({**document, **made_by()}))
    if verified.verdict == "error":
        complain(document["reason"])
        return
    tell(describe(document))
    if is_set("verbose") and document.get("log10_lead") is not None:
        tell(f"  score {document['log10_lead']:.1f}")
    if files:
        tell(f"  wrote {', '.join(map(str, files))}")
