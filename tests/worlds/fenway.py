"""A few real streets of Fenway, Boston (see data/README.md), written in every format that tests need."""

import bz2
import gzip
import json
from functools import lru_cache
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pyogrio
import shapely

ANSWER = Path(__file__).parents[1] / "data" / "fenway_overpass.json"


@lru_cache
def elements():
    """Nodes by number, and ways."""
    found = json.loads(ANSWER.read_text(encoding="utf-8"))["elements"]
    return {e["id"]: e for e in found if e["type"] == "node"}, [e for e in found if e["type"] == "way"]


@lru_cache
def streets():
    """(L,) LineStrings in degrees, and their `highway` and `tunnel`."""
    nodes, ways = elements()
    lines = [shapely.LineString([(nodes[n]["lon"], nodes[n]["lat"]) for n in way["nodes"]]) for way in ways]
    tags = [way["tags"] for way in ways]
    return np.array(lines, object), [t["highway"] for t in tags], [t.get("tunnel") for t in tags]


def osm_xml():
    """The same as OpenStreetMap XML."""
    nodes, ways = elements()
    rows = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6" generator="roadgeo tests">']
    rows += [f'<node id="{n["id"]}" version="1" lat="{n["lat"]}" lon="{n["lon"]}"/>' for n in nodes.values()]
    for way in ways:
        refs = "".join(f'<nd ref="{n}"/>' for n in way["nodes"])
        tags = "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in way["tags"].items())
        rows.append(f'<way id="{way["id"]}" version="1">{refs}{tags}</way>')
    return "\n".join([*rows, "</osm>"])


def write_vector(path, lines, crs="EPSG:4326", append=False, layer=None, **columns):
    """Write lines with GDAL; the format by the name."""
    shapes = np.array(lines, object)
    kinds = {shape.geom_type for shape in shapes if shape is not None}
    kind = kinds.pop() if len(kinds) == 1 else "Unknown"
    if kind != "Unknown" and any(shape is not None and shape.has_z for shape in shapes):
        kind += " Z"
    pyogrio.raw.write(
        path,
        shapely.to_wkb(shapes),
        [np.array(values, object) for values in columns.values()],
        np.array(list(columns), object),
        geometry_type=kind,
        crs=crs,
        append=append,
        layer=layer,
    )
    return path


def write_streets(path):
    """Write the streets in the format that the name tells."""
    lines, highway, tunnel = streets()
    name = path.name
    if name.endswith(".osm"):
        path.write_text(osm_xml(), encoding="utf-8")
    elif name.endswith(".osm.gz"):
        path.write_bytes(gzip.compress(osm_xml().encode()))
    elif name.endswith(".osm.bz2"):
        path.write_bytes(bz2.compress(osm_xml().encode()))
    elif name.endswith(".osm.pbf"):
        import osmium

        with osmium.SimpleWriter(str(path)) as writer:
            for entity in osmium.FileProcessor(osmium.io.FileBuffer(osm_xml().encode(), "osm")):
                writer.add(entity)
    elif name.endswith(".parquet"):
        import geopandas as gpd

        gpd.GeoDataFrame({"highway": highway, "tunnel": tunnel}, geometry=lines, crs="EPSG:4326").to_parquet(path)
    else:
        write_vector(path, lines, highway=highway, tunnel=tunnel)
    return path
