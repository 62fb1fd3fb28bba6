"""Lines out of road files part by part, so that a file of any size is read within a bounded memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from roadgeo.errors import RoadSourceError
from roadgeo.sources.lines import (
    COLUMNS,
    GRAPH_ENDINGS,
    OSM_ENDINGS,
    PARQUET_ENDINGS,
    RoadLines,
    choose_layer,
    crs_name,
    from_columns,
    from_frame,
    geometry_columns,
    read_lines,
    reading,
    require_rows,
    stream_osm,
)
from roadgeo.sources.vectors import count_features, first_line, read_layer

__all__ = ["stream_lines"]

#: Places of nodes are kept in memory up to this size of a PBF file (about 16 bytes a node, 8 times its size), else on
#: disk in the folder of temporary files.
_NODES_IN_MEMORY = 100_000_000


def stream_lines(
    path: Path, layer: str | None = None, most: int = 100_000, advance: Callable[[float], None] = lambda _: None
) -> Iterator[RoadLines]:
    """Yield the lines of a road file as `lines.read_lines` gives them, of at most so many features at a time.

    Parameters
    ----------
    advance : callable, optional
        Told which share of the file is read.

    Raises
    ------
    RoadSourceError
        The file is missing, unreadable, empty or holds no lines.
    """
    n = 0
    with reading(path):
        for part in _stream(path, layer, most, advance):
            n += len(part.lines)
            yield part
    if n == 0:
        raise RoadSourceError(f"{path}: no lines in it, expected the centre lines of roads")


def _stream(path: Path, layer: str | None, most: int, advance: Callable[[float], None]) -> Iterator[RoadLines]:
    name = path.name.lower()
    if name.endswith(OSM_ENDINGS):
        yield from _stream_osm(path, most, advance)
    elif name.endswith(GRAPH_ENDINGS) or (name.endswith(PARQUET_ENDINGS) and not _is_wkb(path)):
        yield read_lines(path, layer)
    elif name.endswith(PARQUET_ENDINGS):
        yield from _stream_parquet(path, most, advance)
    else:
        yield from _stream_gdal(path, layer, most, advance)


def _stream_osm(path: Path, most: int, advance: Callable[[float], None]) -> Iterator[RoadLines]:
    if path.stat().st_size <= _NODES_IN_MEMORY:
        yield from stream_osm(path, most, advance)
        return
    with tempfile.TemporaryDirectory(prefix="roadgeo-nodes-") as folder:
        yield from stream_osm(path, most, advance, f"sparse_file_array,{folder}/nodes")


def _stream_parquet(path: Path, most: int, advance: Callable[[float], None]) -> Iterator[RoadLines]:
    """Stream GeoParquet by batches of its row groups."""
    import geopandas as gpd
    import pyarrow as pa
    import pyarrow.parquet as pq
    import shapely

    try:
        require_rows(path)
        geometry, crs = geometry_columns(path)[0], crs_name(_parquet_crs(path))
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            wanted = [name for name in (*COLUMNS, "subtype") if name in names]
            done = 0
            for batch in file.iter_batches(most, columns=[geometry, *wanted]):
                table = batch.to_pandas()
                shapes = shapely.from_wkb(table.pop(geometry).to_numpy(object))
                yield from_frame(gpd.GeoDataFrame(table, geometry=shapes, crs=crs), wanted)
                done += len(batch)
                advance(done / file.metadata.num_rows)
    except (pa.ArrowException, ValueError, OSError) as error:
        raise RoadSourceError(f"{path}: not readable as GeoParquet: {first_line(error)}") from error


def _geometry_meta(path: Path) -> dict[str, Any]:
    """Return what a GeoParquet file says of its primary geometry column."""
    import json

    import pyarrow.parquet as pq

    column = geometry_columns(path)[0]
    told: dict[str, Any] = json.loads((pq.read_schema(path).metadata or {})[b"geo"])["columns"][column]
    return told


def _is_wkb(path: Path) -> bool:
    """Whether a file keeps its geometries as WKB; others are read whole."""
    import pyarrow as pa

    try:
        return str(_geometry_meta(path).get("encoding")).upper() == "WKB"
    except (ValueError, LookupError, TypeError, OSError, pa.ArrowException):
        return False  # read whole, which says what is wrong


def _parquet_crs(path: Path) -> Any:
    """Return the CRS of a GeoParquet file: degrees where it does not say, None where it says that it is unknown."""
    return _geometry_meta(path).get("crs", "EPSG:4326")


def _stream_gdal(path: Path, layer: str | None, most: int, advance: Callable[[float], None]) -> Iterator[RoadLines]:
    """Stream what GDAL reads."""
    import shapely

    layer = choose_layer(path, layer)
    total = max(count_features(path, layer), 1)
    for skip in range(0, total, most):
        found = read_layer(path, layer, COLUMNS, skip, most)
        if found.shapes is None:
            raise RoadSourceError(f"{path}: layer {layer!r} has no geometry, expected lines")
        shapes = shapely.from_wkb(found.shapes, on_invalid="ignore")
        yield from_columns(shapes, crs_name(found.crs), found.columns, {"format": found.driver, "layer": layer})
        advance(min(skip + most, total) / total)
