"""The same streets in the tables of many makers of maps, with lines among them that are no roads."""

import json

import numpy as np
import shapely

#: Streets by kind in OpenStreetMap's words: a lattice, and one in a tunnel.
KINDS = ["primary", "secondary", "tertiary", "residential", "residential", "footway", "track", "steps", "residential"]
TUNNEL = [False] * 8 + [True]
STREETS = [shapely.LineString([(-8.62, 41.15 + 0.001 * k), (-8.61, 41.15 + 0.001 * k)]) for k in range(9)]
STREETS += [shapely.LineString([(-8.619 + 0.001 * k, 41.149), (-8.619 + 0.001 * k, 41.158)]) for k in range(8)]
KINDS += ["residential"] * 8
TUNNEL += [False] * 8
#: What else lies there: lines across the streets.
OTHERS = [shapely.LineString([(-8.6195 + 0.001 * k, 41.149), (-8.6145 + 0.001 * k, 41.158)]) for k in range(3)]


def _mapped(table, default=None):
    return [table.get(kind, default) for kind in KINDS]


_TIGER = {"primary": "S1200", "secondary": "S1400", "tertiary": "S1400", "residential": "S1400", "footway": "S1710"}
_TIGER |= {"track": "S1500", "steps": "S1720"}
_OS = {"primary": "A Road", "secondary": "B Road", "tertiary": "Minor Road", "residential": "Local Road"}
_IGN = {"footway": "Sentier", "track": "Chemin", "steps": "Escalier"}
_IGN_RANK = {"primary": "2", "secondary": "3", "tertiary": "4", "footway": "6", "track": "6", "steps": "6"}
_NVDB = {"footway": "Gang- og sykkelveg", "track": "Traktorveg", "steps": "Trapp"}
_ATKIS = {"footway": "53003", "track": "42008", "steps": "53003"}
_WDM = {"primary": "1303", "secondary": "1305", "tertiary": "1306", "residential": "1307"}
_FLAGS = [{"values": ["is_tunnel"], "between": None}]

#: Columns of each schema: of the streets, and of what else lies there.
SCHEMAS = {
    "osm": ({"highway": KINDS, "tunnel": ["yes" if first else None for first in TUNNEL]}, {"highway": [None] * 3}),
    "gdal": (
        {
            "highway": KINDS,
            "railway": [None] * 17,
            "waterway": [None] * 17,
            "other_tags": ['"lanes"=>"2","tunnel"=>"yes"' if first else '"lanes"=>"2"' for first in TUNNEL],
        },
        {"highway": [None] * 3, "railway": ["rail", None, None], "waterway": [None, "stream", None]},
    ),
    "geofabrik": (
        {"osm_id": ["7"] * 17, "fclass": KINDS, "tunnel": ["T" if first else "F" for first in TUNNEL]},
        {"fclass": ["rail", "stream", "canal"]},
    ),
    "bbbike": (
        {"osm_id": [7] * 17, "type": KINDS, "tunnel": [int(first) for first in TUNNEL]},
        {"type": ["rail", "river", "stream"]},
    ),
    "overture": (
        {
            "class": KINDS,
            "subtype": ["road"] * 17,
            "road_flags": [json.dumps(_FLAGS) if first else None for first in TUNNEL],
            "names": [json.dumps({"primary": f"Rua {n}"}) for n in range(17)],
        },
        {"class": ["river", "unknown", None], "subtype": ["water", "rail", "water"]},
    ),
    "tiger": ({"MTFCC": _mapped(_TIGER), "FULLNAME": ["Main St"] * 17}, {"MTFCC": ["R1011", "H3010", "P0001"]}),
    "os": (
        {
            "road_function": _mapped(_OS, "Restricted Local Access Road"),
            "road_classification": _mapped({"primary": "A Road", "secondary": "B Road"}, "Unclassified"),
            "road_structure": ["Road In Tunnel" if first else None for first in TUNNEL],
        },
        None,
    ),
    "ign": (
        {
            "nature": _mapped(_IGN, "Route à 1 chaussée"),
            "importance": _mapped(_IGN_RANK, "5"),
            "position_par_rapport_au_sol": ["-1" if first else "0" for first in TUNNEL],
        },
        {"nature": ["Bac ou liaison maritime", "Voie ferrée principale", "Mur"]},
    ),
    "nvdb": (
        {
            "typeVeg": _mapped(_NVDB, "Enkel bilveg"),
            "vegkategori": _mapped({"primary": "R", "secondary": "F", "footway": "K"}, "K"),
            "medium": ["U" if first else "T" for first in TUNNEL],
        },
        {"typeVeg": ["Bilferje", "Passasjerferje", "Bilferje"]},
    ),
    "atkis": (
        {"objart": _mapped(_ATKIS, "42003"), "wdm": _mapped(_WDM, "9997")},
        {"objart": ["42014", "44004", "51004"]},
    ),
}
TELLS_TUNNELS = set(SCHEMAS) - {"tiger", "atkis"}


def table(schema):
    """Shapes and columns of a schema."""
    columns, others = SCHEMAS[schema]
    if others is None:
        return list(STREETS), dict(columns)
    return STREETS + OTHERS, {name: values + others.get(name, [None] * 3) for name, values in columns.items()}


def expected(schema, kinds=("primary", "secondary", "tertiary", "residential")):
    """The streets that are to be taken."""
    sees = schema in TELLS_TUNNELS
    return [
        line
        for line, kind, hidden in zip(STREETS, KINDS, TUNNEL, strict=True)
        if kind in kinds and not (hidden and sees)
    ]


def frame(schema):
    """A GeoDataFrame."""
    import geopandas as gpd

    shapes, columns = table(schema)
    return gpd.GeoDataFrame(
        {name: np.array(values, object) for name, values in columns.items()}, geometry=shapes, crs=4326
    )
