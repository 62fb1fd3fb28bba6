"""`roadgeo locate`: options, one call, printing."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from roadgeo._options import IMAGE, RESULTS, SEARCH, option, part, take
from roadgeo._progress import say_nothing
from roadgeo._text import log_of, visible
from roadgeo.cli import ERROR, NOT_LOCATED
from roadgeo.cli.accuracy import tell_accuracy
from roadgeo.cli.command_line import said_options
from roadgeo.cli.options import (
    Engine,
    Known,
    Method,
    Shared,
    Verbosity,
    argument,
    command,
    find_tasks,
    hinted,
    make_cluster,
    make_options,
    n_threads,
    open_maps,
    threaded,
)
from roadgeo.cli.printing import complain, echo, is_set, paint, tell
from roadgeo.cli.truths import read_truths
from roadgeo.matching.hints import asked_of_camera
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.registry import (
    ALSO,
    ALWAYS,
    EXPLANATION,
    EXPLANATION_PICTURE,
    OVERLAY,
    REGISTRY,
    REPORT,
    Output,
)
from roadgeo.outputs.wording import format_lonlat
from roadgeo.running.batch import locate_masks, write_overview
from roadgeo.running.locating import Outcome
from roadgeo.running.options import BatchOptions, ReadOptions
from roadgeo.running.tasks import SUFFIXES
from roadgeo.storage.files import make_folder

if TYPE_CHECKING:
    from roadgeo.outputs.location_files import OutputOptions

__all__ = ["describe", "locate_command", "pair_images"]

_LOG = log_of(__name__)

#: Options without an effect on a result, or with a value for each mask.
_OF_NO_ACCOUNT = {
    *("as_json", "divide_map", "engine", "images", "jobs", "page", "quiet", "recursive", "scheduler"),
    *("skip_existing", "verbose"),
}

_HELP = """Find where aerial images lie on a map, and draw them there.

An image is a photograph, whose roads a network finds first; a mask, bright where there is road; or roads as lines.
Give files, folders or patterns. Nothing else need be known; what is known shortens the search.

\b
Examples:
  roadgeo locate photo.jpg --report
  roadgeo locate flight/ --reference boston-ma --out-dir found --json --jobs 4 > found.jsonl
  roadgeo locate photo_mask.png --image photo.tif --crs EPSG:3857 --also geojson
  roadgeo locate photo.jpg --gsd 0.3 --near=-71.06,42.36,5000

\b
For each located photo.jpg:
{always}

Exit status: 0 all located or chosen, 3 at least one not located, 1 error, 2 usage.
"""

_MORE = """Where asked for:
{asked}

With --also:
{also}
  and what plugins offer (roadgeo --plugins)

For several images also roadgeo_summary.gpkg and roadgeo_summary.csv, all footprints
in one, and with --report roadgeo_report.html, which lists them. What a network saw in
a photograph is kept as PHOTO_mask.tif. What Ctrl-C cut short goes on with --skip-existing.
"""


def _listed(outputs: Sequence[Output]) -> str:
    """List files with their purposes."""
    names = [output.path(Path(), "photo").name for output in outputs]
    said = [f"{output.option}: {output.summary}" if output.option else output.summary for output in outputs]
    width = max(map(len, names))
    return "\n".join(f"  {name:<{width}}  {text}" for name, text in zip(names, said, strict=True))


def _more() -> str:
    asked = [OVERLAY, REPORT, EXPLANATION_PICTURE, EXPLANATION]
    also = "\n".join(f"  {name:<9}  {output.summary}" for name, output in ALSO.items())
    return _MORE.format(asked=_listed(asked), also=also)


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Locate:
    """The parameters of `roadgeo locate`."""

    masks: tuple[str, ...] = argument("IMAGE...", many=True)
    references: tuple[str, ...] = take(Shared, "references")
    known: Known = part(Known)
    out_dir: str = take(Shared, "out_dir")
    report: bool = option("--report", "", RESULTS, "Also a page for the browser, located or not.")
    plot: bool = option("--plot", "", RESULTS, "Also a picture, to look at.")
    batch: BatchOptions = part(BatchOptions)
    images: tuple[str, ...] = option("--image", "PHOTO", RESULTS,
        "Draw this photograph in place of its mask. One per mask, in order, or a folder of them. Repeatable.",
        type=click.Path(), multiple=True, default=())
    products: tuple[str, ...] = take(Shared, "products")
    as_json: bool = take(Shared, "as_json")
    explain: bool = option("--explain", "", RESULTS,
        "How far the search got, the best rejected places, what was missing: a picture and JSON.", rare=True)
    truth: str | None = option("--truth", "LON,LAT|FILE", RESULTS,
        "With --explain: where the middle really lies, or a truth.csv of many masks; says which stage lost it.",
        rare=True)
    image: ImageOptions = part(ImageOptions)
    recursive: bool = take(Shared, "recursive")
    reading: ReadOptions = part(ReadOptions)
    page: int | None = option("--page", "N", IMAGE,
        "Page of a TIFF that holds several. Default: the first.", limits=(1, None), rare=True)
    jobs: int = take(Shared, "jobs")
    how: Method = part(Method)
    engine: Engine | None = take(Shared, "engine")
    scheduler: str | None = take(Shared, "scheduler")
    divide_map: bool = option("--divide-map", "", SEARCH,
        "On a Dask cluster: each worker keeps and searches a share of the map's shards, for all masks: for maps that no"
        " machine holds.", rare=True)
    verbosity: Verbosity = part(Verbosity)
# fmt: on


@command(
    "locate",
    Locate,
    help=_HELP.format(
        always=_listed([output for output in ALWAYS if output.ending.endswith((".json", ".tif", ".gpkg"))])
    ),
    more=_more,
)
def locate_command(asked: Locate) -> int:
    """Find where images lie on a map, and draw them there; for the help see above."""
    from roadgeo.cli.progress import count_up, show_steps

    options = make_options(asked.known, asked.how, may_be_stated=True)
    options = replace(options, truths=read_truths(asked.truth, explain=asked.explain))
    outputs = _output_options(asked)
    tasks = find_tasks(asked.masks, asked.recursive, asked.page, asked.out_dir)
    cluster = make_cluster(asked.engine, asked.scheduler, asked.jobs, asked.divide_map)
    if asked.divide_map and (cluster is None or asked.how.method == "pair" or asked.explain):
        raise click.UsageError("--divide-map goes with --engine dask, without --method pair and --explain.")
    # An image alone gets threads; on a cluster each worker keeps to one.
    is_alone = len(tasks) == 1 and cluster is None
    is_asked = click.get_current_context().get_parameter_source("jobs") is not ParameterSource.DEFAULT
    options = replace(options, threads=(asked.jobs if is_asked else n_threads()) if is_alone else 1)
    make_folder(asked.out_dir)
    batch = replace(
        asked.batch,
        search=options,
        outputs=outputs,
        reading=threaded(asked.reading, asked.jobs),
        images=pair_images([task.mask for task in tasks], asked.images),
        exif=asked_of_camera(hinted(asked.known)),
        command=tuple(said_options(_OF_NO_ACCOUNT)),
    )
    opened = open_maps(asked.references, options.near)
    outcomes: list[Outcome] = []
    is_single = len(tasks) == 1
    steps = show_steps() if is_single else nullcontext(say_nothing)
    with steps as say, count_up(len(tasks), _summarize) as count:
        for outcome in locate_masks(
            tasks, asked.references, asked.out_dir, batch, jobs=asked.jobs, cluster=cluster, say=say
        ):
            outcomes.append(outcome)
            count(outcome.status)
            _report(outcome, is_single)
    tell_accuracy((outcome.document for outcome in outcomes), asked.image.crs)
    counts = Counter[str](outcome.status for outcome in outcomes)
    if len(tasks) > 1:
        files = write_overview(asked.out_dir, tasks, outcomes, opened if asked.report else None)
        tell(f"{_summarize(counts)}; all footprints: {', '.join(map(str, files))}", err=True)
    failed = counts["error"] or any(outcome.faults for outcome in outcomes)
    return ERROR if failed else 0 if counts["located"] + counts["chosen"] == len(tasks) else NOT_LOCATED


def _output_options(asked: Locate) -> OutputOptions:
    """Put together what is written, and how it is drawn."""
    from roadgeo.outputs.location_files import OutputOptions

    switched = [output.name for output in REGISTRY.values() if output.option and getattr(asked, output.option[2:])]
    return OutputOptions(asked.image, tuple(dict.fromkeys([*asked.products, *switched])))


def pair_images(masks: Sequence[str], images: Sequence[str]) -> dict[str, str]:
    """Match photographs with masks.

    One photograph per mask in the same order, or a folder in which it has the mask's name, less a final "_mask".
    Where several have that name the first format of `SUFFIXES` counts.

    Raises
    ------
    click.UsageError
        Another number of photographs than of masks, or none in the folder.
    """
    if len(images) == 1 and Path(images[0]).is_dir():
        pictures = [path for path in Path(images[0]).iterdir() if path.suffix.lower() in SUFFIXES]
        pictures.sort(key=lambda path: (SUFFIXES.index(path.suffix.lower()), path))
        return {mask: _photograph_of(mask, pictures, images[0]) for mask in masks}
    if images and len(images) != len(masks):
        raise click.UsageError(f"Got {len(masks)} masks and {len(images)} times --image; expected one for each mask.")
    return dict(zip(masks, images, strict=False))


def _photograph_of(mask: str, pictures: Sequence[Path], folder: str) -> str:
    """Return the picture that has a mask's name and is not the mask; the first of several, which is mentioned."""
    stem = Path(mask).stem
    others = [path for path in pictures if path.resolve() != Path(mask).resolve()]
    for name in dict.fromkeys((stem.removesuffix("_mask"), stem)):
        named = [path for path in others if path.stem == name]
        if len(named) > 1:
            _LOG.warning("%s: %s is drawn, though %s has its name, too", mask, *named[:2])
        if named:
            return str(named[0])
    raise click.UsageError(f"No photograph in {folder} has the name of {mask}.")


# --- printing ---------------------------------------------------------------------------------------------------------


def describe(outcome: Outcome) -> str:
    """Print the result of a mask, in a line or two."""
    answer = outcome.document
    words = outcome.status.replace("_", " ")
    query = visible(answer["query"])
    if outcome.earlier:
        return f"{query}: {words} before"
    status = paint(words, "green" if outcome.status == "located" else "yellow")
    if outcome.status not in ("located", "chosen") or answer["center"] is None:
        text = f"{query}: {status}: {visible(answer['reason'])}"
    else:
        where = format_lonlat(answer["center"]["lon"], answer["center"]["lat"])
        text = f"{query}: {status} at {where} on {visible(answer['reference'])}: {visible(answer['reason'])}"
    if answer.get("error_rate"):
        text += f"; {answer['error_rate']['said']}"
    if answer.get("part_read"):
        text += f"\n  read {visible(answer['part_read'])}"
    if answer.get("stated_offset_m") is not None:
        text += f"\n  its own georeference, or EXIF, puts the middle {answer['stated_offset_m']:,.1f} m from there"
    if outcome.photo and outcome.photo[0] != answer["query"]:
        text += f"\n  drew {visible(outcome.photo[0])}, {outcome.photo[1]:g} times the mask's size"
    if outcome.removed:
        text += f"\n  removed what an earlier run had found: {visible(', '.join(outcome.removed))}"
    return text


def _summarize(counts: Counter[str]) -> str:
    """Print how many masks had which result."""
    said = {"located": "located", "chosen": "chosen", "ambiguous": "ambiguous", "not_located": "not located"}
    said["error"] = "failed"
    always = ("located", "not_located")
    return ", ".join(f"{counts[name]} {text}" for name, text in said.items() if counts[name] or name in always)


def _report(outcome: Outcome, single: bool) -> None:
    if is_set("as_json"):
        echo(json.dumps(outcome.document))
    for fault in outcome.faults:
        complain(fault)
    if outcome.status == "error":
        complain(outcome.document["reason"])
        return
    tell(describe(outcome))
    if is_set("verbose"):
        tell(_details(outcome.document))
    if single and outcome.status in ("not_located", "ambiguous"):
        _list_places(outcome.document)
    if (single or is_set("verbose")) and outcome.files:
        tell("  wrote " + visible(", ".join(outcome.files)))


def _list_places(document: dict[str, Any]) -> None:
    """Print the places that a refusal knows, by the numbers that --take has for them."""
    places = [*([document] if document["center"] else []), *document["alternatives"]]
    if places:
        tell("  best places; where you know one to be right, --take its number:")
    for n, place in enumerate(places, 1):
        where = format_lonlat(place["center"]["lon"], place["center"]["lat"])
        tell(f"    {n}: {where} on {visible(place['reference'])}, score {place['log10_odds']:z.1f}")


def _details(document: dict[str, Any]) -> str:
    seconds = ", ".join(f"{step} {value:.3f}" for step, value in document["seconds"].items())
    stats = ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in document["stats"].items())
    lines = [f"seconds: {seconds}", stats]
    if document["log10_odds"] is not None:
        lines.append(f"score (log10): {document['log10_odds']:.2f}")
    if document["center"] is None and document["alternatives"]:
        best = document["alternatives"][0]["center"]
        lines.append(f"the best place, not sure enough: {format_lonlat(best['lon'], best['lat'])}")
    return "\n".join(f"  {line}" for line in lines)
