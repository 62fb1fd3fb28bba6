"""`roadgeo locate`: options, one call per mask, printing."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import click

from roadgeo._progress import Say, say_nothing
from roadgeo.cli import ERROR, NOT_LOCATED
from roadgeo.cli.batch import Task, find_masks, name_tasks, run
from roadgeo.cli.folders import make_folder
from roadgeo.cli.parameters import CAMERA, NEAR, RANGE, Plugin, verbosity_options
from roadgeo.outputs.wording import format_lonlat

if TYPE_CHECKING:
    from roadgeo.geometry.mask import RoadMask
    from roadgeo.location import Location
    from roadgeo.matching.explanation import Explanation
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.outputs.paths import OutputPaths
    from roadgeo.reference.reference import Reference
    from roadgeo.workflows import LocateOptions

__all__ = ["Job", "Outcome", "locate_command", "make_options", "open_references", "pair_images"]

Status = Literal["located", "ambiguous", "not_located", "error"]


@dataclass(frozen=True)
class Outcome:
    """What became of one mask: its JSON object, a text for people, the files written."""

    status: Status
    document: dict[str, Any]
    text: str
    files: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """What is done with every mask; travels to other processes."""

    references: tuple[str, ...]
    options: LocateOptions
    outputs: OutputOptions
    out_dir: str
    images: Mapping[str, str] = field(default_factory=dict)
    threshold: float | None = None
    band: int | None = None
    plot: bool = False
    figure: str | None = None
    report: bool = False
    explain: bool = False
    segmenter: str | None = None
    exif: bool = False
    skip_existing: bool = False

    def prepare(self) -> Callable[[Task], Outcome]:
        """Open the references."""
        started = perf_counter()
        references = open_references(self.references)
        seconds = perf_counter() - started
        return lambda task: self.locate(task, references, seconds)

    def give_up(self, task: Task, reason: str) -> Outcome:
        """Make the outcome of a mask that could not be worked on."""
        return _failed(task, reason)

    def locate(self, task: Task, references: list[Reference], open_seconds: float) -> Outcome:
        """Locate one mask and write its results. What is wrong with one mask never stops the others."""
        from roadgeo.errors import RoadgeoError

        earlier = self._earlier(task) if self.skip_existing else None
        if earlier is not None:
            return earlier
        try:
            return self._locate(task, references, open_seconds)
        except RoadgeoError as error:
            return _failed(task, str(error))
        except MemoryError:
            return _failed(task, f"{task.mask}: more memory is needed than there is; reduce it or cut it up")
        except Exception as error:  # whatever it is, the other masks go on
            if os.environ.get("ROADGEO_TRACEBACK"):
                raise
            what = " ".join(f"{type(error).__name__}: {error}".split())
            return _failed(task, f"{task.mask}: {what}; this is a fault of roadgeo, please report it")

    def _earlier(self, task: Task) -> Outcome | None:
        """Return what an earlier run found, if its result is whole, of this mask and younger than it."""
        from roadgeo.location import SCHEMA
        from roadgeo.outputs.paths import output_paths

        path = output_paths(self.out_dir, task.stem).json
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            if path.stat().st_mtime < Path(task.mask).stat().st_mtime:
                return None
        except (OSError, ValueError):
            return None
        if not isinstance(document, dict) or (document.get("schema"), document.get("query")) != (SCHEMA, task.mask):
            return None
        return Outcome(document["status"], document, f"{task.mask}: {document['status'].replace('_', ' ')} before")

    def _locate(self, task: Task, references: list[Reference], open_seconds: float) -> Outcome:
        from dataclasses import replace

        from roadgeo.outputs.location_files import write_location
        from roadgeo.outputs.paths import output_paths
        from roadgeo.workflows import explain, locate

        started = perf_counter()
        mask = self._read(task)
        read_seconds = perf_counter() - started
        options = self._options(task, max(mask.shape))
        explanation = explain(mask, references, options) if self.explain else None
        location = locate(mask, references, options) if explanation is None else explanation.location
        location = replace(location, seconds=replace(location.seconds, open=open_seconds, read=read_seconds))
        reference = next((one for one in references if one.name == location.reference), references[0])
        attribution = str(reference.index.meta.get("attribution", ""))
        paths = output_paths(self.out_dir, task.stem)
        picture = self.images.get(task.mask, task.mask if self.segmenter else None)
        location, files = write_location(location, mask, paths, self.outputs, picture)
        if location.located and (self.plot or self.figure):
            pictures = [paths.overlay] if self.plot else []
            pictures += [paths.figure(self.figure)] if self.figure else []
            _draw(location, mask, reference, pictures, attribution)
            files += pictures
        if self.report:
            from roadgeo.outputs.report import write_report

            write_report(paths.report, location, mask, reference.index, attribution, picture)
            files.append(paths.report)
        if explanation is not None:
            files += _write_explanation(explanation, mask, references, paths)
        text = describe(location)
        if picture and location.located:
            text += f"\n  drew {picture}, {_scale(picture, mask):g} times the mask's size"
        return Outcome(location.status, location.to_dict(), text, tuple(map(str, files)))

    def _read(self, task: Task) -> RoadMask:
        """Read the mask, or have a plugin see the roads in a photograph."""
        from dataclasses import replace

        import numpy as np

        from roadgeo.errors import PluginError
        from roadgeo.geometry.mask import RoadMask
        from roadgeo.plugins import SEGMENTERS, call_plugin
        from roadgeo.sources.masks import read_mask

        if self.segmenter is None:
            return read_mask(task.mask, threshold=self.threshold, band=self.band)
        seen = call_plugin(SEGMENTERS, self.segmenter, task.mask)
        if isinstance(seen, RoadMask):
            return replace(seen, name=task.mask)
        if not isinstance(seen, np.ndarray):
            kind = type(seen).__name__
            raise PluginError(f"the segmenter {self.segmenter!r} returned a {kind}, expected a RoadMask or an array")
        return read_mask(seen, threshold=self.threshold, name=task.mask)

    def _options(self, task: Task, longer_side: int) -> LocateOptions:
        """Return the options, with the focal length that the photograph's EXIF states where that was asked for."""
        if not self.exif:
            return self.options
        from dataclasses import replace

        from roadgeo.sources.exif import read_focal_length

        focal_px = read_focal_length(self.images.get(task.mask, task.mask)) * longer_side
        match = self.options.match
        return replace(self.options, match=replace(match, camera=replace(match.camera, focal_px=focal_px)))


def open_references(names: Iterable[str], say: Say = say_nothing) -> list[Reference]:
    """Open references by path or name; none named: all of the library. `say` is told of an index that has to be built.

    Raises
    ------
    IndexFormatError
        A reference is missing or unusable, or the library is empty.
    """
    from roadgeo.errors import IndexFormatError
    from roadgeo.reference.library import library_dir, list_references, resolve_reference
    from roadgeo.reference.reference import open_reference

    paths = [resolve_reference(name) for name in names] or list_references()
    if not paths:
        raise IndexFormatError(
            f"the library in {library_dir()} is empty and no --reference was given; build one with `roadgeo index`"
        )
    return [open_reference(path, say) for path in paths]


@click.command("locate", short_help="Find road masks on a reference and draw them there.")
@click.argument("masks", metavar="MASK...", nargs=-1, required=True, type=click.Path())
@click.option(
    "-r",
    "--reference",
    "references",
    metavar="REF",
    type=click.Path(),
    multiple=True,
    help="Reference to search: REF.gpkg, or a name in the library. Repeatable. Default: all of the library.",
)
@click.option(
    "-o",
    "--out-dir",
    metavar="DIR",
    default=".",
    type=click.Path(file_okay=False),
    help="Where the results go; made if missing. Default: here.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per mask and line, in input order.")
@click.option("--plot", is_flag=True, help="Also write MASK_overlay.png: the mask and its place, to look at.")
@click.option(
    "--figure",
    type=click.Choice(["pdf", "svg", "png"]),
    help="Also write MASK_figure, the same with axes, for papers. Needs matplotlib: pip install 'roadgeo[plot]'.",
)
@click.option(
    "--report",
    is_flag=True,
    help="Also write MASK_report.html, to look at in a browser, located or not; needs no network.",
)
@click.option(
    "--explain",
    is_flag=True,
    help="Also write MASK_explain.png and .json: how far the search got, the best rejected places, what was missing.",
)
@click.option(
    "--image",
    "images",
    metavar="PHOTO",
    type=click.Path(),
    multiple=True,
    help="Draw this photograph on the map instead of its mask. One per mask, in order, or a folder of them.",
)
@click.option(
    "--also",
    "products",
    metavar="NAME",
    type=Plugin("roadgeo.outputs"),
    multiple=True,
    help="Write a further form of the result: see below. Repeatable.",
)
@click.option("--gcps", is_flag=True, help="The same as --also gcps: the picture's own pixels with control points.")
@click.option("--crs", metavar="CRS", help="CRS of what is drawn, such as EPSG:3857. Default: the reference's, metric.")
@click.option(
    "--resolution",
    metavar="SIZE",
    type=click.FloatRange(min=0, min_open=True),
    help="Pixel size of what is drawn, in units of its CRS. Default: the picture's own.",
)
@click.option(
    "--resampling",
    type=click.Choice(["nearest", "bilinear", "cubic", "lanczos"]),
    default="cubic",
    show_default=True,
    help="How a photograph's values between its pixels are found.",
)
@click.option(
    "--max-pixels",
    metavar="N",
    type=click.IntRange(1),
    default=400_000_000,
    show_default=True,
    help="Draw coarser rather than more than this.",
)
@click.option(
    "--segmenter",
    metavar="NAME",
    type=Plugin("roadgeo.segmenters"),
    help="The MASKs are photographs: have this plugin find their roads. `roadgeo info --plugins` lists them.",
)
@click.option("--threshold", metavar="T", type=float, help="Values above T are road. Default: told by the values.")
@click.option(
    "--band", metavar="N", type=click.IntRange(1), help="Band that holds the mask. Default: told by the bands."
)
@click.option("--gsd", metavar="LO:HI", type=RANGE, help="Metres per pixel at the middle. Default: 0.2:5.")
@click.option(
    "--max-tilt", metavar="DEG", type=click.FloatRange(0, 80), help="Greatest angle of the camera from the vertical."
)
@click.option(
    "--camera",
    metavar="PIXELS|exif",
    type=CAMERA,
    help="Focal length in pixels of the mask, or exif: as the photograph given by --image (else the mask) says.",
)
@click.option("--near", metavar="LON,LAT,RADIUS", type=NEAR, help="The middle lies within RADIUS metres of this place.")
@click.option(
    "--north-up", is_flag=True, help="The image's up is north: grid north of the reference, within 5 degrees."
)
@click.option(
    "--method",
    type=click.Choice(["auto", "pair"]),
    default="auto",
    show_default=True,
    help="auto: the best there is. pair: exactly the paper's matcher.",
)
@click.option(
    "--effort",
    type=click.Choice(["quick", "full"]),
    default="full",
    show_default=True,
    help="quick: leave out the search by roads alone, for masks that are broken or show few intersections.",
)
@click.option(
    "--time-limit",
    metavar="SECONDS",
    type=click.FloatRange(min=0, min_open=True),
    default=10.0,
    show_default=True,
    help="Stop searching for a mask after this time.",
)
@click.option(
    "--skip-existing/--overwrite",
    default=False,
    help="Keep results that are there and younger than their masks, or make them anew, the default.",
)
@click.option("-j", "--jobs", metavar="N", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@verbosity_options
def locate_command(
    masks: tuple[str, ...],
    references: tuple[str, ...],
    out_dir: str,
    as_json: bool,
    plot: bool,
    figure: str | None,
    report: bool,
    explain: bool,
    images: tuple[str, ...],
    products: tuple[str, ...],
    gcps: bool,
    crs: str | None,
    resolution: float | None,
    resampling: Literal["nearest", "bilinear", "cubic", "lanczos"],
    max_pixels: int,
    segmenter: str | None,
    threshold: float | None,
    band: int | None,
    gsd: tuple[float, float] | None,
    max_tilt: float | None,
    near: tuple[float, float, float] | None,
    north_up: bool,
    camera: float | str | None,
    method: Literal["auto", "pair"],
    effort: Literal["quick", "full"],
    time_limit: float,
    skip_existing: bool,
    jobs: int,
    quiet: bool,
    verbose: bool,
) -> int:
    """Find where road MASKs lie on a map, and draw them there.

    A mask is an image of the roads that an aerial picture shows: bright or 1 where there is road. Its size, heading,
    scale and camera need not be known; what is known shortens the search, and tells places apart that look alike. Give
    files, folders or patterns.

    \b
    For each located photo_mask.tif:
      photo_mask_footprint.tif   the mask, or its --image, on the map (Cloud Optimized GeoTIFF)
      photo_mask_location.gpkg   footprint, matched intersections, roads: opens styled in QGIS
      photo_mask_location.json   place, homography, odds; also written, with a reason, where nothing was found
      photo_mask_overlay.png     with --plot
      photo_mask_figure.pdf      with --figure pdf (or svg, png)
      photo_mask_report.html     with --report: map, mask, residuals and numbers; also where nothing was found
      photo_mask_explain.png     with --explain, and .json: why it was found there, or nowhere

    For several masks also roadgeo_summary.gpkg and roadgeo_summary.csv, all footprints in one, and with --report
    roadgeo_report.html, which lists them. What Ctrl-C cut short goes on with --skip-existing.

    \b
    With --also:
      gcps       the picture's own pixels with 25 control points (GeoTIFF)
      vrt        the same without copying pixels (GDAL virtual raster)
      points     control points for the QGIS Georeferencer
      odm        control points for OpenDroneMap
      worldfile  world file of the drawn raster
      geojson    footprint as of RFC 7946
      stac       STAC Item of the drawn raster
      kmz        ground overlay for Google Earth
      and what plugins offer (roadgeo info --plugins)

    \b
    Examples:
      roadgeo locate photo_mask.tif
      roadgeo locate masks/ --reference boston-ma --out-dir found --plot
      roadgeo locate *.png --json --jobs 4 > found.jsonl
      roadgeo locate photo_mask.png --image photo.tif --crs EPSG:3857 --also geojson --also points
      roadgeo locate mask.png --gsd 0.3:0.6 --near=-71.06,42.36,5000

    Exit status: 0 every mask located, 3 at least one not located, 1 error, 2 usage.
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.cli.progress import print_steps

    if figure is not None:
        from roadgeo.outputs.figure import has_matplotlib

        if not has_matplotlib():
            raise click.UsageError("--figure needs matplotlib: pip install 'roadgeo[plot]'.")
    if method == "pair" and (camera or gsd or near or north_up or max_tilt is not None):
        raise click.UsageError(
            "--method pair knows no --camera, --gsd, --max-tilt, --near or --north-up: leave them out."
        )
    focal_px = camera if isinstance(camera, float) else None
    options = make_options(method, gsd, max_tilt, near, north_up, time_limit, focal_px, effort)
    tasks = name_tasks(find_masks(masks))
    if not tasks:
        raise click.UsageError(f"No images in {', '.join(masks)}.")
    make_folder(out_dir)
    outputs = _make_outputs(crs, resolution, resampling, max_pixels, (*products, *(["gcps"] if gcps else [])))
    pictures = pair_images([task.mask for task in tasks], images)
    from_exif = camera == "exif"
    job = Job(
        references,
        options,
        outputs,
        out_dir,
        pictures,
        threshold,
        band,
        plot,
        figure,
        report,
        explain,
        segmenter,
        from_exif,
        skip_existing,
    )
    # Opened here too: what is wrong with them is said once, and the search is compiled before processes start.
    opened = open_references(references, print_steps(quiet))
    compile_once(opened[0], quiet)
    counts: Counter[Status] = Counter()
    documents = []
    with _progress(len(tasks), as_json, quiet) as advance:
        for outcome in run(tasks, job, jobs):
            counts[outcome.status] += 1
            documents.append(outcome.document)
            advance(counts)
            _report(outcome, as_json, quiet, verbose, single=len(tasks) == 1)
    if len(tasks) > 1:
        from roadgeo.outputs.summary import write_summary

        files = write_summary(Path(out_dir), documents)
        if report:
            files.append(_list_reports(Path(out_dir), tasks, documents, opened))
        if not quiet:
            click.echo(f"{summarize(counts)}; all footprints: {', '.join(map(str, files))}", err=True)
    return ERROR if counts["error"] else 0 if counts["located"] == len(tasks) else NOT_LOCATED


def make_options(
    method: Literal["auto", "pair"],
    gsd: tuple[float, float] | None,
    max_tilt: float | None,
    near: tuple[float, float, float] | None,
    north_up: bool,
    time_limit: float,
    focal_px: float | None = None,
    effort: Literal["quick", "full"] = "full",
) -> LocateOptions:
    """Put what was given in its place among the options of all stages; the rest stays as it is."""
    from dataclasses import replace

    from roadgeo.workflows import LocateOptions

    default = LocateOptions()
    known = replace(
        default.match.camera,
        gsd_m=gsd or default.match.camera.gsd_m,
        max_tilt_deg=default.match.camera.max_tilt_deg if max_tilt is None else max_tilt,
        north_up=north_up,
        focal_px=focal_px,
    )
    match = replace(default.match, camera=known)
    limits = replace(default.search, time_limit_s=time_limit)
    return replace(default, method=method, near=near, effort=effort, match=match, search=limits)


def _make_outputs(
    crs: str | None,
    resolution: float | None,
    resampling: Literal["nearest", "bilinear", "cubic", "lanczos"],
    max_pixels: int,
    products: Sequence[str],
) -> OutputOptions:
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.outputs.orthophoto import ImageOptions

    return OutputOptions(ImageOptions(crs, resolution, resampling, max_pixels), tuple(dict.fromkeys(products)))


def pair_images(masks: Sequence[str], images: Sequence[str]) -> dict[str, str]:
    """Say which photograph belongs to which mask.

    One photograph per mask in the same order, or a folder in which it has the mask's name, less a final "_mask".

    Raises
    ------
    click.UsageError
        Another number of photographs than of masks, or none in the folder.
    """
    if len(images) == 1 and Path(images[0]).is_dir():
        by_stem = {path.stem: str(path) for path in sorted(Path(images[0]).iterdir()) if path.suffix}
        stems = {mask: Path(mask).stem for mask in masks}
        found = {mask: by_stem.get(stem.removesuffix("_mask"), by_stem.get(stem)) for mask, stem in stems.items()}
        missing = [mask for mask, image in found.items() if image is None]
        if missing:
            raise click.UsageError(f"No photograph in {images[0]} has the name of {missing[0]}.")
        return {mask: image for mask, image in found.items() if image is not None}
    if images and len(images) != len(masks):
        raise click.UsageError(f"Got {len(masks)} masks and {len(images)} times --image, expected as many.")
    return dict(zip(masks, images, strict=False))


# --- one mask ---------------------------------------------------------------------------------------------------------


def describe(location: Location) -> str:
    """Say what was found, in a line or two."""
    status = click.style(location.status.replace("_", " "), fg="green" if location.located else "yellow")
    if not location.located or location.center is None:
        return f"{location.query}: {status}: {location.reason}"
    where = format_lonlat(location.center.lon, location.center.lat)
    return f"{location.query}: {status} at {where} on {location.reference}: {location.reason}"


def _failed(task: Task, reason: str) -> Outcome:
    from roadgeo.location import SCHEMA

    document = {"schema": SCHEMA, "query": task.mask, "status": "error", "reason": reason}
    return Outcome("error", document, f"{click.style('Error:', fg='red')} {reason}")


def _scale(picture: str, mask: RoadMask) -> float:
    """How many times the mask's width a picture's is."""
    from roadgeo.storage.rasters import open_raster

    with open_raster(picture) as source:
        width: int = source.width
    return round(width / mask.shape[1], 3)


def _draw(location: Location, mask: RoadMask, reference: Reference, pictures: Sequence[Path], attribution: str) -> None:
    """Draw the overlay and the figure, as their names tell."""
    from roadgeo.outputs.figure import write_figure
    from roadgeo.outputs.overlay import write_overlay

    index = reference.index
    roads = index.plane.to_crs(index.segments.reshape(-1, 2).astype(float)).reshape(-1, 4)
    for path in pictures:
        write = write_overlay if path.stem.endswith("_overlay") else write_figure
        write(path, location, mask, roads, attribution)


def _write_explanation(
    explanation: Explanation, mask: RoadMask, references: Sequence[Reference], paths: OutputPaths
) -> list[Path]:
    from roadgeo.outputs.explanation_sheet import write_explanation_picture
    from roadgeo.storage.files import write_text

    told = explanation.nearest
    reference = next((one for one in references if one.name == told.reference), references[0])
    write_text(paths.explanation, json.dumps(explanation.to_dict(), indent=2, allow_nan=False) + "\n")
    write_explanation_picture(paths.explanation_picture, explanation, mask, reference.index)
    return [paths.explanation, paths.explanation_picture]


def _list_reports(
    folder: Path, tasks: Sequence[Task], documents: Sequence[dict[str, Any]], references: Sequence[Reference]
) -> Path:
    """Write the page that links to the reports of all masks."""
    from roadgeo.outputs.paths import output_paths
    from roadgeo.outputs.report import Entry, write_batch

    paths = [output_paths(folder, task.stem).report for task in tasks]
    there = [path.exists() and document["status"] != "error" for path, document in zip(paths, documents, strict=True)]
    links = [path.name if here else "" for path, here in zip(paths, there, strict=True)]
    page = folder / "roadgeo_report.html"
    write_batch(page, list(map(Entry, documents, links)), [one.index for one in references])
    return page


# --- printing ---------------------------------------------------------------------------------------------------------


def summarize(counts: Counter[Status]) -> str:
    """Say how many masks came to what."""
    parts = [f"{counts['located']} located"]
    if counts["ambiguous"]:
        parts.append(f"{counts['ambiguous']} ambiguous")
    parts.append(f"{counts['not_located']} not located")
    if counts["error"]:
        parts.append(f"{counts['error']} failed")
    return ", ".join(parts)


def _report(outcome: Outcome, as_json: bool, quiet: bool, verbose: bool, single: bool) -> None:
    if as_json:
        click.echo(json.dumps(outcome.document))
    if outcome.status == "error":
        click.echo(" ".join(outcome.text.split()), err=True)
        return
    if quiet:
        return
    click.echo(outcome.text, err=as_json)
    if verbose:
        click.echo(_details(outcome.document), err=as_json)
    if (single or verbose) and outcome.status == "located":
        click.echo("  wrote " + ", ".join(outcome.files), err=as_json)


def _details(document: dict[str, Any]) -> str:
    seconds = ", ".join(f"{step} {value:.3f}" for step, value in document["seconds"].items())
    stats = ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in document["stats"].items())
    return f"  seconds: {seconds}\n  {stats}"


def _progress(total: int, as_json: bool, quiet: bool) -> AbstractContextManager[Callable[[Counter[Status]], None]]:
    """Show a bar on standard error, where that is a terminal that JSON does not fill and there are several masks.

    Programs that set ROADGEO_PROGRESS=json, as the QGIS plugin does, get lines of JSON instead.
    """
    import sys

    if os.environ.get("ROADGEO_PROGRESS") == "json":
        from roadgeo.cli.progress import print_progress

        return print_progress(total, summarize)
    if quiet or total < 2 or not sys.stderr.isatty() or (as_json and sys.stdout.isatty()):
        return nullcontext(lambda _: None)
    from roadgeo.cli.progress import show_progress

    return show_progress(total, summarize)
