"""Road files are read part by part as they are read whole."""

import numpy as np
import pytest
import shapely
from worlds.fenway import streets, write_streets

from roadgeo.errors import RoadSourceError
from roadgeo.sources import osm_files
from roadgeo.sources.streams import read_lines, stream_lines

FORMATS = ["streets.gpkg", "streets.shp", "streets.geojson", "streets.parquet", "streets.osm.gz", "streets.osm.pbf"]


@pytest.mark.parametrize("name", FORMATS)
def test_parts_together_are_the_whole(tmp_path, name):
    path = write_streets(tmp_path / name)
    whole, shares = read_lines(path), []
    most = len(streets()[0]) // 2 - 1
    parts = list(stream_lines(path, most=most, advance=shares.append))
    assert len(parts) == 3
    assert max(part.meta["features"] for part in parts) <= most
    assert sum(part.meta["features"] for part in parts) == whole.meta["features"] == len(streets()[0])
    assert {part.crs for part in parts} == {whole.crs}
    assert shapely.equals_exact(np.concatenate([part.lines for part in parts]), whole.lines, 0.0).all()
    assert np.concatenate([part.highway for part in parts]).tolist() == whole.highway.tolist()
    assert np.concatenate([part.tunnel for part in parts]).tolist() == whole.tunnel.tolist()
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_nodes_of_a_large_file_are_kept_on_disk(tmp_path, monkeypatch):
    path = write_streets(tmp_path / "streets.osm.pbf")
    monkeypatch.setattr(osm_files, "_NODES_IN_MEMORY", 0)
    lines = np.concatenate([part.lines for part in stream_lines(path, most=4)])
    assert shapely.equals_exact(lines, read_lines(path).lines, 0.0).all()


@pytest.mark.parametrize("name", ["a.parquet", "a.osm.pbf", "a.gpkg"])
def test_what_cannot_be_read_says_so(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"PAR1 nothing of the kind")
    with pytest.raises(RoadSourceError, match=name):
        list(stream_lines(path))
