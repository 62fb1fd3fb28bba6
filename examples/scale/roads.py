"""Make one road file of many copies of a map, none a twin of another, to measure how a large map is built.

    python examples/scale/roads.py roads.parquet ten.parquet --count 10
    roadgeo index --roads ten.parquet --shards auto --out ten.shards

The copies are made as by `maps.py`: the first is left as it is, the others are the same roads in a mirror, stretched
and turned, each on a part of the Earth of its own. They are written one after another, a row group each.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely
from maps import APART_DEG, transformation
from pyproj import CRS

from roadgeo.geometry.projection import LocalPlane, to_lonlat
from roadgeo.storage.files import replacing


def copy(lines: np.ndarray, crs: str, k: int) -> np.ndarray:
    """Return lines (N,) of a CRS in metres, as copy k has them, in degrees."""
    low, high = shapely.total_bounds(lines).reshape(2, 2)
    if k == 0:
        return shapely.transform(lines, lambda xy: to_lonlat(crs, xy))
    plane = LocalPlane(f"+proj=aeqd +lat_0=0 +lon_0={APART_DEG * k} +datum=WGS84 +units=m", (0.0, 0.0))
    matrix = transformation(k)
    return shapely.transform(lines, lambda xy: to_lonlat(plane.crs, (xy - 0.5 * (low + high)) @ matrix.T))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("roads", type=Path, help="GeoParquet in metres, with a column `highway`")
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=10)
    given = parser.parse_args()
    table = pq.read_table(given.roads, columns=["highway", "geometry"])
    crs = CRS(json.loads(table.schema.metadata[b"geo"])["columns"]["geometry"]["crs"]).to_wkt()
    lines = shapely.from_wkb(table["geometry"].to_numpy())
    column = {"encoding": "WKB", "geometry_types": ["LineString"], "crs": CRS("OGC:CRS84").to_json_dict()}
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    schema = pa.schema([("highway", pa.string()), ("geometry", pa.binary())], {"geo": json.dumps(geo)})
    with replacing(given.out) as staged, pq.ParquetWriter(staged, schema) as writer:
        for k in range(given.count):
            wkb = shapely.to_wkb(copy(lines, crs, k))
            writer.write_table(pa.table([table["highway"], pa.array(wkb, pa.binary())], schema))
            print(f"copy {k}: {len(wkb):,} roads", flush=True)


if __name__ == "__main__":
    main()
