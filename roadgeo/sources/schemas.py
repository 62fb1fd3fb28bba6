"""One adapter from tables of any schema to roads: kind of each, tunnel or not, name, attribution.

A schema is recognised by its words: `residential` is OpenStreetMap's, `A Road` the Ordnance Survey's, `S1400` of TIGER.
Columns with well-known names are looked at first, then any whose values are such words. Numbers count in columns that
are known by name alone. Other lines (a stream, a fence, a railway) are left out and counted; a road whose
kind is not known stays one.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo.roads.kinds import KNOWN_HIGHWAYS, NO_ROADS, in_tunnel
from roadgeo.sources.lines import OSM_ATTRIBUTION, RoadLines, RoadTable, simple_areas, simple_lines

__all__ = ["Schema", "is_known_column", "names_kinds", "recognise"]

#: Meanings of a word beside values of `highway`: no road, and a road of a kind that other columns may hold.
_NONE, _ROAD = "none", "road"


class _Vocabulary(NamedTuple):
    """Words of one maker of maps, less all but letters and digits, and the `highway` that each stands for.

    `r*` stands for codes that begin so.
    """

    words: Mapping[str, str]
    attribution: str = ""


def _plain(text: str) -> str:
    """Return a word in lower case, without accents and whatever is no letter or digit."""
    text = text.lower().translate(_LETTERS)
    return "".join(letter for letter in unicodedata.normalize("NFKD", text) if letter.isascii() and letter.isalnum())


_LETTERS = str.maketrans({"ø": "o", "æ": "ae", "ß": "ss", "ð": "d", "ł": "l"})


def _words(**kinds: str) -> dict[str, str]:
    """Return words by their meaning, given as text with commas between them."""
    return {_plain(word): kind for kind, words in kinds.items() for word in words.split(",")}


#: Lines of OpenStreetMap that are something else, by the value of their own key.
_OSM_OTHERS = (
    "rail,light_rail,subway,tram,narrow_gauge,monorail,funicular,miniature,preserved,standard_gauge,rack,miniature_railway,"
    "stream,river,canal,drain,ditch,riverbank,dam,weir,dock,tidal_channel,water,wetland,reservoir,glacier,"
    "fence,wall,hedge,city_wall,retaining_wall,kerb,guard_rail,handrail,line,minor_line,cable,pipeline,cutline,"
    "coastline,cliff,ridge,valley,arete,embankment,tree_row,cable_car,gondola,chair_lift,drag_lift,t-bar,j-bar,platter,"
    "mixed_lift,zip_line,goods,runway,taxiway,apron,ferry,building,administrative,forest,park,residential_area"
)
_OSM = {_plain(word): word for word in KNOWN_HIGHWAYS} | {_plain(word): _NONE for word in NO_ROADS}
_OSM = {_plain(word): _NONE for word in _OSM_OTHERS.split(",")} | _OSM
_HIGHWAY = dict(_OSM)  # of a column `highway`: other words in it stand for kinds that are not known here

_VOCABULARIES = {
    "OpenStreetMap": _Vocabulary(_OSM),
    "TIGER": _Vocabulary(
        _words(
            motorway="S1100,A11,A12,A13,A14,A15,A16,A17,A18,A19",
            primary="S1200,A21,A22,A23,A24,A25,A26,A27,A28,A29",
            secondary="A31,A32,A33,A34,A35,A36,A37,A38,A39",
            residential="S1400,A41,A42,A43,A44,A45,A46,A47,A48,A49",
            track="S1500,A51,A52,A53",
            motorway_link="S1630,A63",
            service="S1640,S1730,S1740,S1750,S1780,S1810,A64,A73,A74",
            footway="S1710,A71",
            steps="S1720,A72",
            cycleway="S1820",
            bridleway="S1830",
            road="A60,A61,A62",
        )
        | dict.fromkeys(("r*", "h*", "k*", "p*", "l*", "c*", "g*", "b*", "d*", "e*", "f*"), _NONE),
        "U.S. Census Bureau, TIGER/Line",
    ),
    "Ordnance Survey": _Vocabulary(
        _words(
            motorway="Motorway,Motorway Collapsed Dual Carriageway",
            primary="A Road,A Road Primary,Primary Road,A Road Collapsed Dual Carriageway",
            secondary="B Road,B Road Primary,B Road Collapsed Dual Carriageway",
            tertiary="Minor Road,Classified Unnumbered,Minor Road Collapsed Dual Carriageway",
            residential="Local Road,Local Access Road,Local Street",
            unclassified="Unclassified",
            service="Restricted Local Access Road,Secondary Access Road,Restricted Secondary Access Road,"
            "Not Classified,Private Road Publicly Accessible,Private Road Restricted Access",
            pedestrian="Pedestrianised Street,Shared Use Road",
            footway="Path,Path With Cycle And Pedestrian Access",
        ),
        "Contains OS data © Crown copyright and database right",
    ),
    "IGN": _Vocabulary(
        _words(
            motorway="Type autoroutier,Autoroute,Quasi-autoroute",
            primary="Liaison principale,Route à 2 chaussées",
            secondary="Liaison régionale",
            tertiary="Liaison locale",
            road="Route à 1 chaussée,Rond-point,Bretelle",
            track="Route empierrée,Chemin",
            path="Sentier",
            steps="Escalier",
            cycleway="Piste cyclable",
            none="Bac ou liaison maritime,Bac auto,Bac piéton,Voie ferrée principale,Voie de service,Tramway,Métro,"
            "LGV,Funiculaire ou crémaillère,Cours d'eau,Écoulement naturel,Écoulement canalisé,Mur,Clôture,"
            "Ligne électrique",
        ),
        "© IGN, Licence Ouverte 2.0",
    ),
    "NVDB": _Vocabulary(
        _words(
            road="Enkel bilveg,Kanalisert veg,Rampe,Rundkjøring,Bilnät,Vanlig väg",
            trunk="Europaveg,Europaväg,Motortrafikled",
            motorway="Motorveg,Motorväg",
            primary="Riksveg,Riksväg",
            secondary="Fylkesveg,Primär länsväg",
            tertiary="Övrig länsväg,Sekundär länsväg,Tertiär länsväg",
            residential="Kommunal veg,Kommunalveg,Kommunal väg,Kommunal gata",
            living_street="Gatetun,Gångfartsområde",
            service="Privat veg,Privatveg,Enskild väg",
            track="Skogsveg,Skogsbilveg,Traktorveg",
            pedestrian="Gågate,Gågata",
            cycleway="Gang- og sykkelveg,Sykkelveg,Cykelnät,Cykelväg",
            footway="Gangveg,Fortau,Gangfelt,Gångnät,Gångväg",
            steps="Trapp,Trappa",
            path="Sti",
            none="Bilferje,Passasjerferje,Annet,Färjeled,Jernbane,Järnväg",
        ),
        "Nasjonal vegdatabank (NVDB), NLOD",
    ),
    "ATKIS": _Vocabulary(
        _words(
            motorway="Bundesautobahn",
            primary="Bundesstraße",
            secondary="Landesstraße,Staatsstraße,Landesstraße Staatsstraße",
            tertiary="Kreisstraße",
            residential="Gemeindestraße",
            road="AX_Strassenachse,AX_Fahrbahnachse,AX_Strasse,Straßenachse,Fahrbahnachse,Straße",
            track="AX_Fahrwegachse,Fahrwegachse,Hauptwirtschaftsweg,Wirtschaftsweg",
            path="AX_WegPfadSteig,Weg Pfad Steig",
            pedestrian="Fußgängerzone",
            footway="Fußweg",
            cycleway="Radweg,Rad- und Fußweg",
            none="AX_Bahnstrecke,AX_Gleis,AX_Gewaesserachse,AX_Seilbahn,AX_Leitung,AX_BauwerkImVerkehrsbereich,AX_Fahrleitung",
        ),
    ),
}

#: Numbers that stand for kinds, in columns of these names: roads of Norway by who keeps them, of ATKIS and of the IGN.
_CODES = {
    "wdm": {"1301": "motorway", "1303": "primary", "1305": "secondary", "1306": "tertiary", "1307": "residential"},
    "widmung": {"1301": "motorway", "1303": "primary", "1305": "secondary", "1306": "tertiary", "1307": "residential"},
    "fkt": {"5211": "track", "5212": "track", "1808": "pedestrian"},
    "objart": {
        "42002": _ROAD,
        "42003": _ROAD,
        "42005": _ROAD,
        "42008": "track",
        "53003": "path",
        **dict.fromkeys(("42014", "42015", "42016", "44004", "51004", "53001", "53005", "53006", "53007"), _NONE),
    },
    "vegkategor": {
        "e": "trunk",
        "r": "primary",
        "f": "secondary",
        "k": "residential",
        "p": "service",
        "s": "track",
    },
    "importance": {"1": "trunk", "2": "primary", "3": "secondary", "4": "tertiary", "5": "residential"},
}

#: Names of columns, of which ten letters are left in a shapefile, in the order in which they are believed.
_KINDS = (
    "highway", "fclass", "mtfcc", "cfcc", "function", "roadfuncti", "road_funct", "classifica", "road_class",
    "roadclassi", "nature", "typeveg", "type_veg", "typvei", "vegtype", "vagtyp", "vägtyp", "wdm", "widmung", "fkt",
    "importance", "vegkategor", "vagkategor", "vägkategor", "kategori", "vocation", "objart", "objart_txt", "class",
    "type", "subtype",
)  # fmt: skip
_TUNNELS = ("tunnel", "road_flags", "road_struc", "roadstruct", "structure", "pos_sol", "position_p", "medium")
_NAMES = (
    "name", "names", "street_nam", "streetname", "fullname", "name1", "name_1", "nom", "nom_rue_g", "nom_voie_g",
    "nom_1_gauc", "nom_collab", "nam", "gatenavn", "adressenav", "vagnamn", "st_name", "road_name",
)  # fmt: skip
_TAGS = ("other_tags", "all_tags", "tags")
#: Keys of OpenStreetMap that describe a line that is no road.
_OTHER_KEYS = (
    "waterway", "railway", "barrier", "power", "aeroway", "aerialway", "man_made", "natural", "landuse", "building",
    "boundary", "leisure", "amenity", "pipeline",
)  # fmt: skip
_OSM_MARKS = {"osm_id", "osm_way_id", "osm_type", "full_id", "osmid", "@id", *_TAGS, *_OTHER_KEYS}
_OSM_KINDS = ("highway", "fclass")
_OSM_NAME, _OVERTURE = "OpenStreetMap", "© OpenStreetMap contributors, Overture Maps Foundation, ODbL 1.0"
_AREA = "area"

_KNOWN = {name[:10] for name in (*_KINDS, *_TUNNELS, *_NAMES, *_TAGS, *_OTHER_KEYS, *_OSM_MARKS, _AREA)}
_PAIR = re.compile(r'"(highway|tunnel|area|railway|waterway|barrier|power)"\s*(?:=>|:)\s*"([^"]*)"')


_CODE = re.compile(r"[a-z]\d+")
#: Number of values by which the content of a column is recognised.
_SAMPLE = 1000


def is_known_column(name: str) -> bool:
    """Whether a column of this name may describe a road."""
    return name.lower()[:10] in _KNOWN


def names_kinds(values: AnyArray) -> bool:
    """Whether most filled values of a column are words for kinds of lines, of one maker of maps."""
    return _maker_of(values) is not None


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
    """

    kinds: tuple[tuple[str, Mapping[str, str]], ...] = ()
    none_is_no_road: bool = False
    attribution: str = ""

    def adapt(self, table: RoadTable) -> RoadLines:
        """Return the lines of a table that are roads, or may be; others are counted in `meta`."""
        columns = _named(table.columns)
        kinds, others = self._kinds(columns, len(table.shapes))
        shapes = table.shapes[~others]
        lines, place = simple_lines(shapes)
        row = np.flatnonzero(~others)[place]
        tunnels = [
            in_tunnel(_each(columns[name], _HIDDEN.get(name, _itself))[row]) for name in _TUNNELS if name in columns
        ]
        tunnels += [in_tunnel(_tag(columns[name], "tunnel")[row]) for name in _TAGS if name in columns]
        called = next((columns[name] for name in _NAMES if name in columns), None)
        counts = {"no_roads": int(others.sum()), "broken": _count_broken(shapes)}
        told = {"attribution": self.attribution, **table.meta, **counts}
        return RoadLines(
            lines,
            table.crs,
            kinds[row] if self.kinds else None,
            np.logical_or.reduce(tunnels) if tunnels else None,
            {"features": len(table.shapes)} | {key: value for key, value in told.items() if value},
            None if called is None else _each(called[row], _text),
            simple_areas(shapes),
        )

    def _kinds(self, columns: Mapping[str, AnyArray], n: int) -> tuple[AnyArray, BoolArray]:
        """Return (N,) the kind of each feature, or None, and which are no roads."""
        kinds, others = np.full(n, None, object), np.zeros(n, bool)
        for name, words in self.kinds:
            told = _each(columns.get(name, kinds), partial(_kind_of, words=words))
            better = [had is None or (had == _ROAD and new is not None) for had, new in zip(kinds, told, strict=True)]
            kinds = np.where(better, told, kinds)
            others |= told == _NONE
        unknown = np.array([kind is None for kind in kinds], bool)
        for name in _OTHER_KEYS:
            others |= unknown & (_each(columns[name], _is_filled).astype(bool) if name in columns else False)
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
    for name in [name for name in _KINDS if name in columns] + others:
        if name in others and kinds:
            break
        if _share(columns[name], _CODES.get(name, {})) > 0.5:
            kinds[name] = _CODES[name]
        elif maker := _maker_of(columns[name]):
            kinds[name], makers[name] = _VOCABULARIES[maker].words, maker
            if name in _OSM_KINDS and maker == _OSM_NAME:
                break
    is_osm = bool(columns.keys() & _OSM_MARKS) or table.meta.get("format") == _OSM_NAME
    if "highway" in columns and (is_osm or makers.get("highway") == _OSM_NAME):
        kinds = {"highway": _HIGHWAY}
        makers["highway"] = _OSM_NAME
    credit = [_VOCABULARIES[maker].attribution for maker in makers.values()]
    if {"subtype", "class"} <= makers.keys():
        credit = [_OVERTURE]
    elif is_osm and _OSM_NAME in makers.values():
        credit = [OSM_ATTRIBUTION]
    is_own = any(kinds.get(name) is words for name, words in (("highway", _HIGHWAY), ("fclass", _OSM)))
    return Schema(tuple(kinds.items()), is_own, next(filter(None, credit), ""))


def _named(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return columns by the first ten letters of their names, as a shapefile has them; `highway` out of other tags."""
    named: dict[str, AnyArray] = {}
    for name, values in columns.items():
        named.setdefault(str(name).lower()[:10], values)
    for name in _TAGS:
        if name in named and "highway" not in named and any(tags := _tag(named[name], "highway")):
            named["highway"] = tags
    return named


def _maker_of(values: AnyArray) -> str | None:
    """Return the maker of maps whose words most filled values are."""
    shares = {maker: _share(values, vocabulary.words) for maker, vocabulary in _VOCABULARIES.items()}
    best = max(shares, key=lambda maker: shares[maker])
    return best if shares[best] > 0.5 else None


def _share(values: AnyArray, words: Mapping[str, str]) -> float:
    """Return the share of the filled values that is known."""
    if not words:
        return 0.0
    filled = [value for value in values if _is_filled(value)]
    sample = filled[:: max(len(filled) // _SAMPLE, 1)]
    known = sum(any(_look_up(word, words) for word in _split(value)) for value in sample)
    return known / len(sample) if sample else 0.0


def _kind_of(value: Any, words: Mapping[str, str]) -> str | None:
    """Return the `highway` that a value stands for, several with semicolons between them; None: for none."""
    found = _split(value)
    kinds = dict.fromkeys(_look_up(word, words) or (word if words is _HIGHWAY else None) for word in found)
    roads = [kind for kind in kinds if kind not in (None, _NONE)]
    return ";".join(map(str, roads)) or (_NONE if _NONE in kinds else None)


def _look_up(word: str, words: Mapping[str, str]) -> str | None:
    plain = _plain(word)
    return words.get(plain) or (words.get(f"{plain[0]}*") if _CODE.fullmatch(plain) else None)


def _split(value: Any) -> list[str]:
    """Return the words of a value: of text with separators, as osmnx writes lists, or of a list."""
    if not _is_filled(value):
        return []
    if isinstance(value, str):
        return [word for part in re.split(r"[;,|]", value) if (word := part.strip(" []{}()'\""))]
    if isinstance(value, tuple | list | np.ndarray | set):
        return [str(one) for one in value]
    return [f"{value:g}" if isinstance(value, float) else str(value)]


def _is_filled(value: Any) -> bool:
    if isinstance(value, str):
        return value.strip().lower() not in ("", "no", "none", "nan", "null")
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


def _flags(value: Any) -> Any:
    """Return Overture's flags that hold for a whole segment."""
    rules = _json(value)
    rules = rules if isinstance(rules, list | tuple | np.ndarray) else ()
    whole = [rule for rule in rules if isinstance(rule, dict) and rule.get("between") is None]
    found = [rule.get("values") for rule in whole]
    return [str(flag) for flags in found if isinstance(flags, list | tuple | np.ndarray) for flag in flags]


def _text(value: Any) -> str | None:
    """Return the name of a street; of Overture's names the primary one."""
    told = _json(value)
    told = told.get("primary") if isinstance(told, dict) else value
    return ";".join(map(str, told)) if isinstance(told, list | tuple) else str(told) if _is_filled(told) else None


def _json(value: Any) -> Any:
    try:
        return json.loads(value) if isinstance(value, str) and value[:1] in ("{", "[") else value
    except (ValueError, RecursionError):
        return value


def _itself(value: Any) -> Any:
    return value


def _below(value: Any) -> str:
    """Return whether the IGN has a road below the ground: a number below 0."""
    return "yes" if str(value).strip().startswith("-") else "no"


#: Tunnels in columns of other names.
_HIDDEN: dict[str, Callable[[Any], Any]] = {
    "road_flags": _flags,
    "pos_sol": _below,
    "position_p": _below,
    "medium": lambda value: "yes" if str(value).strip().lower() in ("u", "under terrenget") else "no",
    **dict.fromkeys(
        ("structure", "road_struc", "roadstruct"), lambda value: "yes" if "tunnel" in str(value).lower() else "no"
    ),
}


def _count_broken(shapes: AnyArray) -> int:
    """Count shapes with a vertex that is not finite."""
    import shapely

    coords, shape = shapely.get_coordinates(shapes, return_index=True)
    return len(np.unique(shape[~np.isfinite(coords).all(axis=1)]))


def _each(values: AnyArray, make: Callable[[Any], Any]) -> AnyArray:
    """Return a function's result for each value; it is called once for equal text."""
    made: dict[str, Any] = {}
    found = np.empty(len(values), object)
    for i, value in enumerate(values):
        if isinstance(value, str):
            if value not in made:
                made[value] = make(value)
            found[i] = made[value]
        else:
            found[i] = make(value)
    return found
