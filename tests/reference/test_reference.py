"""Options are kept with a reference, and used when it is built again."""

import math
from dataclasses import asdict, replace

import geopandas
import pytest
from worlds.fenway import streets

import roadgeo
from roadgeo.errors import IndexFormatError
from roadgeo.matching.index import IndexOptions
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import BuildOptions, stored_options
from roadgeo.roads.intersections import IntersectionOptions
from roadgeo.roads.simplification import SimplifyOptions

OPTIONS = BuildOptions(
    SimplifyOptions(merge_radius=10.0, max_passes=2),
    IntersectionOptions(tangent_length=30.0),
    IndexOptions(n_neighbours=5, min_bucket_m=100.0),
)


@pytest.fixture(scope="module")
def built():
    roads = geopandas.GeoDataFrame(geometry=streets()[0], crs="EPSG:4326")
    return roadgeo.index(roads, "fenway", OPTIONS)


def test_an_index_is_built_again_as_it_was(built, tmp_path):
    path = tmp_path / "fenway.gpkg"
    built.save(path)
    assert stored_options(read_network(path)) == OPTIONS
    written = path.with_suffix(".index").read_bytes()
    path.with_suffix(".index").unlink()
    again = open_reference(path).index
    assert again.meta["index_options"] == asdict(OPTIONS.index)
    assert again.neighbours.shape == (len(again), 5)
    assert path.with_suffix(".index").read_bytes() == written


def test_a_network_that_tells_no_options_has_the_defaults(built):
    silent = replace(built.network, meta={"name": "fenway"})
    assert stored_options(silent) == BuildOptions()
    some = replace(built.network, meta={"options": {"index": {"n_neighbours": 6, "of_a_later_version": []}}})
    assert stored_options(some) == BuildOptions(index=IndexOptions(n_neighbours=6))


@pytest.mark.parametrize(
    "options",
    [
        [],
        {"index": 3},
        {"index": {"n_neighbours": 10**9}},
        {"index": {"n_neighbours": 8.0}},
        {"index": {"codes_per_vertex": 0}},
        {"index": {"codes_per_vertex": True}},
        {"index": {"min_bucket_m": 0.0}},
        {"simplify": {"merge_radius": math.nan}},
        {"simplify": {"merge_radius": None}},
        {"intersections": {"tangent_length": "45"}},
    ],
)
def test_options_that_cannot_be_are_refused(built, options):
    network = replace(built.network, meta={"options": options})
    with pytest.raises(IndexFormatError, match=r"the stored option .* make the reference again"):
        stored_options(network)
