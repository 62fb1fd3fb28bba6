"""Make the demonstration's data: a piece of OpenStreetMap, masks as cameras and road segmenters see it, and the truth.

    python examples/demo/make_demo.py porto.osm.pbf oslo.osm.pbf

Independent of the rest of roadgeo on purpose: the masks are drawn from the raw ways, each carriageway for itself and as
wide as such a road is, without tunnels, not from the network that the reference makes of them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import osmium
import pyproj
import shapely
from shapely.geometry import LineString
from shapely.ops import substring

import roadgeo.evaluation.demo
from roadgeo._arrays import AnyArray, Float32Array, FloatArray
from roadgeo.geometry.homography import Homography
from roadgeo.storage.geopackage import FeatureTable, write_layers

__all__ = ["Camera", "make_demo"]

#: Vertices (V, 2) lon, lat, and the tags.
Way: TypeAlias = tuple[FloatArray, dict[str, str | None]]

PORTO = (-8.6600, 41.1380, -8.5820, 41.1830)  # west, south, east, north: about 6.5 x 5 km
ATTRIBUTION = "© OpenStreetMap contributors, ODbL 1.0"
TAGS = ("highway", "name", "oneway", "junction", "bridge", "tunnel", "layer", "lanes", "service", "access", "area")

#: Width on the ground of a road that OpenStreetMap draws as one line, metres.
WIDTH_M = {
    "motorway": 11.0,
    "motorway_link": 6.5,
    "trunk": 10.0,
    "trunk_link": 6.5,
    "primary": 10.0,
    "primary_link": 6.0,
    "secondary": 9.0,
    "secondary_link": 6.0,
    "tertiary": 8.0,
    "tertiary_link": 6.0,
    "unclassified": 6.5,
    "residential": 6.5,
    "living_street": 5.5,
    "service": 4.5,
}


@dataclass(frozen=True)
class Camera:
    """A pinhole camera and how well its roads were segmented.

    Attributes
    ----------
    lon, lat : float
        Where its axis meets the ground.
    size : (int, int)
        Width and height of the image, pixels.
    gsd_m : float
        Ground sampling at the axis.
    up_deg, tilt_deg, look_deg : float
        Direction of the image's up, clockwise from north; angle of the axis from the vertical; where it leans to.
    missing, service : float
        Shares of the streets that trees and shadows hide, and of the service roads that are seen as roads.
    noise : float
        Roughness of the segmenter's probabilities; 0 draws a clean mask.
    corners : bool
        Whether the mask was turned afterwards, which leaves black corners.
    """

    name: str
    title: str
    lon: float
    lat: float
    size: tuple[int, int]
    gsd_m: float
    up_deg: float = 0.0
    tilt_deg: float = 0.0
    look_deg: float = 0.0
    missing: float = 0.02
    service: float = 0.3
    noise: float = 0.0
    seed: int = 1


CAMERAS = (
    Camera("map_sheet", "a vertical picture, north up, 1 m per pixel", -8.6290, 41.1625, (1100, 1100), 1.0),
    Camera(
        "drone", "a drone that looks ahead, 30 degrees from the vertical", -8.6080, 41.1525, (1280, 960), 0.9,
        up_deg=128.0, tilt_deg=30.0, look_deg=128.0, missing=0.04, seed=2,
    ),
    Camera(
        "segmenter", "what a neural network makes of a hazy picture: a third of the streets broken or missing",
        -8.6255, 41.1520, (1024, 1024), 1.3,
        up_deg=301.0, tilt_deg=9.0, look_deg=20.0, missing=0.12, service=0.4, noise=1.0, seed=3,
    ),
    Camera(
        "high_flight", "from high above, 2.4 m per pixel, the city upside down", -8.6170, 41.1600, (1200, 900), 2.4,
        up_deg=197.0, tilt_deg=14.0, look_deg=300.0, missing=0.05, seed=4,
    ),
)  # fmt: skip
ELSEWHERE = Camera(
    "elsewhere", "another city, which is not on this map", 10.7950, 59.9130, (1100, 1100), 1.0, up_deg=20.0, seed=5
)


def make_demo(home_pbf: str, other_pbf: str, folder: Path) -> None:
    """Write `porto_roads.gpkg`, the masks and `truth.json` into a folder."""
    ways = read_ways(home_pbf, PORTO)
    columns = {tag: [way[tag] for _, way in ways] for tag in TAGS}
    write_layers(
        folder / "porto_roads.gpkg",
        [FeatureTable("roads", "LINESTRING", [np.round(line, 7) for line, _ in ways], columns, "EPSG:4326")],
    )
    truth = [draw(camera, ways, "EPSG:32629", folder) for camera in CAMERAS]
    around = (ELSEWHERE.lon - 0.03, ELSEWHERE.lat - 0.015, ELSEWHERE.lon + 0.03, ELSEWHERE.lat + 0.015)
    other = draw(ELSEWHERE, read_ways(other_pbf, around), "EPSG:32632", folder)
    truth.append({**other, "in_map": False})
    document = {"attribution": ATTRIBUTION, "masks": truth}
    (folder / "truth.json").write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def read_ways(pbf: str, box: tuple[float, float, float, float]) -> list[Way]:
    """Read the lines (V, 2) lon, lat and tags of all roads for cars inside a box, cut at its edge."""
    ways: list[Way] = []
    frame = shapely.box(*box)
    ways_only = osmium.filter.EntityFilter(osmium.osm.WAY)
    for way in osmium.FileProcessor(pbf).with_locations().with_filter(ways_only):
        assert isinstance(way, osmium.osm.Way)
        tags = way.tags
        if tags.get("highway") not in WIDTH_M or tags.get("area") == "yes":
            continue
        nodes = [(node.lon, node.lat) for node in way.nodes if node.location.valid()]
        if len(nodes) < 2:
            continue
        inside = shapely.intersection(LineString(nodes), frame)
        parts = [part for part in shapely.get_parts(inside) if part.geom_type == "LineString" and not part.is_empty]
        ways += [(np.asarray(part.coords), {tag: tags.get(tag) for tag in TAGS}) for part in parts]
    return ways


# --- a camera ---------------------------------------------------------------------------------------------------------


def homography(camera: Camera, x: float, y: float) -> FloatArray:
    """Homography from the camera's pixels (corner convention) to the metric CRS, its axis through (x, y)."""
    width, height = camera.size
    focal = float(max(camera.size))
    distance = camera.gsd_m * focal
    tilt, look, up = np.deg2rad([camera.tilt_deg, camera.look_deg, camera.up_deg])
    axis = np.array([np.sin(tilt) * np.sin(look), np.sin(tilt) * np.cos(look), -np.cos(tilt)])
    upward = np.array([np.sin(up), np.cos(up), 0.0])
    upward -= axis * (upward @ axis)
    upward /= np.linalg.norm(upward)
    right = np.cross(axis, upward)
    position = np.array([x, y, 0.0]) - distance * axis
    # A pixel's ray is right * u - upward * v + axis * focal; it meets z = 0 at position + ray * (-position z / ray z).
    rays = np.stack([right, -upward, axis * focal], axis=1) @ np.array(
        [[1.0, 0.0, -width / 2], [0.0, 1.0, -height / 2], [0.0, 0.0, 1.0]]
    )
    ground = np.stack(
        [position[0] * rays[2] - position[2] * rays[0], position[1] * rays[2] - position[2] * rays[1], rays[2]]
    )
    return np.asarray(ground / ground[2, 2])


def draw(camera: Camera, ways: Sequence[Way], crs: str, folder: Path) -> dict[str, Any]:
    """Draw one mask and return its truth."""
    to_crs = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    x, y = to_crs.transform(camera.lon, camera.lat)
    H = homography(camera, x, y)
    rng = np.random.default_rng(camera.seed)
    roads = draw_roads(camera, ways, to_crs, H, rng)
    image = blur(roads, camera, rng) if camera.noise else np.where(roads > 127, 255, 0).astype(np.uint8)
    cv2.imwrite(str(folder / f"{camera.name}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    width, height = camera.size
    center = Homography(H)(np.array([width / 2, height / 2]))
    lon, lat = to_crs.transform(center[0], center[1], direction="INVERSE")
    return {
        "mask": f"{camera.name}.png",
        "title": camera.title,
        "in_map": True,
        "crs": crs,
        "homography": H.tolist(),
        "center": {"lon": round(lon, 7), "lat": round(lat, 7)},
    }


def draw_roads(
    camera: Camera,
    ways: Sequence[Way],
    to_crs: pyproj.Transformer,
    H: FloatArray,
    rng: np.random.Generator,
) -> AnyArray:
    """Draw every visible road as wide as it is on the ground; (height, width) uint8, soft edges."""
    fine = 4
    canvas = np.zeros((camera.size[1] * fine, camera.size[0] * fine), np.uint8)
    to_pixel = Homography(H).inverse()
    reach = 3.0 * camera.gsd_m * max(camera.size)
    center = Homography(H)(np.array(camera.size) / 2)
    for line, tags in ways:
        kind = str(tags["highway"])
        hidden = rng.random() < (1 - camera.service if kind == "service" else camera.missing)
        if hidden or tags["tunnel"] in {"yes", "building_passage"}:
            continue
        ground = LineString(np.stack(to_crs.transform(*line.T), axis=1))
        if ground.distance(shapely.Point(center)) > reach:
            continue
        width = WIDTH_M[kind] * rng.uniform(0.85, 1.2)
        for piece in break_up(ground, camera, kind, rng):
            area = piece.buffer(width / 2, quad_segs=3)
            rings = [to_pixel(np.asarray(ring.coords)) * fine for ring in (area.exterior, *area.interiors)]
            if all(np.isfinite(ring).all() for ring in rings):
                cv2.fillPoly(canvas, [np.rint(ring).astype(np.int32) for ring in rings], 255)
    return cv2.resize(canvas, camera.size, interpolation=cv2.INTER_AREA)


def break_up(line: LineString, camera: Camera, kind: str, rng: np.random.Generator) -> list[LineString]:
    """Cut gaps into a street, as trees and shadows do; wide roads stay whole."""
    if camera.noise == 0 or WIDTH_M[kind] > 8 or rng.random() > 0.35 * camera.noise:
        return [line]
    start = rng.uniform(0.1, 0.8) * line.length
    gap = rng.uniform(15, 60)
    pieces = [substring(line, 0, start), substring(line, start + gap, line.length)]
    return [piece for piece in pieces if piece.length > 5]


def blur(roads: AnyArray, camera: Camera, rng: np.random.Generator) -> AnyArray:
    """Turn a mask into the probabilities of a segmenter: soft, rough, with false roads; 0..255."""
    height, width = roads.shape
    sure: Float32Array = roads.astype(np.float32)
    for _ in range(round(25 * camera.noise)):  # driveways and roofs taken for roads
        start, angle = rng.uniform(0, (width, height)), rng.uniform(0, 2 * np.pi)
        end = start + rng.uniform(20, 90) * np.array([np.cos(angle), np.sin(angle)])
        ends = np.rint([start, end]).astype(int).tolist()
        cv2.line(sure, ends[0], ends[1], 230.0, int(rng.integers(3, 7)))
    coarse = rng.normal(0, 1, (height // 6 + 1, width // 6 + 1)).astype(np.float32)
    rough = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(sure, (0, 0), 1.6) * (1 + 0.22 * camera.noise * rough)
    soft = soft + 5 * rng.normal(0, 1, roads.shape)
    # A few levels are enough for a probability, and make a small file.
    return (np.clip(soft / 16, 0, 15).round() * 17).astype(np.uint8)


if __name__ == "__main__":
    make_demo(sys.argv[1], sys.argv[2], Path(roadgeo.evaluation.demo.__file__).parent / "data")
