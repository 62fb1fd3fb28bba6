"""Road files that are a part of what was asked for: answers of services, and extracts that cut ways."""

import gzip
import json
import logging

import numpy as np
import pytest
import shapely
from worlds.fenway import elements, osm_xml, streets

from roadgeo.errors import MaskError, RoadSourceError
from roadgeo.sources.drawn_roads import draw_roads
from roadgeo.sources.overpass import read_area
from roadgeo.sources.roads import read_roads
from roadgeo.sources.streams import read_lines

HALF = len(streets()[0]) // 2
REMARK = 'runtime error: Query timed out in "query" at line 3 after 26 seconds.'


def features(n=HALF):
    rows = zip(shapely.to_geojson(streets()[0][:n]), streets()[1], strict=False)
    return [{"type": "Feature", "properties": {"highway": kind}, "geometry": json.loads(shape)} for shape, kind in rows]


def esri():
    rows = [(item["properties"], [item["geometry"]["coordinates"]]) for item in features()]
    return {
        "geometryType": "esriGeometryPolyline",
        "spatialReference": {"wkid": 4326},
        "fields": [{"name": "highway", "type": "esriFieldTypeString"}],
        "features": [{"attributes": given, "geometry": {"paths": paths}} for given, paths in rows],
        "exceededTransferLimit": True,
    }


def gml(**root):
    words = " ".join(f'{key}="{value}"' for key, value in root.items())
    lines = [" ".join(f"{x} {y}" for x, y in line.coords) for line in streets()[0][:HALF]]
    members = [
        f'<member><a:r gml:id="r{k}"><a:highway>{kind}</a:highway><a:g>'
        f'<gml:LineString srsName="EPSG:4326" gml:id="l{k}">'
        f"<gml:posList>{places}</gml:posList></gml:LineString></a:g></a:r></member>"
        for k, (places, kind) in enumerate(zip(lines, streets()[1], strict=False))
    ]
    names = 'xmlns="http://www.opengis.net/wfs/2.0" xmlns:gml="http://www.opengis.net/gml/3.2" xmlns:a="http://a"'
    return f"<FeatureCollection {names} {words}>{''.join(members)}</FeatureCollection>"


def collection(**more):
    return {"type": "FeatureCollection", "features": features(), **more}


NEXT = [{"rel": "self", "href": "here"}, {"href": "there", "rel": "next"}]
PARTS = {
    "arcgis.geojson": (collection(properties={"exceededTransferLimit": True}), "exceededTransferLimit"),
    "top.geojson": (collection(exceededTransferLimit=True), "exceededTransferLimit"),
    "esri.json": (esri(), "exceededTransferLimit"),
    "wfs.geojson": (collection(totalFeatures=9999), f"{HALF} of 9,999 features"),
    "first.geojson": ({"numberMatched": 9999, "numberReturned": HALF, **collection()}, f"{HALF} of 9,999 features"),
    "pages.json": (collection(links=NEXT), "next"),
    "wfs.gml": (gml(numberMatched=9999, numberReturned=HALF), f"{HALF} of 9,999 features"),
    "next.gml": (gml(numberMatched="unknown", next="http://there"), "next"),
}


@pytest.mark.parametrize("name", PARTS)
def test_a_part_of_an_answer_is_mentioned_as_one(tmp_path, caplog, name):
    content, mention = PARTS[name]
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with caplog.at_level(logging.WARNING):
        assert len(read_roads(path)) > 0
    assert "says that it is not whole" in caplog.text
    assert mention in caplog.text
    caplog.clear()
    draw_roads(path)
    assert mention in caplog.text


@pytest.mark.parametrize(
    "content",
    [
        collection(exceededTransferLimit=False),
        collection(numberMatched=HALF, numberReturned=HALF, links=NEXT[:1]),
        collection(totalFeatures="unknown"),
        collection(numberMatched=HALF, numberReturned=2, links=NEXT),  # pages that were put together
        gml(numberMatched=HALF, numberReturned=HALF),
    ],
)
def test_a_whole_answer_is_not(tmp_path, caplog, content):
    path = tmp_path / ("a.gml" if isinstance(content, str) else "a.geojson")
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with caplog.at_level(logging.WARNING):
        read_roads(path)
    assert "whole" not in caplog.text


def test_an_outline_that_is_a_part_is_mentioned(tmp_path, caplog):
    outline = {"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(shapely.box(0, 0, 1, 1)))}
    path = tmp_path / "outline.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [outline], "numberMatched": 3}))
    read_area(path)
    assert "1 of 3 features" in caplog.text


@pytest.mark.parametrize("name", ["a.json", "a.osm", "a.osm.gz"])
def test_an_answer_that_overpass_did_not_complete_is_refused(tmp_path, name):
    nodes, ways = elements()
    if name == "a.json":
        text = json.dumps({"elements": [*nodes.values(), *ways], "remark": REMARK})
    else:
        text = osm_xml().replace("</osm>", f"<remark> {REMARK} </remark></osm>")
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith("gz") else text.encode())
    with pytest.raises(RoadSourceError, match=r"not whole: runtime error: Query timed out .* 26 seconds; ask for"):
        read_roads(path)
    with pytest.raises(MaskError, match="not whole"):
        draw_roads(path)


def cut_short(name):
    """Return a file with a way of six nodes, of which the third and the fourth are not there."""
    places = [{"lat": 42.34, "lon": -71.09 + 0.001 * k} for k in range(6)]
    known = [None if k in (2, 3) else place for k, place in enumerate(places)]
    nodes = [{"type": "node", "id": k + 1, **place} for k, place in enumerate(places) if known[k]]
    way = {"type": "way", "id": 9, "nodes": [*range(1, 7)], "tags": {"highway": "residential"}}
    if name == "nodes.json":
        return json.dumps({"elements": [*nodes, way]})
    if name == "geom.json":
        return json.dumps({"elements": [{**way, "geometry": known}]})
    inner = name == "geom.osm"
    refs = [
        f'<nd ref="{k + 1}"' + (f' lat="{place["lat"]}" lon="{place["lon"]}"/>' if place and inner else "/>")
        for k, place in enumerate(known)
    ]
    rows = "" if inner else "".join(f'<node id="{n["id"]}" lat="{n["lat"]}" lon="{n["lon"]}"/>' for n in nodes)
    return f'<osm version="0.6">{rows}<way id="9">{"".join(refs)}<tag k="highway" v="residential"/></way></osm>'


@pytest.mark.parametrize("name", ["nodes.json", "geom.json", "nodes.osm", "geom.osm", "nodes.osm.pbf"])
def test_no_road_crosses_the_gap_in_a_way(tmp_path, name):
    path = tmp_path / name
    if name.endswith("pbf"):
        import osmium

        (tmp_path / "nodes.osm").write_text(cut_short("nodes.osm"))
        with osmium.SimpleWriter(str(path)) as writer:
            for item in osmium.FileProcessor(str(tmp_path / "nodes.osm")):
                writer.add(item)
    else:
        path.write_text(cut_short(name))
    spans = sorted(shapely.bounds(read_lines(path).lines)[:, ::2].tolist())
    assert np.allclose(spans, [[-71.09, -71.089], [-71.086, -71.085]], atol=1e-7)
