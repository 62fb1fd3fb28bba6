"""Hints on an image: a single table for the command line, HTTP, QGIS and Python.

A value is a number, several numbers, or a text such as "0.3", "0.3:0.6", "90+-10" or "-71.06,42.36,5000".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from roadgeo.geometry.areas import Box, find_area, is_box
from roadgeo.matching.search import SearchOptions

if TYPE_CHECKING:
    from roadgeo.matching.options import LocateOptions

__all__ = [
    "GSD_FACTOR",
    "HINTS",
    "STATED",
    "Hint",
    "Taken",
    "apply_hints",
    "as_keywords",
    "asked_of_camera",
    "read_box",
    "read_gsd",
    "read_hint",
    "read_numbers",
    "read_place",
    "read_range",
    "read_taken",
]

#: A place by its number in an answer's list, from 1, or longitude and latitude near it.
Taken: TypeAlias = "int | tuple[float, float]"

#: Stands for a value that the camera states (see `sources.camera`).
STATED = "exif"

#: A single pixel size stands for the range from size / factor to size * factor: sizes are seldom known better.
GSD_FACTOR = 1.25
#: Tolerance of a heading that is given without a tolerance, degrees.
_HEADING_OFF_DEG = 10.0


@dataclass(frozen=True)
class Hint:
    """A fact that a user may know about an image.

    `read` turns a value in any form into the option's value; it raises ValueError: "got ..., expected ...".
    """

    name: str  # as a keyword of Python; `option` is its name on the command line, `parameter` over HTTP
    goes_to: str  # its name among the hints of `apply_hints`: a field of the options of a search, with its unit
    form: str  # how a value is written; "" for a switch
    label: str  # the title of its field in a dialog, with its unit
    help: str  # its meaning, with its unit and its default
    read: Callable[[Any], Any]
    schema: Mapping[str, Any]  # JSON Schema of a value over HTTP, next to a text
    default: float | str = ""  # if it fits in a word; `told` adds it to the help
    group: str = "The image"  # its heading in the help

    @property
    def option(self) -> str:
        """The name on the command line: --max-tilt."""
        return "--" + self.name.replace("_", "-")

    @property
    def told(self) -> str:
        """The help with the default."""
        is_complete = self.default == "" or "default" in self.help
        return self.help if is_complete else f"{self.help} Default: {self.default}."

    @property
    def parameter(self) -> str:
        """The name over HTTP: maxTilt."""
        first, *others = self.name.split("_")
        return first + "".join(map(str.capitalize, others))


# --- reading ----------------------------------------------------------------------------------------------------------
# All of these raise ValueError, "got ..., expected ...", for invalid values.


def _expect(holds: bool, value: Any, form: str, why: str = "") -> None:
    if not holds:
        raise ValueError(f"got {repr(value)[:60]}{f': {why};' if why else ','} expected {form}")


def read_numbers(value: Any, form: str, counts: Sequence[int], separators: str = ",:") -> tuple[float, ...]:
    """Return the finite numbers in a value; their number must be among `counts`."""
    if isinstance(value, str):
        parts: Sequence[Any] = re.split(f"[{separators}]", value)
    else:
        parts = value if isinstance(value, Sequence) else [value]
    try:
        numbers = () if any(isinstance(part, bool) for part in parts) else tuple(map(float, parts))
    except (TypeError, ValueError, OverflowError):
        numbers = ()
    _expect(len(numbers) in counts and all(map(math.isfinite, numbers)), value, form)
    return numbers


def _read_number(value: Any, low: float, high: float, form: str) -> float:
    (number,) = read_numbers(value, form, (1,))
    _expect(low <= number <= high, value, form)
    return number


def _split_tolerance(value: Any) -> tuple[Any, str]:
    """Split "90+-10" into its value and its tolerance; "" where none is given."""
    if not isinstance(value, str):
        return value, ""
    center, _, off = value.replace("±", "+-").partition("+-")
    return center, off.strip()


def read_range(value: Any, form: str = "a number above 0, or LO:HI") -> tuple[float, float]:
    """Return two numbers above 0, the second not below the first; a single number stands for both."""
    low, high = (read_numbers(value, form, (1, 2)) * 2)[:2]
    _expect(0 < low <= high, value, form, "LO must be above 0 and not above HI")
    return low, high


def read_gsd(value: Any) -> tuple[float, float]:
    """Return the least and the greatest size of a pixel, metres."""
    form = "metres per pixel as SIZE or LO:HI: 0.3, 0.3+-10% or 0.3:0.6"
    center, off = _split_tolerance(value)
    low, high = read_range(center, form)
    if off:
        share = read_numbers(off.removesuffix("%"), form, (1,))[0]
        reach = low * share / 100 if off.endswith("%") else share
        return read_range((low - reach, high + reach), form)
    single = not isinstance(center, Sequence) or (isinstance(center, str) and not re.search("[,:]", center))
    return (low / GSD_FACTOR, low * GSD_FACTOR) if single else (low, high)


def _read_heading(value: Any) -> tuple[float, float]:
    form = "degrees clockwise from north: 90 or 90+-10"
    center, off = _split_tolerance(value)
    numbers = read_numbers(center, form, (1,) if off else (1, 2))
    heading, may_be_off = (*numbers, *read_numbers(off or _HEADING_OFF_DEG, form, (1,)))[:2]
    _expect(-360.0 <= heading <= 360.0 and 0.0 < may_be_off <= 180.0, value, form)
    return heading, may_be_off


def read_taken(text: str) -> Taken:
    """Read which place is taken: its number, or longitude and latitude.

    Raises
    ------
    ValueError
        It is neither.
    """
    if re.fullmatch(r"\s*[1-9][0-9]{0,3}\s*", text):
        return int(text)
    try:
        lon, lat = map(float, text.split(","))
    except ValueError:
        lon = lat = math.nan
    if not (-180.0 <= lon <= 180.0 and -90.0 <= lat <= 90.0):
        raise ValueError(f"got {text!r}, expected the number of a place, from 1, or LON,LAT near it")
    return lon, lat


def read_place(value: Any) -> tuple[float, float, float]:
    """Return longitude, latitude (degrees) and a radius (metres); the error reports exchanged coordinates."""
    form = "LON,LAT,RADIUS in degrees and metres"
    lon, lat, radius = read_numbers(value, form, (3,), ",")
    swapped = _swapped((lat, lon), f",{radius:g}")
    on_earth = -180 <= lon <= 180 and -90 <= lat <= 90
    _expect(on_earth, value, form, f"longitude must lie within ±180, latitude within ±90{swapped}")
    _expect(0 < radius < 2e7, value, form, "the radius must be above 0 and below 20,000,000 metres")
    return lon, lat, radius


def read_box(value: Any) -> Box:
    """Return west, south, east and north, degrees; west may exceed east, across the 180th meridian."""
    form = "W,S,E,N in degrees"
    west, south, east, north = read_numbers(value, form, (4,), ",")
    swapped = _swapped((south, west, north, east))
    _expect(-90 <= south < north <= 90, value, form, f"south must lie below north, both within ±90{swapped}")
    _expect(is_box((west, south, east, north)), value, form, "west and east must differ and lie within ±180")
    return west, south, east, north


def _swapped(exchanged: Sequence[float], rest: str = "") -> str:
    """Return the remedy for a bad place: exchange the coordinates if that helps, else a reminder of their order."""
    lons, lats = exchanged[::2], exchanged[1::2]
    sound = max(map(abs, lons)) <= 180 and max(map(abs, lats)) <= 90 and sorted(lats) == [*lats]
    meant = ",".join(f"{number:g}" for number in exchanged) + rest
    return f" (longitude comes first: did you mean {meant}?)" if sound else " (longitude comes first)"


def _read_area(value: Any) -> Box:
    return find_area(value) if isinstance(value, str) else read_box(value)


def _read_focal(value: Any) -> float:
    return _read_number(value, math.ulp(0.0), 1e6, "pixels above 0, or exif")


def _or_stated(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return what also reads "exif", for what the camera states."""
    return lambda value: STATED if isinstance(value, str) and value.lower() == STATED else read(value)


def _read_switch(value: Any) -> bool:
    word = str(value).lower() if isinstance(value, bool | str) else "neither"
    yes, no = ("", "1", "true", "yes"), ("0", "false", "no")  # in a URL or a form
    _expect(word in (*yes, *no), value, "true or false")
    return word in yes


def _read_effort(value: Any) -> Literal["quick", "full"]:
    _expect(value in ("quick", "full"), value, "quick or full")
    return value  # type: ignore[no-any-return]


# --- the table --------------------------------------------------------------------------------------------------------


def _numbers(count: int) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number"}, "minItems": count, "maxItems": count}


def _between(low: float, high: float, form: str) -> tuple[Callable[[Any], float], dict[str, Any]]:
    """Return how a number within bounds is read, and its schema."""
    return lambda value: _read_number(value, low, high, form), {"type": "number", "minimum": low, "maximum": high}


_ABOVE_0 = {"type": "number", "exclusiveMinimum": 0}


_TABLE = (
    Hint(
        "near", "near", "LON,LAT,RADIUS", "Near",
        "The middle lies within RADIUS metres of there. exif: where the camera says; so --gsd and --heading.",
        _or_stated(read_place), _numbers(3), group="Where to look",
    ),
    Hint(
        "within", "within", "AREA", "In the country or state",
        "The middle lies in a country or state. Or within W,S,E,N in degrees.",
        _read_area, _numbers(4), group="Where to look",
    ),
    Hint(
        "gsd", "gsd_m", "SIZE|LO:HI", "Pixel size, metres",
        "Pixel size, metres: 0.3, 0.3+-10% or 0.3:0.6. It is that at the middle; 0.3 alone stands for 0.24 to"
        " 0.375, a quarter more or less.",
        _or_stated(read_gsd), {"oneOf": [_ABOVE_0, _numbers(2)]}, "0.1:12",
    ),
    Hint(
        "heading", "heading_deg", "DEG[+-DEG]", "Heading, degrees",
        "Where up points, degrees from north: 90+-10. Clockwise; the second number is 10 if left out.",
        _or_stated(_read_heading), {"oneOf": [{"type": "number"}, _numbers(2)]},
    ),
    Hint(
        "north_up", "north_up", "", "Up is north",
        "Up is north. Grid north of the reference, within 5 degrees.",
        _read_switch, {"type": "boolean"},
    ),
    Hint(
        "max_tilt", "max_tilt_deg", "DEG", "Greatest tilt, degrees",
        "Greatest tilt of the camera, degrees. From the vertical.",
        *_between(0, 80, "degrees from 0 to 80"), 60,
    ),
    Hint(
        "focal", "focal_px", "PIXELS|exif", "Focal length, pixels",
        "Focal length in pixels, or as the EXIF says. That of the photograph, if one goes with a mask.",
        _or_stated(_read_focal), {"oneOf": [_ABOVE_0, {"enum": ["exif"]}]},
    ),
    Hint(
        "effort", "effort", "quick|full", "Effort",
        "How hard to try, full by default. quick: stop early, for clean masks. full: also search by roads alone, for"
        " broken masks and photographs.",
        _read_effort, {"enum": ["quick", "full"]}, "full", "The search",
    ),
    Hint(
        "time_limit", "time_limit_s", "SECONDS", "Time limit, seconds",
        "Stop searching for an image then. The paper's matcher stops after 10 by itself.",
        lambda value: _read_number(value, 1e-3, 1e6, "seconds from 0.001 to 1,000,000"),
        _ABOVE_0, round(SearchOptions.time_limit_s), "The search",
    ),
)  # fmt: skip

#: Hints by their names.
HINTS: dict[str, Hint] = {hint.name: hint for hint in _TABLE}


def read_hint(name: str, value: Any) -> tuple[str, Any]:
    """Return the option that a hint sets, and its value in the option's form.

    Raises
    ------
    ValueError
        The value makes no sense; the name stands first in the message.
    """
    hint = HINTS[name]
    try:
        return hint.goes_to, hint.read(value)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def asked_of_camera(hints: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of hints, by `Hint.goes_to`, that are to be what the camera states."""
    return tuple(name for name, value in hints.items() if value == STATED)


def as_keywords(text: str) -> str:
    """Return a text in which hints are named as keywords of Python, not as options of the command line."""
    options = "|".join(hint.option for hint in HINTS.values())
    return re.sub(
        rf"({options})\b(?: ([A-Z][^\s)]*))?",
        lambda named: named[1][2:].replace("-", "_") + (f'="{named[2]}"' if named[2] else ""),
        text,
    )


def apply_hints(options: LocateOptions, hints: Mapping[str, Any]) -> LocateOptions:
    """Set the options of all stages from the hints that are known; other options stay unchanged.

    Parameters
    ----------
    hints : mapping
        Values by `Hint.goes_to`; None if unknown. The caller must look up what the camera states, "exif".
    """
    given = {name: value for name, value in hints.items() if value not in (None, STATED)}

    def among(*names: str) -> dict[str, Any]:
        return {name: given[name] for name in names if name in given}

    camera = replace(options.match.camera, **among("gsd_m", "heading_deg", "north_up", "max_tilt_deg", "focal_px"))
    limit = among("time_limit_s")
    return replace(
        options,
        match=replace(options.match, camera=camera, **among("within")),
        search=replace(options.search, **limit),
        pair=replace(options.pair, **limit),
        **among("near", "effort"),
    )
