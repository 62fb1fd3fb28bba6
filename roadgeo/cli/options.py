"""Options of the commands: their types, those that several commands share, and how their help is laid out."""

from __future__ import annotations

import inspect
import os
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, reduce
from typing import TYPE_CHECKING, Any, TypeVar

import click

from roadgeo.cli.fencing import OWN_PROCESS, enter_fence
from roadgeo.cli.printing import echo, keep_switch
from roadgeo.matching.hints import (
    HINTS,
    STATED,
    Hint,
    apply_hints,
    asked_of_camera,
    read_box,
    read_gsd,
    read_place,
    read_range,
)
from roadgeo.storage.memory import MEMORY

if TYPE_CHECKING:
    from roadgeo.matching.options import LocateOptions
    from roadgeo.reference.opening import AnyReference
    from roadgeo.running.cluster import Cluster
    from roadgeo.running.options import ReadOptions
    from roadgeo.running.tasks import Task

__all__ = [
    "BOX",
    "CRS",
    "GSD",
    "IMAGE",
    "NEAR",
    "OTHERS",
    "RANGE",
    "RESULTS",
    "SEARCH",
    "Command",
    "Once",
    "Plugin",
    "Read",
    "each",
    "find_tasks",
    "hinted",
    "installed",
    "make_cluster",
    "make_options",
    "n_threads",
    "open_maps",
    "read_options",
    "row",
    "take",
]

Decorated = TypeVar("Decorated", bound=Callable[..., Any])

_MAX_THREADS = 4

#: Heading of options that stand under no other.
OTHERS = "Others"


# --- help in groups ---------------------------------------------------------------------------------------------------

#: Whether all of the help is shown, among what click's contexts share.
_WHOLE = "roadgeo.help-all"


class _Option(click.Option):
    """An option with the heading that it stands under; one that is rarely wanted is explained by --help-all only."""

    def __init__(
        self, *names: Any, group: str = OTHERS, rare: bool = False, hint: Hint | None = None, **settings: Any
    ) -> None:
        super().__init__(*names, **settings)
        self.group, self.rare, self.hint = group, rare, hint

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return names and help; but for --help-all the first sentence of the help only."""
        record = super().get_help_record(ctx)
        if record is None:
            return None
        names, text = record
        if getattr(ctx.command, "is_long", False) and not ctx.meta.get(_WHOLE, False):
            default = re.search(r"\[default: [^\];]*", text)
            text = re.split(r"(?<=[^.]\.) ", self.help or "")[0] + (f"  {default[0]}]" if default else "")
        return names, text


class Once(click.Command):
    """A command that takes an option twice only where each time counts."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read its options.

        Raises
        ------
        click.UsageError
            One is given twice, and one of them would be ignored.
        """
        if not ctx.resilient_parsing:
            _, _, given = self.make_parser(ctx).parse_args(list(args))
            for param, times in Counter(given).items():
                is_switch = isinstance(param, click.Option) and param.is_flag and not param.secondary_opts
                if times > 1 and param.nargs == 1 and not (is_switch or getattr(param, "multiple", False)):
                    raise click.UsageError(f"{max(param.opts, key=len)} is given {times} times: give it once.", ctx)
        return super().parse_args(ctx, args)


class Command(Once):
    """A command whose help lists its options in groups, and leaves what is rarely wanted to --help-all.

    --help-all shows besides what stands in the help below a form feed, and `more`, below the options.

    It runs inside a fence, unless it fences in others itself (`cli.fencing`).
    """

    def __init__(self, *args: Any, more: str | Callable[[], str] = "", is_fenced: bool = True, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.more, self.is_fenced = more, is_fenced
        self.params += _options_of_the_fence() if is_fenced else []
        self.is_long = (
            bool(more) or "\f" in (self.help or "") or any(getattr(param, "rare", False) for param in self.params)
        )
        if self.is_long:
            text = "Show this message with all options."
            self.params.append(
                _Option(["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_show_all, help=text)
            )

    def invoke(self, ctx: click.Context) -> Any:
        """Run it, fenced in where the process is ours."""
        if ctx.obj is OWN_PROCESS and self.is_fenced:
            enter_fence(str(self.name), ctx.params, ctx.meta.get(_ALLOWED, ()))
        return super().invoke(ctx)

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what the command does."""
        first, _, rest = inspect.cleandoc(self.help or "").partition("\f")
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text(f"{first.strip()}\n\n{rest.strip()}" if ctx.meta.get(_WHOLE, False) else first)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the options in groups; of those left out the names alone."""
        whole = ctx.meta.get(_WHOLE, False)
        groups: dict[str, list[tuple[str, str]]] = {}
        left_out: dict[str, list[str]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None or not isinstance(parameter, click.Option):
                continue
            group = getattr(parameter, "group", OTHERS)
            if getattr(parameter, "rare", False) and not whole:
                left_out.setdefault(group, []).append(max(parameter.opts, key=len))
                groups.setdefault(group, [])
            else:
                groups.setdefault(group, []).append(record)
        groups[OTHERS] = groups.pop(OTHERS, [])  # the options of all commands come last
        for group, records in groups.items():
            with formatter.section(group):
                if records:
                    formatter.write_dl(records, col_max=24)
                if left_out.get(group):
                    names = "and " + ", ".join(left_out[group])
                    room = formatter.width - formatter.current_indent
                    lines = textwrap.wrap(names, room, break_on_hyphens=False)
                    formatter.write("".join(f"{'':{formatter.current_indent}}{line}\n" for line in lines))
        if whole and self.more:
            formatter.write_paragraph()
            formatter.write(self.more() if callable(self.more) else self.more)


def _show_all(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        ctx.meta[_WHOLE] = True
        echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


#: Under which what --allow names is kept among what click's contexts share.
_ALLOWED = "roadgeo.allowed"


def _keep_allowed(ctx: click.Context, _: click.Parameter, paths: tuple[str, ...]) -> None:
    ctx.meta[_ALLOWED] = paths


def _keep_memory(_: click.Context, __: click.Parameter, most: float | None) -> None:
    if most is not None:
        os.environ[MEMORY] = f"{most:g}"  # for processes that are started, too


def _options_of_the_fence() -> list[click.Parameter]:
    """Make the options of all commands that read strangers' files."""
    allow = "Also read what files name in this folder, as a virtual raster names others. Repeatable. Default: nothing."
    memory = (
        "Most memory that the reading of a file takes. Default: 1, and 100 times the file; at most half that is free."
    )
    more: dict[str, Any] = {"expose_value": False, "rare": True}
    return [
        _Option(["--allow"], metavar="FOLDER", type=click.Path(exists=True), multiple=True, callback=_keep_allowed,
            help=allow, **more),
        _Option(["--memory"], metavar="GB", type=click.FloatRange(0.1), callback=_keep_memory, help=memory, **more),
    ]  # fmt: skip


def row(names: str, shown: str | tuple[str, ...] | None, group: str, text: str, **more: Any) -> Callable[..., Any]:
    """Make an option from a row of a table. It decorates a command; keywords given with the command replace its own.

    Parameters
    ----------
    names : str
        As click has them, with spaces between: "-j --jobs".
    shown : str, tuple of str or None
        What stands for its value (None: its type), or the words among which one chooses; "" for a switch.
    group : str
        Under which heading of the help it stands.
    text : str
        Its help; all behind the first sentence is shown by --help-all only.
    **more
        As for `click.option`; `rare`.
    """
    kind: dict[str, Any] = {"type": click.Choice(shown)} if isinstance(shown, tuple) else {"metavar": shown}
    settings = {**({"is_flag": True} if shown == "" else kind), "group": group, "help": text, **more}

    def add(command: Decorated, **own: Any) -> Decorated:
        return click.option(*names.split(), cls=_Option, **(settings | own))(command)

    return add


def each(decorators: Iterable[Callable[[Decorated], Decorated]]) -> Callable[[Decorated], Decorated]:
    """Put options upon a command, in their order."""

    def add(command: Decorated) -> Decorated:
        return reduce(lambda decorated, add: add(decorated), reversed([*decorators]), command)

    return add


# --- types ------------------------------------------------------------------------------------------------------------


class Read(click.ParamType):  # type: ignore[type-arg]  # generic only in late versions of click
    """Whatever a function reads from a text; a value that is no text was read before.

    Parameters
    ----------
    read : callable
        Takes the text; raises ValueError or a RoadgeoError with the value got and the one expected.
    """

    def __init__(self, name: str, read: Callable[[str], Any]) -> None:
        self.name, self.read = name, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read it.

        Raises
        ------
        click.BadParameter
            It cannot be read.
        """
        from roadgeo.errors import RoadgeoError

        if not isinstance(value, str):
            return value
        try:
            return self.read(value)
        except (ValueError, RoadgeoError) as error:
            self.fail(str(error), param, ctx)


class Plugin(click.ParamType):  # type: ignore[type-arg]
    """The name of a plugin, and with `has_argument` a colon and its argument: "osm:Boston, MA".

    `names` gives the names that are known; a file that ends as `file_ending` says is taken too.
    """

    name = "plugin"

    def __init__(self, names: Callable[[], Sequence[str]], has_argument: bool = False, file_ending: str = "") -> None:
        self.names, self.has_argument, self.file_ending = names, has_argument, file_ending

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Check that it is there; nothing of it is imported or read.

        Raises
        ------
        click.BadParameter
            It is not, or the colon is missing.
        """
        text = str(value)
        if self.file_ending and text.lower().endswith(self.file_ending):
            if not os.path.isfile(text):  # noqa: PTH113 (names may hold what Path refuses)
                self.fail(f"no such model file: {text}", param, ctx)
            return text
        name, colon, _ = text.partition(":")
        installed = self.names()
        if name not in installed or bool(colon) != self.has_argument:
            expected = ", ".join(f"{plugin}:WHERE" if self.has_argument else plugin for plugin in installed)
            self.fail(f"got {text!r}, expected one of {expected}", param, ctx)
        return text

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Any]:  # noqa: ARG002
        """Offer the names that begin so."""
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]


def installed(group: str) -> list[str]:
    """Name the plugins of a group."""
    from roadgeo.plugins import find_plugins

    return sorted(find_plugins(group))


def _read_bands(text: str) -> tuple[int, ...]:
    numbers = [int(part) if part.strip().isdecimal() else 0 for part in text.split(",")]
    if len(numbers) != 3 or min(numbers) < 1:
        raise ValueError(f"got {text!r}, expected R,G,B: three numbers from 1")
    return tuple(numbers)


def _read_crs(text: str) -> str:
    from roadgeo.storage.crs import name_crs

    return name_crs(text)


#: Two numbers, least and greatest; a pixel size; a place and a radius; a box in degrees.
RANGE, GSD, NEAR, BOX = (
    Read("range", read_range),
    Read("gsd", read_gsd),
    Read("near", read_place),
    Read("box", read_box),
)
CRS = Read("CRS", _read_crs)


# --- options that commands share --------------------------------------------------------------------------------------

RESULTS = "The results"
WHERE, IMAGE, SEARCH = HINTS["near"].group, HINTS["gsd"].group, HINTS["effort"].group


def _hint_option(name: str, command: Decorated, **own: Any) -> Decorated:
    """Add the option of a hint."""
    hint = HINTS[name]
    shown = tuple(hint.form.split("|")) if name == "effort" else hint.form
    names = [own.pop("called", hint.option), hint.goes_to]
    kind = {"default": None} if shown == "" else {} if name == "effort" else {"type": Read(name, hint.read)}
    decorated: Decorated = row(" ".join(names), shown, hint.group, hint.told, hint=hint, **kind)(command, **own)
    return decorated


_SEGMENT = "Which images are photographs, whose roads are found first: those that look so, all, or none. Default: auto."

#: Switches that are for whoever prints, not for the command.
_KEPT: dict[str, Any] = {"expose_value": False, "callback": keep_switch}

#: Options of several commands by the names that `take` takes; rows as of `row`.
_SHARED = {
    "references": row("-r --reference references", "REF", WHERE,
        "Map to search: REF.gpkg, or a name in the library. Repeatable. Default: all of the library.",
        type=click.Path(), multiple=True),
    "out_dir": row("-o --out-dir", "DIR", RESULTS,
        "Folder for the results; made if missing. Default: here.",
        type=click.Path(file_okay=False), default="."),
    "json": row("--json as_json", "", OTHERS, "Print one JSON object per image and line.", **_KEPT),
    "crs": row("--crs", "CRS", RESULTS, "CRS of what is drawn: EPSG:3857. Default: the map's own, metric.", type=CRS),
    "resolution": row("--resolution", "SIZE", RESULTS,
        "Pixel size of what is drawn, in units of its CRS. Default: the picture's own.",
        type=click.FloatRange(min=0, min_open=True), rare=True),
    "resampling": row("--resampling", ("nearest", "bilinear", "cubic", "lanczos"), RESULTS,
        "How values between pixels are found; nearest for classes.", default="cubic", show_default=True, rare=True),
    "compression": row("--compression", ("deflate", "zstd", "jpeg", "webp"), RESULTS,
        "Compression of rasters. jpeg and webp, for photographs only, make them five times smaller, with some loss.",
        default="deflate", show_default=True, rare=True),
    "segment": row("--segment", ("auto", "always", "never"), IMAGE, _SEGMENT, default="auto", rare=True),
    "segmenter": row("--segmenter", "NAME|MODEL.onnx", IMAGE,
        "Who finds the roads of photographs: a plugin (`roadgeo --plugins`), or a model as QGIS Deepness or "
        "STAC describe them. Default: the model that ships.",
        type=Plugin(partial(installed, "roadgeo.segmenters"), file_ending=".onnx"), rare=True),
    "class_name": row("--class class_name", "NAME|N", IMAGE,
        "Class of the model that is road, or its number in a map of classes. Default: by the names.", rare=True),
    "threshold": row("--threshold", "T", IMAGE,
        "Values above T are road; of photographs, probabilities. Default: by the values.", type=float, rare=True),
    "band": row("--band", "N", IMAGE,
        "Band that holds the mask. Default: by the bands.", type=click.IntRange(1), rare=True),
    "bands": row("--bands", "R,G,B", IMAGE,
        "Red, green and blue band of photographs: 3,2,1. Default: by their names, or the first three.",
        type=Read("bands", _read_bands), rare=True),
    "recursive": row("--recursive", "", IMAGE, "Also take the images of folders within folders."),
    "jobs": row("-j --jobs", "N", SEARCH,
        "Processes that locate at the same time. For one image alone, threads. Results do not depend on it. "
        "Default: 1.", type=click.IntRange(1), default=1, show_default=False),
    "method": row("--method", ("auto", "pair"), SEARCH,
        "auto: the best there is, the default. pair: the matcher of the paper that roadgeo began with, for comparison.",
        default="auto", rare=True),
    "paper": row("--paper", "", SEARCH,
        "With --method pair: the paper to the letter. Without it matches are one to one, cameras are real, and places"
        " are refined.", rare=True),
    "pair": row("--pair", "NAME=VALUE", SEARCH,
        "With --method pair: one of its thresholds, by the paper's symbols, such as delta=0.2 or d_max_m=1500."
        " Repeatable.", multiple=True, rare=True),
    "engine": row("--engine", ("local", "dask"), SEARCH,
        "Where it is done: in --jobs processes here, the default, or on a Dask cluster of as many workers, which "
        "survives their death. Needs dask and distributed.", rare=True),
    "scheduler": row("--scheduler", "ADDRESS", SEARCH,
        "Use the Dask cluster at this address, tcp://10.0.0.1:8786. Its workers see the same files.", rare=True),
    "mavlink": row("--mavlink", "URL", OTHERS, "Also send places to an autopilot, to such as udpout:127.0.0.1:14550."),
    "quiet": row("-q --quiet", "", OTHERS, "Say nothing but errors, and what --json prints.", **_KEPT),
    "verbose": row("-v --verbose", "", OTHERS, "Say more: numbers, times, files read.", **_KEPT),
}  # fmt: skip

#: Several that go together.
_TOGETHER = {
    "segmenting": ("segment", "segmenter", "class_name"),
    "mask_values": ("threshold", "band", "bands"),
    "cluster": ("engine", "scheduler"),
    "methods": ("method", "paper", "pair"),
    "verbosity": ("quiet", "verbose"),
}


def take(*names: str, **settings: Any) -> Callable[[Decorated], Decorated]:
    """Add options of the tables by their names; `settings` replace the tables' settings of a single one."""

    def add_all(command: Decorated) -> Decorated:
        for name in reversed([option for given in names for option in _TOGETHER.get(given, (given,))]):
            add = partial(_hint_option, name) if name in HINTS else _SHARED[name]
            command = add(command, **settings)
        return command

    return add_all


# --- what the options come to -----------------------------------------------------------------------------------------


def hinted(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the hints on the image, out of all parameters; a switch that was not set is left out."""
    names = (hint.goes_to for hint in HINTS.values())
    return {name: given[name] for name in names if given.get(name) is not None and given[name] is not False}


def make_options(
    hints: Mapping[str, Any],
    method: Any = "auto",
    *,
    paper: bool = False,
    pair: Sequence[str] = (),
    may_be_stated: bool = False,
) -> LocateOptions:
    """Put what was given in its place among the options of all stages; the rest stays as it is.

    Raises
    ------
    click.UsageError
        The paper's method knows no hints; only that method has its thresholds. What the camera states is for single
        images.
    """
    from dataclasses import replace

    from roadgeo.matching.paper import PAPER, PairOptions, read_options
    from roadgeo.workflows import LocateOptions

    if not may_be_stated:
        refuse_stated(hints)
    if method == "pair":
        idle = [hint for hint in HINTS.values() if hint.group != SEARCH and hints.get(hint.goes_to, False) is not False]
        if idle:
            raise click.UsageError(f"--method pair takes no {', '.join(hint.option for hint in idle)}: leave it out.")
    elif paper or pair:
        raise click.UsageError("--paper and --pair go with --method pair.")
    try:
        thresholds = read_options(pair, PAPER if paper else PairOptions())
    except ValueError as error:
        raise click.UsageError(f"--pair {error}.") from error
    return apply_hints(replace(LocateOptions(), method=method, pair=thresholds), hints)


def refuse_stated(hints: Mapping[str, Any]) -> None:
    """Refuse what the camera is to state, where there is not one image at a time.

    Raises
    ------
    click.UsageError
        There is such a hint.
    """
    stated = asked_of_camera(hints)
    if stated:
        option = next(hint.option for hint in HINTS.values() if hint.goes_to in stated)
        raise click.UsageError(f"{option} {STATED} is for `locate`: give the value here, or leave it out.")


def find_tasks(images: Sequence[str], given: Mapping[str, Any], out_dir: str | None = None) -> list[Task]:
    """Return a task for each image that is named.

    Raises
    ------
    click.UsageError
        There is no image.
    """
    from roadgeo.running.tasks import find_masks, name_tasks
    from roadgeo.storage.rasters import name_page

    paths = [name_page(name, given.get("page")) for name in find_masks(images, given["recursive"])]
    if not paths:
        raise click.UsageError(f"No images in {', '.join(images)}.")
    return name_tasks(paths, out_dir)


def open_maps(names: Sequence[str], near: tuple[float, float, float] | None = None) -> list[AnyReference]:
    """Open references, so that their errors are printed once, and make the kernels ready before processes start.

    Raises
    ------
    click.UsageError
        The place of --near lies on no map, but would with longitude and latitude exchanged.
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.cli.progress import print_steps
    from roadgeo.reference.opening import open_references, swapped_near

    references = open_references(names, print_steps())
    meant = None if near is None else swapped_near(near, references)
    if near is not None and meant is not None:
        raise click.UsageError(
            f"--near={near[0]:.9g},{near[1]:.9g},{near[2]:g} lies on none of the maps; longitude comes first:"
            f" did you mean --near={meant[0]:.9g},{meant[1]:.9g},{meant[2]:g}?"
        )
    compile_once()
    return references


def n_threads(jobs: int = 1) -> int:
    """Return how many threads a model gets."""
    return 1 if jobs > 1 else min(os.cpu_count() or 1, _MAX_THREADS)


def read_options(given: Mapping[str, Any], jobs: int = 1) -> ReadOptions:
    """Put together how what is given is read."""
    from dataclasses import fields

    from roadgeo.running.options import ReadOptions

    stated = {field.name: given[field.name] for field in fields(ReadOptions) if given.get(field.name) not in (None, ())}
    return ReadOptions(**{**stated, "threads": n_threads(jobs)})


def make_cluster(given: Mapping[str, Any], jobs: int) -> Cluster | None:
    """Return the cluster that was asked for, None for processes of this machine.

    Raises
    ------
    click.UsageError
        A scheduler and another engine.
    """
    if given["scheduler"] is None and given["engine"] != "dask":
        return None
    if given["engine"] == "local":
        raise click.UsageError("--scheduler goes with --engine dask.")
    from roadgeo.running.cluster import Cluster

    return Cluster(given["scheduler"], jobs, bool(given.get("divide_map")))
