"""`roadgeo evaluate`: how well masks are located on a reference."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from roadgeo._options import OTHERS, option, part, take
from roadgeo._text import visible
from roadgeo.cli.command_line import made_by
from roadgeo.cli.options import Known, Method, Shared, Verbosity, argument, command, hinted, make_options
from roadgeo.cli.printing import echo, is_set, tell
from roadgeo.cli.progress import count_up
from roadgeo.cli.queries import Queries, query_sets

if TYPE_CHECKING:
    from rich.table import Table

    from roadgeo.evaluation.scoring import Evaluation, Summary
    from roadgeo.evaluation.survey import Survey
    from roadgeo.evaluation.trials import QuerySet, ReferenceLocator
    from roadgeo.evaluation.truth import Truth
    from roadgeo.matching.index import ReferenceIndex

__all__ = ["evaluate_command"]


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """The parameters of `roadgeo evaluate`."""

    reference: str = argument("REF", type=None)
    queries: Path | None = option("--queries", "PATH", OTHERS, "A query set: its folder, or its table.",
        type=click.Path(exists=True, path_type=Path))
    drawn: Queries = part(Queries)
    how: Method = part(Method)
    gsd_m: tuple[float, float] | None = take(Known, "gsd_m", names="--known-gsd",
        help="Pixel size as it is told to the search, metres.")
    known: Known = part(Known, "max_tilt_deg", "north_up", "effort", "time_limit_s")
    radius: float = option("--radius", "METRES", OTHERS, "Right if nearer.",
        limits=(0.01, None), default=20.0, show_default=True, rare=True)
    jobs: int = take(Shared, "jobs", help="Processes.")
    as_map: bool = option("--map", "", OTHERS, "Map where such masks (of the first --noise) are located.")
    height: float | None = option("--height", "METRES", OTHERS, "Above ground, in place of --gsd: height/focal.",
        limits=(1, None), rare=True)
    check: int = option("--check", "N", OTHERS,
        "With --map: try N other masks and count those located in each class.", limits=(0, None), default=0, rare=True)
    out_dir: str | None = take(Shared, "out_dir", help="Write here, and go on from here.", default=None)
    as_json: bool = take(Shared, "as_json", help="Print the figures as one JSON object.", group=OTHERS)
    verbosity: Verbosity = part(Verbosity, "quiet")
# fmt: on


@command("evaluate", Evaluate)
def evaluate_command(asked: Evaluate) -> None:
    """Locate masks whose place is known, and count.

    Without --queries the masks are drawn as `roadgeo simulate` draws them. With --out-dir the folder gets
    evaluation.json, masks.csv, report.html and trials.jsonl, from which the same command goes on when it was
    interrupted. A table of your own needs the columns file, crs, width, height and h00 to h22, the homography from
    pixels to the CRS.

    With --map masks are tried all over the map (-n of them, by default 600), and REF_localizability.tif (styled in
    QGIS), .png and .json show where they would be located, may be ambiguous, or show too few intersections.

    \b
    Examples:
      roadgeo evaluate boston-ma -j 2
      roadgeo evaluate boston-ma --noise poor --tilt 30:50 --mirrored 100 -o evaluation
      roadgeo evaluate boston-ma --roads city_centerlines.geojson --noise clean
      roadgeo evaluate boston-ma --queries queries/truth.csv --method pair
      roadgeo evaluate boston-ma --map --height 400 --focal 2000 --size 1200 --noise segmented --check 300
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.evaluation.trials import ReferenceLocator
    from roadgeo.reference.library import resolve_whole
    from roadgeo.storage.files import make_folder

    _refuse_idle("--map" if asked.as_map else "" if asked.queries is None else "--queries")
    path, folder = resolve_whole(asked.reference), None if asked.out_dir is None else Path(asked.out_dir)
    if folder is not None:
        make_folder(folder)
    drawn, known = asked.drawn, replace(asked.known, gsd_m=asked.gsd_m)
    if asked.height is not None:
        drawn = replace(drawn, gsd=(asked.height / (drawn.focal or drawn.size),) * 2)
    compile_once()
    locator = ReferenceLocator((path,), make_options(known, asked.how))
    told = {_HINTED[name]: value for name, value in hinted(known).items() if value != "full"}
    thresholds = {"paper": asked.how.paper, "pair": " ".join(asked.how.pair)}
    about = {
        "reference": path.stem,
        "method": asked.how.method,
        **{key: value for key, value in thresholds.items() if value},
        **told,
    }
    if asked.as_map:
        survey = _survey(locator, drawn, about)
        survey = replace(survey, check=asked.check, jobs=asked.jobs, out_dir=folder, counting=count_up)
        _write_map(survey)
        return
    query_set, settings = _query_set(path, asked.queries, drawn)
    _evaluate(query_set, locator, settings | about, asked.radius, asked.jobs, folder)


#: Names of the search's hints in the settings of an evaluation.
_HINTED = {"gsd_m": "known_gsd", "max_tilt_deg": "max_tilt"} | {
    key: key for key in ("north_up", "effort", "time_limit_s")
}


def _survey(locator: ReferenceLocator, drawn: Queries, about: dict[str, Any]) -> Survey:
    """Put together what a map of localizability is made with."""
    from roadgeo.evaluation.survey import ANY, Survey

    trials = drawn.count or 600
    ((simulation, _), *_) = query_sets(replace(drawn, intersections=ANY))
    settings = _settings(drawn) | {"count": trials, "noise": simulation.kind} | about
    settings = {name: value for name, value in settings.items() if name not in ("intersections", "mirrored")}
    return Survey(locator.references[0], simulation, locator, trials, settings=settings)


def _settings(drawn: Queries) -> dict[str, Any]:
    """Return the settings of an evaluation that the masks to draw are."""
    return {name: value for name, value in vars(drawn).items() if value is not None and name != "roads"}


#: Parameters without an effect beside an option, or without --map.
_IDLE = {
    "": {"check"},
    "--queries": {*(each.name for each in fields(Queries)), "check", "height"},
    "--map": {"intersections", "mirrored", "queries", "radius", "roads"},
}


def _refuse_idle(beside: str) -> None:
    """Refuse options that would silently do nothing."""
    context = click.get_current_context()
    idle = [
        parameter.opts[-1]
        for parameter in context.command.params
        if parameter.name in _IDLE[beside]
        and context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
    ]
    if idle:
        raise click.UsageError(f"{', '.join(idle)} {'does nothing with ' + beside if beside else 'needs --map'}.")


def _evaluate(
    queries: QuerySet,
    locator: ReferenceLocator,
    settings: dict[str, Any],
    radius: float,
    jobs: int,
    out_dir: Path | None,
) -> None:
    """Locate all queries; write and print what that shows."""
    from roadgeo.evaluation.scoring import evaluate
    from roadgeo.evaluation.trials import run_trials

    # Locate: each answer is written down as it comes, so that the same command goes on where one was stopped.
    record = None if out_dir is None else out_dir / "trials.jsonl"
    before = _recorded(record)
    started = time.perf_counter()
    try:
        with count_up(len(queries)) as count:
            trials = run_trials(queries, locator, jobs, record, settings, count)
    except KeyboardInterrupt:
        if record is not None:
            echo(f"{_recorded(record)} of {len(queries)} masks are kept; the same command goes on.", err=True)
        raise
    elapsed = time.perf_counter() - started

    # Score, write, print.
    truths = [trial.truth for trial in trials]
    evaluation = evaluate(truths, [trial.answer for trial in trials], settings, radius)
    document = evaluation.to_dict() | _made_of(locator)
    if out_dir is not None:
        from roadgeo.evaluation.report import masks_to_csv, render_report
        from roadgeo.storage.files import write_text

        title = f"{settings['reference']}: {len(trials)} masks"
        write_text(out_dir / "evaluation.json", json.dumps(document, indent=1) + "\n")
        write_text(out_dir / "masks.csv", masks_to_csv(evaluation))
        page = render_report(evaluation, truths, title, _maps_of(locator, truths))
        write_text(out_dir / "report.html", page)
    if is_set("as_json"):
        echo(json.dumps({name: part for name, part in document.items() if name != "scores"}))
    elif not is_set("quiet"):
        _print(evaluation)
        earlier = f" ({before} of them recorded before)" if before else ""
        where = f"; see {out_dir}" if out_dir else ""
        echo(f"{len(trials)} masks{earlier} in {elapsed:.1f} s{where}", err=True)


def _maps_of(locator: ReferenceLocator, truths: Sequence[Truth]) -> list[ReferenceIndex]:
    """Return the maps, or of a divided one the parts, that the masks lie on."""
    from roadgeo.geometry.projection import to_lonlat
    from roadgeo.reference.opening import open_reference

    placed = [truth for truth in truths if truth.on_map and truth.crs is not None]
    there = [to_lonlat(str(truth.crs), truth.center).tolist() for truth in placed]
    return [index for path in locator.references for index in open_reference(path).indexes_at(there)]


def _made_of(locator: ReferenceLocator) -> dict[str, Any]:
    """Return the origin that a JSON names."""
    from roadgeo.reference.files import reference_digest

    return made_by() | {"reference_digest": ", ".join(map(reference_digest, locator.references)) or None}


def _recorded(record: Path | None) -> int:
    """Count the trials in a record."""
    if record is None or not record.is_file():
        return 0
    return max(record.read_text(encoding="utf-8").count("\n") - 1, 0)


def _query_set(reference: Path, queries: Path | None, drawn: Queries) -> tuple[QuerySet, dict[str, Any]]:
    """Choose between a query set on disk and one to draw, and report it."""
    from roadgeo.evaluation.trials import DrawnMasks, MaskFiles, count_elsewhere
    from roadgeo.evaluation.truth import read_truth

    if queries is None:
        drawn_from = {} if drawn.roads is None else {"roads": drawn.roads.name}
        return DrawnMasks(reference, query_sets(drawn), drawn.roads), _settings(drawn) | drawn_from
    table = queries / "truth.csv" if queries.is_dir() else queries
    truths = read_truth(table)
    elsewhere = count_elsewhere(truths, reference)
    if elsewhere:
        echo(
            f"Warning: the places of {elsewhere} of {len(truths)} masks are not on {reference.stem}; they count against"
            " recall. In a table of truths, on_map False says that a mask has no place there.",
            err=True,
        )
    return MaskFiles(table.parent, tuple(truths)), {"queries": str(queries)}


def _write_map(survey: Survey) -> None:
    """Make the map of localizability; print how much of it promises what."""
    from roadgeo.evaluation.survey import write_survey

    summary, files = write_survey(survey, survey.out_dir or Path(), _made_of(survey.locator))
    if is_set("as_json"):
        echo(json.dumps(summary))
        return
    for entry in summary["classes"]:
        line = f"{entry['label']:<28} {100 * entry['area_share']:5.1f} % of the map"
        if entry["located"]:
            line += f"; located there: {entry['located']['hits']} of {entry['located']['of']}"
        tell(line)
    if not summary["classes"][0]["area_share"]:
        tell(
            "No promise can be made anywhere: too few masks were located, or tried; a larger -n, wider windows or"
            " better masks may help."
        )
    tell(f"wrote {files[0]}, {', '.join(path.suffix for path in files[1:])}", err=True)


# --- printing ---------------------------------------------------------------------------------------------------------


def _print(evaluation: Evaluation) -> None:
    from rich.console import Console

    from roadgeo.evaluation.report import TITLES, verdicts

    console = Console(width=None if sys.stdout.isatty() else 100)
    for by, groups in evaluation.breakdowns.items():
        console.print(_table(TITLES[by], [*groups, evaluation.total] if by == "kind" else groups))
    for line in verdicts(evaluation):
        console.print(line, highlight=False, markup=False)


def _table(title: str, groups: Sequence[Summary]) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    from roadgeo.evaluation.report import summary_table

    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    heads, rows = summary_table(groups)
    for head in heads:
        table.add_column(head, justify="right" if head else "left", no_wrap=True)
    for cells in rows:
        table.add_row(*(escape(visible(cell)) for cell in cells))
    return table
