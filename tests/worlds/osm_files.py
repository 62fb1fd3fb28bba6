"""The streets of Fenway as OpenStreetMap files of every shape that programs write."""

import json
from functools import cache

from worlds.fenway import elements


def _node(n, where=0.0, **more):
    reported = "".join(f' {key}="{value}"' for key, value in more.items())
    return f'<node id="{n["id"]}" lat="{n["lat"] + where}" lon="{n["lon"] + where}"{reported}/>'


def _way(way, nodes=None, **more):
    reported = "".join(f' {key}="{value}"' for key, value in more.items())
    place = {} if nodes is None else {k: f' lat="{nodes[k]["lat"]}" lon="{nodes[k]["lon"]}"' for k in way["nodes"]}
    refs = "".join(f'<nd ref="{k}"{place.get(k, "")}/>' for k in way["nodes"])
    tags = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in way["tags"].items() if k in ("highway", "tunnel"))
    return f'<way id="{way["id"]}"{reported}>{refs}{tags}</way>'


def _xml(*rows):
    return "\n".join(('<osm version="0.6">', *rows, "</osm>"))


def _negative():
    nodes, ways = elements()
    return (
        {-k: {**n, "id": -k} for k, n in nodes.items()},
        [{**way, "id": -way["id"], "nodes": [-k for k in way["nodes"]]} for way in ways],
    )


@cache
def osm_texts():
    """Texts of files by what is odd about them, all with the same streets."""
    nodes, ways = elements()
    below, ways_below = _negative()
    gone = {"id": 5, "nodes": ways[0]["nodes"][:1] + ways[-1]["nodes"][-1:], "tags": {"highway": "residential"}}
    first = [_node(n, 0.001, version=1, visible="true") for n in nodes.values()]
    second = [_node(n, version=2, visible="true") for n in nodes.values()]
    old = [_way({**way, "tags": {"highway": "motorway"}}, version=1) for way in ways]
    return {
        "nodes first": _xml(*map(_node, nodes.values()), *map(_way, ways)),
        "ways first": _xml(*map(_way, ways), *map(_node, nodes.values())),
        "places in ways": _xml(*(_way(way, nodes) for way in ways)),
        "places without ids": _xml(*(_way(way, nodes) for way in ways)).replace(" ref=", " old="),
        "below zero": _xml(*map(_node, below.values()), *map(_way, ways_below)),
        "some below zero": _xml(*map(_node, nodes.values()), *map(_way, ways[1:]), *map(_node, below.values()),
                                _way(ways_below[0])),
        "deleted": _xml(*map(_node, nodes.values()), _way(gone, visible="false", version=2), *map(_way, ways)),
        "deleted in JOSM": _xml(*map(_node, nodes.values()), _way(gone, action="delete"), *map(_way, ways)),
        "history": _xml(
            *(row for pair in zip(first, second, strict=True) for row in pair),
            *(row for k, way in enumerate(ways) for row in (old[k], _way(way, version=2))),
            _way(gone, version=1), _way(gone, version=2, visible="false"),
        ),
        "history, newest first": _xml(*second, *first, *(_way(way, version=2) for way in ways), *old),
        "no longer a road": _xml(
            *map(_node, nodes.values()), _way(gone, version=1), _way({**gone, "tags": {}}, version=2), *map(_way, ways)
        ),
    }  # fmt: skip


def overpass_answers():
    """The same as answers of Overpass in JSON, with places in nodes behind the ways, and in the ways."""
    nodes, ways = elements()
    places = [{**way, "geometry": [{k: nodes[n][k] for k in ("lat", "lon")} for n in way["nodes"]]} for way in ways]
    bare = [{k: v for k, v in way.items() if k != "nodes"} for way in places]
    kinds = {"skel": [*ways, *nodes.values()], "geom": places, "tags geom": bare}
    return {name: json.dumps({"version": 0.6, "osm3s": {}, "elements": found}) for name, found in kinds.items()}


def o5m():
    """The same streets as o5m (https://wiki.openstreetmap.org/wiki/O5m)."""
    nodes, ways = elements()
    rows, last, places = [b"\xff\xe0\x04o5m2"], 0, [0, 0]
    for n in nodes.values():
        xy = [round(n["lon"] * 1e7), round(n["lat"] * 1e7)]
        moved = _signed(n["id"] - last) + b"\0" + b"".join(_signed(a - b) for a, b in zip(xy, places, strict=True))
        rows.append(b"\x10" + varint(len(moved)) + moved)
        last, places = n["id"], xy
    rows.append(b"\xff")
    last = ref = 0
    for way in ways:
        steps = b"".join(_signed(b - a) for a, b in zip([ref, *way["nodes"]], way["nodes"], strict=False))
        tags = {key: value for key, value in way["tags"].items() if key in ("highway", "tunnel")}
        texts = b"".join(f"\0{key}\0{value}\0".encode() for key, value in tags.items())
        content = _signed(way["id"] - last) + b"\0" + varint(len(steps)) + steps + texts
        rows.append(b"\x11" + varint(len(content)) + content)
        last, ref = way["id"], way["nodes"][-1]
    return b"".join([*rows, b"\xfe"])


def varint(value):
    parts = [value >> shift & 127 for shift in range(0, max(value.bit_length(), 1), 7)]
    return bytes([*(part | 128 for part in parts[:-1]), parts[-1]])


def _signed(value):
    return varint(2 * value if value >= 0 else -2 * value - 1)
