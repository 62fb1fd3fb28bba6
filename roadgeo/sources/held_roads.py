"""Roads that a Python program holds: tables, graphs, shapes and coordinates, brought to one plane as files are."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import CrsError, RoadSourceError
from roadgeo.roads.kinds import RoadKind
from roadgeo.sources.containers import graph_table
from roadgeo.sources.lines import RoadLines, RoadTable, crs_name
from roadgeo.sources.roads import Roads, choose_lines, join_roads, overruled_crs, read_roads
from roadgeo.sources.schemas import recognise
from roadgeo.sources.streams import tell_source

__all__ = ["choose_roads"]

_EXPECTED = (
    "expected a path, a GeoDataFrame, a GeoSeries, a graph of osmnx or momepy, shapely lines, "
    "or arrays of coordinates of shape (N, 2)"
)


def choose_roads(
    roads: Any,
    which: RoadKind = "drivable",
    tunnels: bool = False,
    attribution: str | None = None,
    say: Say = say_nothing,
    crs: Any = None,
) -> Roads:
    """Return the roads to build a reference from, of files or of whatever a program holds; `Roads` as they are.

    Parameters
    ----------
    roads : Roads, path or paths, GeoDataFrame, GeoSeries, networkx graph with places, shapely lines, arrays
        Arrays of coordinates (N, 2) or (N, 3), x first, are a line each; of a single one, rows that are not finite part
        the lines.
    crs : anything that pyproj knows, optional
        CRS of the coordinates; needed where the roads have none.

    Raises
    ------
    CrsError
        There is no CRS, or the coordinates do not fit it.
    RoadSourceError
        There are no lines of the kind asked for, or what is given holds none.
    """
    if isinstance(roads, Roads):
        return roads if attribution is None else replace(roads, meta={**roads.meta, "attribution": attribution})
    if _are_paths(roads):
        named = None if crs is None else _named(crs)
        return read_roads(roads, crs=named, which=which, tunnels=tunnels, attribution=attribution, say=say)
    source = _lines_of(roads)
    if crs is not None:
        source = replace(source, crs=overruled_crs(source.crs, _named(crs), "the roads"))
    if source.crs is None:
        raise CrsError("the roads have no CRS; name it, for example crs='EPSG:26986'")
    chosen = choose_lines(source, "the roads", which, tunnels, None)
    tell_source("the roads", chosen.meta)
    return join_roads([chosen], {"roads": which, "tunnels": tunnels, "bbox": None}, attribution)


def _are_paths(roads: Any) -> bool:
    kinds = (str, os.PathLike)
    listed = isinstance(roads, list | tuple) and len(roads) > 0
    return isinstance(roads, kinds) or (listed and all(isinstance(one, kinds) for one in roads))


def _named(crs: Any) -> str:
    name = crs_name(crs)
    if name is None:
        raise CrsError(f"{crs!r} is no CRS of places on Earth; expected for example EPSG:26986")
    return name


def _lines_of(roads: Any) -> RoadLines:
    """Return the lines of a table, a graph, a series or of shapes and coordinates."""
    if hasattr(roads, "edges") and hasattr(roads, "graph"):  # networkx
        table = graph_table(roads)
    elif hasattr(roads, "columns") and hasattr(roads, "geometry"):
        columns = {str(name): roads[name].to_numpy(object) for name in roads.columns if name != roads.geometry.name}
        table = RoadTable(roads.geometry.to_numpy(object), crs_name(roads.crs), columns)
    else:
        table = RoadTable(_shapes(roads), crs_name(getattr(roads, "crs", None)))
    return recognise(table).adapt(table)


def _shapes(roads: Any) -> AnyArray:
    """Return shapely geometries; (N,) object."""
    import shapely

    if isinstance(roads, shapely.Geometry):
        return np.array([roads], object)
    try:
        one_array = isinstance(roads, np.ndarray) and roads.ndim == 2
        listed = _parts(np.asarray(roads, np.float64)) if one_array else list(roads)
        shapes = [one if one is None or isinstance(one, shapely.Geometry) else _line(one) for one in listed]
    except (TypeError, ValueError) as error:
        raise RoadSourceError(f"roads of type {type(roads).__name__} cannot be read: {error}; {_EXPECTED}") from error
    found = np.empty(len(shapes), object)
    found[:] = shapes
    return found


def _parts(coordinates: AnyArray) -> list[AnyArray]:
    """Cut an array of coordinates at its rows that are not finite."""
    ends = np.flatnonzero(~np.isfinite(coordinates).all(axis=1))
    parts = np.split(coordinates, ends)
    return [part[np.isfinite(part).all(axis=1)] for part in parts]


def _line(coordinates: Any) -> Any:
    import shapely

    points = np.asarray(coordinates, np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"coordinates of shape {points.shape}")
    return shapely.LineString(points) if len(points) > 1 else shapely.LineString()
