"""Roads to a reference: one builder for the command line and for Python, from whatever holds the roads."""

import geopandas
import numpy as np
import pandas as pd
import pytest
from worlds.fenway import streets

from roadgeo.cli import main
from roadgeo.errors import CrsError
from roadgeo.reference.reference import open_reference
from roadgeo.workflows import build_reference


@pytest.fixture(scope="module")
def roads():
    lines, highway, tunnel = streets()
    columns = {"highway": list(highway), "tunnel": list(tunnel)}
    return geopandas.GeoDataFrame(columns, geometry=list(lines), crs="EPSG:4326")


def test_a_table_is_filtered_as_the_command_filters_a_file(roads, tmp_path, monkeypatch):
    """Footways and tunnels of a GeoDataFrame used to be taken for roads."""
    monkeypatch.chdir(tmp_path)
    roads.to_file("fenway.gpkg")
    more = geopandas.GeoDataFrame({"highway": ["footway"] * len(roads)}, geometry=roads.geometry.translate(2e-4, 1e-4))
    mixed = pd.concat([roads, more], ignore_index=True)
    mixed.to_file("mixed.gpkg")
    assert main(["index", "--roads", "mixed.gpkg", "--out", "cli.gpkg", "-q"]) == 0
    by_command = open_reference("cli.gpkg").index
    for given in (mixed, "mixed.gpkg"):
        by_call = build_reference(given, "cli", path="api.gpkg").index
        np.testing.assert_array_equal(by_call.xy, by_command.xy)
        np.testing.assert_array_equal(by_call.table_entries, by_command.table_entries)
    assert len(build_reference(mixed, kinds="all").index) > len(by_command)


def test_whom_to_name_is_kept(roads, tmp_path):
    built = build_reference(roads, "fenway", path=tmp_path / "fenway.gpkg", attribution="© somebody")
    assert built.index.meta["attribution"] == "© somebody"
    assert open_reference(tmp_path / "fenway.gpkg").name == "fenway"


def test_a_table_without_a_crs_is_refused(roads):
    with pytest.raises(CrsError, match="no CRS; set one"):
        build_reference(roads.set_crs(None, allow_override=True))
