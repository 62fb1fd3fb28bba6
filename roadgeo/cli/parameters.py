"""Parameter types and options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

__all__ = [
    "ASPECT",
    "BANDS",
    "BOX",
    "CAMERA",
    "CRS",
    "HEADING",
    "NEAR",
    "RANGE",
    "WITHIN",
    "Numbers",
    "Plugin",
    "out_dir_option",
    "recursive_option",
    "references_option",
    "verbosity_options",
]

#: By how much a heading may be off where nobody says so, degrees.
_HEADING_OFF_DEG = 10.0

Command = TypeVar("Command", bound=Callable[..., Any])


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic only in late versions of click
    """A fixed number of numbers with a separator between them, checked together.

    Parameters
    ----------
    names : sequence of str
        What the numbers are, for messages; their count is the count asked for.
    wrong : callable
        Takes the numbers; returns what is wrong with them, or "".
    """

    def __init__(self, name: str, names: Sequence[str], separator: str, wrong: Callable[..., str]) -> None:
        self.name = name
        self.names = tuple(names)
        self.separator = separator
        self.wrong = wrong

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Parse the text.

        Raises
        ------
        click.BadParameter
            Another count, no numbers, or numbers that make no sense together.
        """
        if isinstance(value, tuple):
            return value
        expected = self.separator.join(self.names)
        try:
            numbers = tuple(float(part) for part in value.split(self.separator))
        except ValueError:
            numbers = ()
        if len(numbers) != len(self.names):
            self.fail(f"got {value!r}, expected {expected}", param, ctx)
        problem = self.wrong(*numbers)
        if problem:
            self.fail(f"got {value!r}: {problem}; expected {expected}", param, ctx)
        return numbers


class Plugin(click.ParamType):  # type: ignore[type-arg]
    """The name of a plugin, and with `has_argument` a colon and what it is to look at: "osm:Boston, MA".

    `names` gives the names that are known, where there are more than the plugins'.
    """

    name = "plugin"

    def __init__(
        self, group: str, *, has_argument: bool = False, names: Callable[[], Sequence[str]] | None = None
    ) -> None:
        self.group = group
        self.has_argument = has_argument
        self.names = names

    def _known(self) -> Sequence[str]:
        if self.names is not None:
            return self.names()
        from roadgeo.plugins import find_plugins

        return sorted(find_plugins(self.group))

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Check that it is installed; nothing of it is imported.

        Raises
        ------
        click.BadParameter
            It is not, or the colon is missing.
        """
        name, colon, _ = str(value).partition(":")
        known = self._known()
        if name not in known or bool(colon) != self.has_argument:
            expected = ", ".join(f"{one}:WHERE" if self.has_argument else one for one in known)
            self.fail(f"got {value!r}, expected one of {expected}", param, ctx)
        return str(value)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Any]:  # noqa: ARG002
        """Offer the names that begin so."""
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in self._known() if name.startswith(incomplete)]


class BandNumbers(click.ParamType):  # type: ignore[type-arg]
    """Numbers of three bands, from 1."""

    name = "bands"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int, int]:
        """Parse the text.

        Raises
        ------
        click.BadParameter
            It is none such.
        """
        if isinstance(value, tuple):
            return value
        numbers = [int(part) if part.strip().isdecimal() else 0 for part in str(value).split(",")]
        if len(numbers) != 3 or min(numbers) < 1:
            self.fail(f"got {value!r}, expected R,G,B: three numbers from 1", param, ctx)
        return numbers[0], numbers[1], numbers[2]


class Crs(click.ParamType):  # type: ignore[type-arg]
    """A coordinate reference system in any words that PROJ knows; "EPSG:n" or WKT2."""

    name = "CRS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Look it up.

        Raises
        ------
        click.BadParameter
            Nobody knows it, or it has no places on a map.
        """
        from roadgeo.errors import CrsError
        from roadgeo.storage.crs import name_crs

        try:
            return name_crs(value)
        except CrsError as error:
            self.fail(str(error), param, ctx)


class Focal(click.ParamType):  # type: ignore[type-arg]
    """A focal length in pixels, or the word "exif"."""

    name = "focal length"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Parse the text.

        Raises
        ------
        click.BadParameter
            Neither "exif" nor a positive number.
        """
        if isinstance(value, float) or str(value).lower() == "exif":
            return value if isinstance(value, float) else "exif"
        try:
            focal = float(value)
        except ValueError:
            focal = 0.0
        if not 0 < focal < float("inf"):
            self.fail(f"got {value!r}, expected a number of pixels above 0, or exif", param, ctx)
        return focal


class Heading(click.ParamType):  # type: ignore[type-arg]
    """A direction in degrees clockwise from north, and by how much it may be off: "90", "90+-10"."""

    name = "heading"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """Parse the text.

        Raises
        ------
        click.BadParameter
            No such numbers.
        """
        if isinstance(value, tuple):
            return value
        center, _, off = str(value).replace("±", "+-").partition("+-")
        try:
            heading = float(center), float(off or _HEADING_OFF_DEG)
        except ValueError:
            heading = math.nan, math.nan
        if not (-360.0 <= heading[0] <= 360.0 and 0.0 < heading[1] <= 180.0):
            self.fail(f"got {value!r}, expected degrees clockwise from north, as 90 or 90+-10", param, ctx)
        return heading


class Area(click.ParamType):  # type: ignore[type-arg]
    """A country, a state, or bounds in degrees."""

    name = "area"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Look its bounds up.

        Raises
        ------
        click.BadParameter
            There is no such area.
        """
        if isinstance(value, tuple):
            return value
        from roadgeo.geometry.areas import find_area

        try:
            return find_area(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


def _wrong_range(low: float, high: float) -> str:
    return "" if 0 < low <= high < float("inf") else "LO must be above 0 and not above HI"


def _swapped(form: str, *numbers: float) -> str:
    """Ask whether longitude and latitude were exchanged; "" where that would be as wrong. `form` exchanges them."""
    meant = form.format(*numbers)
    exchanged = [float(number) for number in meant.split(",")]
    lons, lats = (exchanged[:1], exchanged[1:2]) if len(exchanged) == 3 else (exchanged[::2], exchanged[1::2])
    sound = all(-180 <= lon <= 180 for lon in lons) and all(-90 <= lat <= 90 for lat in lats)
    sound = sound and lats == sorted(lats)
    return f" (longitude comes first: did you mean {meant}?)" if sound else " (longitude comes first)"


def _wrong_place(lon: float, lat: float, radius: float) -> str:
    if not (-180 <= lon <= 180 and -90 <= lat <= 90):
        return f"longitude must lie within ±180, latitude within ±90{_swapped('{1:g},{0:g},{2:g}', lon, lat, radius)}"
    return "" if 0 < radius < 2e7 else "the radius must be above 0 metres"


def _wrong_box(west: float, south: float, east: float, north: float) -> str:
    if not (-90 <= south < north <= 90):
        swapped = _swapped("{1:g},{0:g},{3:g},{2:g}", west, south, east, north)
        return f"south must lie below north, both within ±90{swapped}"
    if not (-180 <= west <= 180 and -180 <= east <= 180 and west != east):
        return "west and east must differ and lie within ±180"
    return ""


#: Metres per pixel, least and greatest.
RANGE = Numbers("range", ("LO", "HI"), ":", _wrong_range)
#: A place in degrees and a distance in metres.
NEAR = Numbers("place", ("LON", "LAT", "RADIUS"), ",", _wrong_place)
#: A direction, and by how much it may be off.
HEADING = Heading()
#: A focal length in pixels, or where to find it.
CAMERA = Focal()
CRS = Crs()
#: A country or state, or bounds in degrees.
WITHIN = Area()


class Aspect(click.ParamType):  # type: ignore[type-arg]
    """How many times a pixel is as wide as high, or the word "unknown"."""

    name = "aspect"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Parse the text.

        Raises
        ------
        click.BadParameter
            Neither "unknown" nor a ratio that is searched.
        """
        if value == "unknown":
            return "unknown"
        try:
            ratio = float(value)
        except (TypeError, ValueError):
            ratio = 0.0
        if not 0.25 <= ratio <= 4.0:
            self.fail(f"got {value!r}, expected a number from 0.25 to 4, or unknown", param, ctx)
        return ratio


ASPECT = Aspect()
#: A box in degrees; west may exceed east, across the 180th meridian.
BANDS = BandNumbers()
BOX = Numbers("box", ("W", "S", "E", "N"), ",", _wrong_box)


def verbosity_options(command: Command) -> Command:
    """Add --quiet and --verbose."""
    verbose = click.option("-v", "--verbose", is_flag=True, help="Say more: times, counts, files read.")
    quiet = click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors, and what --json prints.")
    return verbose(quiet(command))


def recursive_option(command: Command) -> Command:
    """Add --recursive."""
    told = "Of folders also the images in all folders within them, as cameras keep theirs (DCIM)."
    return click.option("--recursive", is_flag=True, help=told)(command)


def references_option(purpose: str = "Reference to search") -> Callable[[Command], Command]:
    """Make the option that names the references."""
    return click.option(
        "-r",
        "--reference",
        "references",
        metavar="REF",
        type=click.Path(),
        multiple=True,
        help=f"{purpose}: REF.gpkg, or a name in the library. Repeatable. Default: all of the library.",
    )


def out_dir_option(
    help_text: str = "Where the results go; made if missing. Default: here.",
    default: str | None = ".",
    path_type: type[str] | type[Path] = str,
    **more: Any,
) -> Callable[[Command], Command]:
    """Make the option that says where results go."""
    kind = click.Path(file_okay=False, path_type=path_type)
    return click.option("-o", "--out-dir", metavar="DIR", default=default, type=kind, help=help_text, **more)
