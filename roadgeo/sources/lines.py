"""Roads as their sources give them: tables of any schema, and the lines that an adapter makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray, IntArray

__all__ = [
    *("OSM_ATTRIBUTION", "RoadLines", "RoadTable", "add_counts", "cut_lines", "join_lines", "line_through", "objects"),
    *("simple_areas", "simple_lines"),
]

OSM_ATTRIBUTION = "© OpenStreetMap contributors, ODbL 1.0"

#: Attributes of `RoadLines` with a value for each line.
_COLUMNS = ("lines", "highway", "name", "tunnel")


@dataclass(frozen=True)
class RoadTable:
    """The content of a container, or a part of it, unchanged. Dimension: N features.

    Attributes
    ----------
    shapes : (N,) object
        Shapely geometries of any type, or None.
    crs : anything that pyproj knows, or None
        As the container gives it; None where it gives none.
    columns : dict
        (N,) object each, by name.
    meta : dict
        Provenance: plain values.
    """

    shapes: AnyArray
    crs: Any
    columns: dict[str, AnyArray] = field(default_factory=dict)
    meta: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RoadLines:
    """Lines of one source. Dimension: L lines.

    Attributes
    ----------
    lines : (L,) object
        Shapely LineStrings, 2-D, finite, not empty, in the source's CRS.
    crs : str or None
        "EPSG:n" or WKT; None where the source has none.
    highway, name : (L,) object
        Text, "" where it is not known: the kind of each road in OpenStreetMap's words, and its street, for display.
    tunnel : (L,) bool
        Runs in a tunnel.
    kinds_known : bool
        Whether the source has kinds of roads at all.
    meta : dict
        Provenance: plain values.
    areas : (A,) object
        Polygons that may be roads drawn as surfaces.
    """

    lines: AnyArray
    crs: str | None
    highway: AnyArray
    name: AnyArray
    tunnel: BoolArray
    kinds_known: bool
    meta: dict[str, Any] = field(default_factory=dict)
    areas: AnyArray = field(default_factory=lambda: np.empty(0, object))

    def take(self, rows: IntArray | BoolArray) -> RoadLines:
        """Return some of the lines."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})


def join_lines(parts: Sequence[RoadLines]) -> RoadLines:
    """Put parts of one source together: counts in `meta` are added up, and where parts differ in CRS they must not."""
    meta: dict[str, Any] = {}
    for part in parts:
        add_counts(meta, part.meta)
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in (*_COLUMNS, "areas")
    }
    return replace(parts[0], **columns, meta=meta, kinds_known=any(part.kinds_known for part in parts))


def add_counts(meta: dict[str, Any], part: dict[str, Any]) -> None:
    """Add the counts of a part of a source to its totals, and take over whatever else is known of it."""
    meta |= {key: meta.get(key, 0) + value if type(value) is int else value for key, value in part.items()}


def line_through(points: FloatArray) -> Any:
    """Return the line through (n, 2) or (n, 3) points, in pieces where points between them are not finite.

    None where no two different points follow each other.
    """
    import shapely

    finite = np.isfinite(points).all(axis=1)
    pieces = [points]
    if not finite.all():
        cuts = np.flatnonzero(np.diff(finite)) + 1
        pieces = [piece for piece in np.split(points, cuts) if np.isfinite(piece).all()]
    lines = [shapely.linestrings(piece) for piece in pieces if (piece[1:] != piece[:1]).any()]
    return shapely.MultiLineString(lines) if len(lines) > 1 else next(iter(lines), None)


def simple_lines(shapes: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return the 2-D LineStrings in any shapes, and the shape that each came from.

    Missing and empty ones are left out, and so are other shapes, and lines with a vertex that is not finite.
    """
    import shapely

    parts, place = _parts(shapes)
    kept = np.isin(shapely.get_type_id(parts), (1, 2)) & ~shapely.is_empty(parts)
    lines, place = shapely.force_2d(parts[kept]), place[kept]
    coords, line = shapely.get_coordinates(lines, return_index=True)
    sound = np.ones(len(lines), bool)
    sound[line[~np.isfinite(coords).all(axis=1)]] = False
    return lines[sound], place[sound]


def simple_areas(shapes: AnyArray) -> AnyArray:
    """Return the Polygons in any shapes."""
    import shapely

    parts, _ = _parts(shapes)
    return np.asarray(parts[(shapely.get_type_id(parts) == 3) & ~shapely.is_empty(parts)])


def _parts(shapes: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Take shapes to pieces; collections may hold collections."""
    import shapely

    parts, place = shapely.get_parts(np.asarray(shapes, object), return_index=True)
    while np.isin(shapely.get_type_id(parts), (4, 5, 6, 7)).any():
        parts, inner = shapely.get_parts(parts, return_index=True)
        place = place[inner]
    return parts, place


def cut_lines(lines: AnyArray, area: Any) -> tuple[AnyArray, AnyArray]:
    """Return the pieces of lines within an area, both in degrees, and the line that each came from.

    A line or the area may lie astride 180 degrees.
    """
    import shapely

    coords, line = shapely.get_coordinates(lines, return_index=True)
    jumps = (np.abs(np.diff(coords[:, 0])) > 180.0) & (np.diff(line) == 0)
    astride = np.isin(line, line[1:][jumps])
    coords[astride, 0] %= 360.0
    lines = shapely.set_coordinates(lines.copy(), coords)
    parts = shapely.get_parts(area)
    if (
        np.ptp(shapely.total_bounds(parts)[::2]) > 180.0
        and (np.ptp(shapely.bounds(parts)[:, ::2], axis=1) < 180.0).all()
    ):
        area = shapely.union_all(shapely.transform(parts, lambda xy: xy + 360.0 * (xy < 0.0) * (1.0, 0.0)))
    pieces, places = [], []
    for turn in (-360.0, 0.0, 360.0):
        ground = shapely.transform(area, lambda xy, turn=turn: np.add(xy, (turn, 0.0)))
        shapely.prepare(ground)
        near = np.flatnonzero(shapely.intersects(ground, lines))
        inside = shapely.covers(ground, lines[near])
        pieces.append(np.where(inside, lines[near], shapely.intersection(lines[near], np.where(inside, None, ground))))
        places.append(near)
    simple, place = simple_lines(np.concatenate(pieces))
    return simple, np.concatenate(places)[place]


def objects(values: Any) -> AnyArray:
    """Return an (N,) array of any values as they are, such as shapes or texts."""
    listed = list(values)
    array = np.empty(len(listed), object)
    array[:] = listed
    return array
