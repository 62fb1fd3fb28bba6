"""Options of the commands: their types, those that several commands share, and the layout of their help."""

from __future__ import annotations

import inspect
import os
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, replace
from functools import partial, wraps
from types import NoneType, SimpleNamespace, UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

import click

from roadgeo._options import IMAGE, OTHERS, RESULTS, SEARCH, WHERE, among, option
from roadgeo.cli.fencing import OWN_PROCESS, enter_fence
from roadgeo.cli.printing import echo, keep_switch
from roadgeo.geometry.areas import Box
from roadgeo.matching.hints import HINTS, STATED, Hint, apply_hints, asked_of_camera
from roadgeo.outputs.registry import offered
from roadgeo.storage.memory import MEMORY

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from roadgeo.matching.options import LocateOptions
    from roadgeo.reference.opening import AnyReference
    from roadgeo.running.cluster import Cluster
    from roadgeo.running.options import ReadOptions
    from roadgeo.running.tasks import Task

__all__ = [
    "Command",
    "Engine",
    "Known",
    "Method",
    "Once",
    "Plugin",
    "Read",
    "Shared",
    "Verbosity",
    "argument",
    "command",
    "fill",
    "find_tasks",
    "hint",
    "hinted",
    "installed",
    "make_cluster",
    "make_options",
    "n_threads",
    "open_maps",
    "refuse_stated",
    "threaded",
]

Asked = TypeVar("Asked", bound="DataclassInstance")
Engine: TypeAlias = Literal["local", "dask"]

_MAX_THREADS = 4


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


# --- commands ---------------------------------------------------------------------------------------------------------


def argument(form: str, *, many: bool = False, **settings: Any) -> Any:
    """Make a field that is an argument of a command, or with `many` all of them; `settings` as for `click.Argument`."""
    usual = {"metavar": form, "type": click.Path(), **({"nargs": -1, "required": True} if many else {})}
    return field(metadata={"argument": {**usual, **settings}})


def command(
    name: str, kind: type[Asked], cls: type[click.Command] = Command, group: click.Group | None = None, **settings: Any
) -> Callable[[Callable[[Asked], Any]], click.Command]:
    """Make a command of a function that takes what was asked: a dataclass of arguments and options.

    The function's docstring is its help, unless `settings`, which are as for the class of the command, give another.
    """

    def make(run: Callable[[Asked], Any]) -> click.Command:
        @wraps(run)
        def call(**given: Any) -> Any:
            return run(fill(kind, given))

        taken = [(each.name, each.metadata.get("argument")) for each in fields(kind)]
        arguments = [click.Argument([name], **form) for name, form in taken if form is not None]
        options = [_click_option(*each) for each in among(kind)]
        made = cls(name, params=[*arguments, *options], callback=call, **{"help": inspect.getdoc(run), **settings})
        if group is not None:
            group.add_command(made)
        return made

    return make


def fill(kind: type[Asked], given: Mapping[str, Any]) -> Asked:
    """Return what was asked, an object of a class of options, of the values of click's parameters."""
    values = {}
    for each in fields(kind):
        if "part" in each.metadata:
            of, names, _ = each.metadata["part"]
            values[each.name] = fill(of, {name: given[name] for name in names or given})
        elif each.name in given:
            values[each.name] = given[each.name]
    return kind(**values)


def _click_option(home: type, of: Field[Any], said: Mapping[str, Any]) -> click.Option:
    """Make click's option of a field of a class (see `_options.option`)."""
    more = dict(said)
    names, form, read, plugins, ending, limits, above = (
        more.pop(name, None) for name in ("names", "form", "read", "plugins", "ending", "limits", "above")
    )
    if read is not None:
        kind: dict[str, Any] = {"type": Read(of.name, read)}
    elif plugins:
        kind = {"type": Plugin(partial(installed, plugins), file_ending=ending or "")}
    elif more.pop("is_path", False):
        kind = {"type": click.Path()}
    else:
        kind = {} if "type" in more else _kind_of(home, of, limits, above)
    if not more.get("required"):  # None would count as given
        kind["default"] = of.default
    return _Option([*names.split(), of.name], **{"metavar": form, **kind, **more})


def _kind_of(home: type, of: Field[Any], limits: tuple[Any, Any] | None, above: bool | None) -> dict[str, Any]:
    """Return how click reads a value, by the type of its field: as a switch, words, numbers or texts."""
    named = SimpleNamespace(__annotations__={"of": of.type})
    kind = get_type_hints(named, vars(sys.modules[home.__module__]))["of"]
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (each for each in get_args(kind) if each is not NoneType)
    more: dict[str, Any] = {}
    if get_origin(kind) is tuple:
        kind, more = get_args(kind)[0], {"multiple": True}
    if kind is bool:
        return {"is_flag": True, "metavar": None}
    if get_origin(kind) is Literal:
        return {"type": click.Choice(get_args(kind)), "metavar": None, **more}
    if limits is not None:
        kind = click.IntRange(*limits) if kind is int else click.FloatRange(*limits, min_open=bool(above))
    return {"type": kind, **more}


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

    `names` gives the names that are known; a file that ends as `file_ending` says is taken too. `options` of their own
    stand for others.
    """

    name = "plugin"

    def __init__(
        self,
        names: Callable[[], Sequence[str]],
        has_argument: bool = False,
        file_ending: str = "",
        options: Mapping[str, str] | None = None,
    ) -> None:
        self.names, self.has_argument, self.file_ending, self.options = names, has_argument, file_ending, options or {}

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
        if text and (name not in installed or bool(colon) != self.has_argument):
            expected = ", ".join(f"{plugin}:WHERE" if self.has_argument else plugin for plugin in installed)
            hint = f"; it has an option of its own: {self.options[name]}" if name in self.options else ""
            self.fail(f"got {text!r}, expected one of {expected}{hint}", param, ctx)
        return text

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Any]:  # noqa: ARG002
        """Offer the names that begin so."""
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]


def installed(group: str) -> list[str]:
    """Name the plugins of a group."""
    from roadgeo.plugins import find_plugins

    return sorted(find_plugins(group))


# --- options that commands share --------------------------------------------------------------------------------------


def hint(name: str, **changes: Any) -> Any:
    """Make a field of a hint; `changes` replace what the table says of it, or its default."""
    of = HINTS[name]
    more = {"default": None, "read": None if name in ("effort", "north_up") else of.read, "hint": of}
    return option(changes.pop("names", of.option), of.form, of.group, changes.pop("help", of.told), **more, **changes)


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of an image: all hints, by the names of `Hint.goes_to`."""

    near: tuple[float, float, float] | Literal["exif"] | None = hint("near")
    within: Box | None = hint("within")
    gsd_m: tuple[float, float] | Literal["exif"] | None = hint("gsd")
    heading_deg: tuple[float, float] | Literal["exif"] | None = hint("heading")
    north_up: bool | None = hint("north_up")
    max_tilt_deg: float | None = hint("max_tilt")
    focal_px: float | Literal["exif"] | None = hint("focal")
    effort: Literal["quick", "full"] | None = hint("effort")
    time_limit_s: float | None = hint("time_limit")


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Method:
    """Which matcher searches."""

    method: Literal["auto", "pair"] = option("--method", None, SEARCH,
        "auto: the best there is, the default. pair: the matcher of the paper that roadgeo began with, for comparison.",
        default="auto", rare=True)
    paper: bool = option("--paper", "", SEARCH,
        "With --method pair: the paper to the letter. Without it matches are one to one, cameras are real, and places"
        " are refined.", rare=True)
    pair: tuple[str, ...] = option("--pair", "NAME=VALUE", SEARCH,
        "With --method pair: one of its thresholds, by the paper's symbols, such as delta=0.2 or d_max_m=1500."
        " Repeatable.", default=(), rare=True)


@dataclass(frozen=True, kw_only=True)
class Verbosity:
    """Switches for whoever prints (see `printing.is_set`)."""

    quiet: bool = option("-q --quiet", "", OTHERS, "Say nothing but errors, and what --json prints.",
        callback=keep_switch)
    verbose: bool = option("-v --verbose", "", OTHERS, "Say more: numbers, times, files read.", callback=keep_switch)


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Options that several commands take."""

    references: tuple[str, ...] = option("-r --reference", "REF", WHERE,
        "Map to search: REF.gpkg, or a name in the library. Repeatable. Default: all of the library.",
        type=click.Path(), multiple=True, default=())
    out_dir: str = option("-o --out-dir", "DIR", RESULTS, "Folder for the results; made if missing. Default: here.",
        type=click.Path(file_okay=False), default=".")
    as_json: bool = option("--json", "", RESULTS, "Print one JSON object per image and line.", callback=keep_switch)
    recursive: bool = option("--recursive", "", IMAGE, "Also take the images of folders within folders.")
    products: tuple[str, ...] = option("--also", "NAME", RESULTS,
        "Also as points, geojson, kmz, worldfile and others. Repeatable; --help-all lists all forms.",
        type=Plugin(offered, options={"overlay": "--plot", "report": "--report"}), multiple=True, default=())
    jobs: int = option("-j --jobs", "N", SEARCH,
        "Processes that locate at the same time. For one image alone, threads: as many as processors if not given. "
        "Results do not depend on it. Default: 1.", limits=(1, None), default=1, show_default=False)
    engine: Engine | None = option("--engine", None, SEARCH,
        "Where it is done: in --jobs processes here, the default, or on a Dask cluster of as many workers, which "
        "survives their death. Needs dask and distributed.", rare=True)
    scheduler: str | None = option("--scheduler", "ADDRESS", SEARCH,
        "Use the Dask cluster at this address, tcp://10.0.0.1:8786. Its workers see the same files.", rare=True)
    mavlink: str | None = option("--mavlink", "URL", OTHERS,
        "Also send places to an autopilot, to such as udpout:127.0.0.1:14550.")
# fmt: on


# --- what the options come to -----------------------------------------------------------------------------------------


def hinted(given: Known) -> dict[str, Any]:
    """Return the hints that are given, by their names; a switch that was not set is left out."""
    return {name: value for name, value in vars(given).items() if value is not None and value is not False}


def make_options(hints: Known, how: Method | None = None, *, may_be_stated: bool = False) -> LocateOptions:
    """Put what was given in its place among the options of all stages; the rest stays as it is.

    Raises
    ------
    click.UsageError
        The paper's method knows no hints; only that method has its thresholds. What the camera states is for single
        images.
    """
    from roadgeo.matching.paper import PAPER, PairOptions, read_options
    from roadgeo.workflows import LocateOptions

    how, given = how or Method(), hinted(hints)
    if not may_be_stated:
        refuse_stated(given)
    if how.method == "pair":
        idle = [hint for hint in HINTS.values() if hint.group != SEARCH and hint.goes_to in given]
        if idle:
            raise click.UsageError(f"--method pair takes no {', '.join(hint.option for hint in idle)}: leave it out.")
    elif how.paper or how.pair:
        raise click.UsageError("--paper and --pair go with --method pair.")
    try:
        thresholds = read_options(how.pair, PAPER if how.paper else PairOptions())
    except ValueError as error:
        raise click.UsageError(f"--pair {error}.") from error
    return apply_hints(replace(LocateOptions(), method=how.method, pair=thresholds), given)


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


def find_tasks(
    images: Sequence[str], recursive: bool, page: int | None = None, out_dir: str | None = None
) -> list[Task]:
    """Return a task for each image that is named.

    Raises
    ------
    click.UsageError
        There is no image.
    """
    from roadgeo.running.tasks import find_masks, name_tasks
    from roadgeo.storage.rasters import name_page

    paths = [name_page(name, page) for name in find_masks(images, recursive)]
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
    from roadgeo.reference.opening import open_references, say_swapped

    references = open_references(names, print_steps())
    if said := say_swapped(near, references):
        raise click.UsageError(said.replace("near=", "--near="))
    compile_once()
    return references


def n_threads(jobs: int = 1) -> int:
    """Return how many threads a model, or the search for an image alone, gets."""
    return 1 if jobs > 1 else min(os.cpu_count() or 1, _MAX_THREADS)


def threaded(reading: ReadOptions, jobs: int = 1) -> ReadOptions:
    """Return how images are read, with the threads that a model gets."""
    return replace(reading, threads=n_threads(jobs))


def make_cluster(engine: str | None, scheduler: str | None, jobs: int, divide_map: bool = False) -> Cluster | None:
    """Return the cluster that was asked for, None for processes of this machine.

    Raises
    ------
    click.UsageError
        A scheduler and another engine.
    """
    if scheduler is None and engine != "dask":
        return None
    if engine == "local":
        raise click.UsageError("--scheduler goes with --engine dask.")
    from roadgeo.running.cluster import Cluster

    return Cluster(scheduler, jobs, divide_map)
