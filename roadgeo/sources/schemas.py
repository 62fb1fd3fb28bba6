"""One adapter from tables of any schema to roads: kind of each, tunnel or not, name, attribution.

A schema is recognised by its words, listed in `schemas.toml`: `residential` is OpenStreetMap's, `A Road` the Ordnance
Survey's, `S1400` is TIGER's. Columns with well-known names are looked at first, then any that hold such words.
Numbers count in columns that are known by name alone. Other lines (a stream, a fence, a railway) are left
out and counted; a road whose kind is not known stays one.
"""

from __future__ import annotations

import json
import re
import tomllib
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, IntArray
from roadgeo.roads.kinds import KNOWN_HIGHWAYS, NO_ROADS, in_tunnel
from roadgeo.sources.lines import OSM_ATTRIBUTION, RoadLines, RoadTable, objects, simple_areas, simple_lines
from roadgeo.storage.crs import crs_name

__all__ = ["Schema", "is_filled", "is_known_column", "names_kinds", "recognise"]

#: Meanings of a word beside values of `highway`: no road, and a road of a kind that other columns may hold.
_NONE, _ROAD = "none", "road"
_LONGEST = 200  # of words
_LETTERS = str.maketrans({"ø": "o", "æ": "ae", "ß": "ss", "ð": "d", "ł": "l"})


def _plain(text: str) -> str:
    """Return a word in lower case, without accents and whatever is no letter or digit; "" for one that is too long."""
    return _letters_of(text) if len(text) <= _LONGEST else ""


@lru_cache(maxsize=1 << 12)  # columns repeat a few words
def _letters_of(text: str) -> str:
    text = text.lower().translate(_LETTERS)
    return "".join(letter for letter in unicodedata.normalize("NFKD", text) if letter.isascii() and letter.isalnum())


def _by_word(kinds: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return words by their meaning: those that end in `*`, for codes that begin so."""
    return {_plain(word) + word[-1] * (word[-1] == "*"): kind for kind, words in kinds.items() for word in words}


_DATA = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_WORDS = {maker: _by_word(kinds) for maker, kinds in _DATA["words"].items()}
_CODES = {column: _by_word(kinds) for column, kinds in _DATA["codes"].items()}
_SURE, _GENERAL, _NAMES, _TAGS, _OTHERS = (_DATA["columns"][of] for of in ("kind", "general", "name", "tags", "other"))
_TUNNELS, _UNBUILT, _FLAGS = _DATA["tunnels"], _DATA["unbuilt"], "road_flags"
_KINDS = [*_SURE, *_GENERAL]
_OSM_NAME, _OVERTURE = "OpenStreetMap", "© OpenStreetMap contributors, Overture Maps Foundation, ODbL 1.0"
_OSM = _WORDS[_OSM_NAME] | _by_word({word: [word] for word in KNOWN_HIGHWAYS} | {_NONE: sorted(NO_ROADS)})
_WORDS[_OSM_NAME] = _OSM
_HIGHWAY = dict(_OSM)  # of a column `highway`: other words in it stand for kinds that are not known here
_OSM_MARKS = {*_DATA["columns"]["mark"], *_TAGS, *_OTHERS}
#: Words that show that a line is a road, or none, whatever column they stand in.
_AMBIGUOUS = {*map(_plain, _DATA["ambiguous"])}
_CERTAIN = {
    maker: {word: kind for word, kind in words.items() if word not in _AMBIGUOUS and "*" not in word}
    for maker, words in _WORDS.items()
}
_FEWEST = 2  # such words for roads, of those in a column of a general or unknown name, until all are believed
_AREA = "area"
_KNOWN = {name[:10] for name in (*_KINDS, *_TUNNELS, *_UNBUILT, *_NAMES, *_OSM_MARKS, _AREA)}
_PAIR = re.compile(r'"(highway|tunnel|area)"\s*(?:=>|:)\s*"([^"]*)"')
_CODE = re.compile(r"[a-z]\d+")
#: Number of values by which the content of a column is recognised.
_SAMPLE = 1000


def is_known_column(name: str) -> bool:
    """Whether a column of this name may describe a road."""
    return name.lower()[:10] in _KNOWN


def names_kinds(values: AnyArray) -> bool:
    """Whether most filled values of a column of any name are words for kinds of lines, of one maker of maps."""
    return _words_of(values)[0] != ""


@dataclass(frozen=True)
class Schema:
    """How to read a table.

    Attributes
    ----------
    kinds : tuple of (column, words)
        Columns with the kind, in order of precedence.
    none_is_no_road : bool
        A line without a kind is something else, as in a table of OpenStreetMap's.
    attribution : str
    is_guess : bool
        None of the columns has a name that is known for kinds of roads alone.
    """

    kinds: tuple[tuple[str, Mapping[str, str]], ...] = ()
    none_is_no_road: bool = False
    attribution: str = ""
    is_guess: bool = False

    def adapt(self, table: RoadTable, whole: bool = False) -> RoadLines:
        """Return the lines of a table that are roads, or may be; others are counted in `meta`.

        Where all lines are wanted, those that a column of a general or unknown name calls something else are `whole`.
        """
        columns = _named(table.columns)
        kinds, others = self._kinds(columns, len(table.shapes))
        if whole and self.is_guess:
            kinds, others = np.where(others, "", kinds), np.zeros_like(others)
        for name in _UNBUILT.keys() & columns.keys():
            others |= _each(columns[name], partial(_begins, _UNBUILT[name])).astype(bool)
        parted = shapes = table.shapes[~others]
        of, flags = np.arange(len(shapes)), np.full(len(shapes), "", object)
        if _FLAGS in columns:
            parted, of, flags = _parted(shapes, columns[_FLAGS][~others])
        lines, place = simple_lines(parted)
        areas = simple_areas(shapes)
        row = np.flatnonzero(~others)[of[place]]
        hidden = [_each(columns[name], partial(_tunnel_of, name)) for name in _TUNNELS if name in columns]
        hidden += [_tag(columns[name], "tunnel") for name in _TAGS if name in columns]
        tunnels = [in_tunnel(_each(values[row], _words)) for values in hidden]
        called = next((columns[name] for name in _NAMES if name in columns), None)
        counts = {"no_roads": len(others) - len(np.unique(of)), "broken": _count_broken(shapes)}
        filled = [name for name in _OTHERS if any(map(is_filled, columns.get(name, ())))]
        by = " and ".join([*dict(self.kinds), *filled])
        stated = {"attribution": self.attribution, "kind_columns": by if self.is_guess else "", **table.meta, **counts}
        return RoadLines(
            lines,
            crs_name(table.crs),
            kinds[row],
            np.full(len(row), "", object) if called is None else _each(called[row], _text),
            np.logical_or.reduce([in_tunnel(flags[place]), *tunnels]),
            bool(self.kinds),
            {"features": len(table.shapes)} | {key: value for key, value in stated.items() if value},
            areas,
        )

    def _kinds(self, columns: Mapping[str, AnyArray], n: int) -> tuple[AnyArray, BoolArray]:
        """Return (N,) the kind of each feature, "" where it is not known, and which are no roads."""
        kinds, others = np.full(n, "", object), np.zeros(n, bool)
        for name, words in self.kinds:
            stated = _each(columns.get(name, kinds), partial(_kind_of, words=words))
            kinds = np.where((kinds == "") | ((kinds == _ROAD) & (stated != "")), stated, kinds)
            others |= stated == _NONE
        unknown = kinds == ""
        for name in _OTHERS:
            others |= unknown & (_each(columns[name], is_filled).astype(bool) if name in columns else False)
        said = [_tag(columns[name], _AREA) for name in _TAGS if name in columns]
        for values in said + [columns[name] for name in (_AREA,) if name in columns]:
            others |= np.array([value == "yes" for value in values], bool)
        return kinds, others | (unknown & self.none_is_no_road)


def recognise(table: RoadTable) -> Schema:
    """Recognise the schema of a table by its columns and their values."""
    columns = _named(table.columns)
    makers: dict[str, str] = {}
    kinds: dict[str, Mapping[str, str]] = {}
    others = [name for name in columns if name not in _KNOWN]
    is_overture = {"subtype", "class"} <= columns.keys()
    for name in [name for name in _KINDS if name in columns] + others:
        if name in others and kinds:
            break
        maker, words = _words_of(columns[name], name in _SURE or (is_overture and name in _GENERAL))
        if name in _CODES and _share(_said(columns[name]), _CODES[name]) > 0.5:
            kinds[name] = _CODES[name]
        elif maker:
            kinds[name], makers[name] = words, maker
            if name in ("highway", "fclass") and maker == _OSM_NAME:
                break
    is_osm = bool(columns.keys() & _OSM_MARKS) or table.meta.get("format") == _OSM_NAME
    if "highway" in columns and (is_osm or makers.get("highway") == _OSM_NAME):
        kinds = {"highway": _HIGHWAY}
        makers["highway"] = _OSM_NAME
    credit = [_DATA["attribution"].get(maker, "") for maker in makers.values()]
    if {"subtype", "class"} <= makers.keys():
        credit = [_OVERTURE]
    elif is_osm and _OSM_NAME in makers.values():
        credit = [OSM_ATTRIBUTION]
    # A table with `highway` and nothing else of OpenStreetMap's was made of roads alone: there a kind is missing.
    is_whole = any(name in _KNOWN for name in columns if name != "highway")
    is_own = is_whole and any(kinds.get(name) is words for name, words in (("highway", _HIGHWAY), ("fclass", _OSM)))
    is_guess = not is_overture and not any(name in _SURE for name in kinds)
    return Schema(tuple(kinds.items()), is_own, next(filter(None, credit), ""), is_guess)


def _named(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return columns by the first ten letters of their names, as a shapefile has them; `highway` out of other tags."""
    named: dict[str, AnyArray] = {}
    for name, values in columns.items():
        named.setdefault(str(name).lower()[:10], values)
    for name in _TAGS:
        if name in named and "highway" not in named and any(tags := _tag(named[name], "highway")):
            named["highway"] = tags
    return named


def _words_of(values: AnyArray, sure: bool = False) -> tuple[str, Mapping[str, str]]:
    """Return the maker of maps whose words most filled values are, and its words that are believed.

    In a column of a name that is not `sure`, all are where several of them can be nothing but roads; otherwise those
    that can be nothing else, if most are. "" without a maker.
    """
    said = _said(values)
    shares = {maker: _share(said, words) for maker, words in _WORDS.items()}
    best = max(shares, key=lambda maker: shares[maker])
    if shares[best] <= 0.5:
        return "", {}
    n_roads = len({word for word in map(_plain, chain(*said)) if _CERTAIN[best].get(word, _NONE) != _NONE})
    if sure or n_roads >= _FEWEST:
        return best, _WORDS[best]
    return (best, _CERTAIN[best]) if _share(said, _CERTAIN[best]) > 0.5 else ("", {})


def _said(values: AnyArray) -> list[list[str]]:
    """Return the words of filled values from all over a column."""
    filled = [value for value in values if is_filled(value)]
    return [_split(value) for value in filled[:: max(len(filled) // _SAMPLE, 1)]]


def _share(said: Sequence[Sequence[str]], words: Mapping[str, str]) -> float:
    """Return the share of values, as lists of words, of which one is known."""
    return sum(any(_look_up(word, words) for word in value) for value in said) / max(len(said), 1)


def _kind_of(value: Any, words: Mapping[str, str]) -> str:
    """Return the `highway` that a value stands for, several with semicolons between them; "" for none."""
    parts = _split(value)
    kinds = dict.fromkeys(_look_up(word, words) or (word if words is _HIGHWAY else None) for word in parts)
    roads = [kind for kind in kinds if kind not in (None, _NONE)]
    return ";".join(map(str, roads)) or (_NONE if _NONE in kinds else "")


def _look_up(word: str, words: Mapping[str, str]) -> str | None:
    plain = _plain(word)
    return words.get(plain) or (words.get(f"{plain[0]}*") if _CODE.fullmatch(plain) else None)


def _split(value: Any) -> list[str]:
    """Return the words of a value: of text with separators, as osmnx writes lists, or of a list."""
    if not is_filled(value):
        return []
    if isinstance(value, str):
        return [word for part in re.split(r"[;,|]", value) if (word := part.strip(" []{}()'\""))]
    if isinstance(value, tuple | list | np.ndarray | set):
        return [str(one) for one in value]
    return [f"{value:g}" if isinstance(value, float) else str(value)]


def _words(value: Any) -> str:
    """Return the words of a value in lower case, with semicolons between them."""
    return ";".join(_split(value)).lower()


def is_filled(value: Any) -> bool:
    """Whether a value of a table is one, and no word for none."""
    if isinstance(value, str):
        return value.strip().lower() not in ("", "no", "none", "nan", "null", "<null>")
    if isinstance(value, tuple | list | np.ndarray | set):
        return len(value) > 0
    return value is not None and type(value).__name__ not in ("NAType", "NaTType") and value == value


def _tag(values: AnyArray, key: str) -> AnyArray:
    """Return one of the other tags that GDAL keeps in one column: text as of hstore or JSON, or a dictionary."""

    def find(value: Any) -> str | None:
        if isinstance(value, dict):
            return value.get(key)
        pairs = dict(_PAIR.findall(value)) if isinstance(value, str) else {}
        return pairs.get(key)

    return _each(values, find)


def _rules(value: Any) -> list[tuple[tuple[float, float], list[str]]]:
    """Return Overture's flags of tunnels and of roads that are not there, with the part of the length that has them."""
    rules, lists = _json(value), list | tuple | np.ndarray
    mappings = [rule for rule in rules if isinstance(rule, dict)] if isinstance(rules, lists) else []
    return [
        (_span(rule.get("between")), [flag for flag in map(str, flags) if _hides(flag) or _is_unbuilt(flag)])
        for rule in mappings
        if isinstance(flags := rule.get("values"), lists)
    ]


def _span(part: Any) -> tuple[float, float]:
    """Return two shares of a length, the lesser first; a missing one is the end of the line, as both are of no pair."""
    if not isinstance(part, list | tuple | np.ndarray) or len(part) != 2:
        return 0.0, 1.0
    ends = [float(end) if is_filled(end) else default for end, default in zip(part, (0.0, 1.0), strict=True)]
    return min(max(min(ends), 0.0), 1.0), min(max(*ends, 0.0), 1.0)


def _parted(shapes: AnyArray, values: AnyArray) -> tuple[AnyArray, IntArray, AnyArray]:
    """Cut segments where Overture's flags hold for a part; return the pieces that are there, whose, and their flags."""
    import shapely
    from shapely.ops import substring

    pieces: list[tuple[Any, int, str]] = []
    for k, (shape, value) in enumerate(zip(shapes, values, strict=True)):
        rules = _rules(value)
        ends = sorted({0.0, 1.0, *(end for part, flags in rules if flags for end in part)})
        for low, high in pairwise(ends if isinstance(shape, shapely.LineString) else (0.0, 1.0)):
            flags = ";".join(flag for (start, end), held in rules if start <= (low + high) / 2 <= end for flag in held)
            if not _is_unbuilt(flags):
                part = shape if high - low == 1.0 else substring(shape, low, high, normalized=True)
                pieces.append((part, k, flags))
    parted, of, held = zip(*pieces, strict=True) if pieces else ((), (), ())
    return objects(parted), np.array(of, np.intp), objects(held)


def _text(value: Any) -> str:
    """Return the name of a street, "" for none; of Overture's names the primary one."""
    parsed = _json(value)
    parsed = parsed.get("primary") if isinstance(parsed, dict) else value
    return ";".join(map(str, parsed)) if isinstance(parsed, list | tuple) else str(parsed) if is_filled(parsed) else ""


def _json(value: Any) -> Any:
    try:
        return json.loads(value) if isinstance(value, str) and value[:1] in ("{", "[") else value
    except (ValueError, RecursionError):
        return value


def _tunnel_of(name: str, value: Any) -> Any:
    """Return OpenStreetMap's words for what a column of this name tells of a tunnel."""
    return value if not _TUNNELS[name] else "yes" if _begins(_TUNNELS[name], value) else "no"


def _begins(pattern: str, value: Any) -> bool:
    return re.match(pattern, str(value).strip(), re.IGNORECASE) is not None


def _hides(flag: str) -> bool:
    return bool(in_tunnel(objects([flag]))[0])


def _is_unbuilt(flags: str) -> bool:
    return any(_begins(_UNBUILT[_FLAGS], flag) for flag in flags.split(";"))


def _count_broken(shapes: AnyArray) -> int:
    """Count shapes with a vertex that is not finite."""
    import shapely

    coords, shape = shapely.get_coordinates(shapes, return_index=True)
    return len(np.unique(shape[~np.isfinite(coords).all(axis=1)]))


def _each(values: AnyArray, make: Callable[[Any], Any]) -> AnyArray:
    """Return what a function makes of each value; it is called once for equal texts."""
    made = cache(make)
    return objects(made(value) if type(value) is str else make(value) for value in values)
