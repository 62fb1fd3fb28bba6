"""Roads as lines or surfaces in place of a mask are read as for a reference."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from worlds.fenway import streets, write_streets, write_vector

from roadgeo.errors import MaskError
from roadgeo.sources.drawn_roads import draw_roads


@pytest.fixture(scope="module")
def mask(tmp_path_factory):
    """Of the streets as a GeoPackage."""
    return draw_roads(write_streets(tmp_path_factory.mktemp("lines") / "streets.gpkg")).mask.roads


def test_a_layer_is_chosen(tmp_path, mask):
    file = tmp_path / "map.gpkg"
    write_vector(file, [shapely.LineString([(0, 0), (1, 1)])], layer="rivers")
    write_vector(file, streets()[0], layer="streets", append=True)
    with pytest.raises(MaskError, match="several layers hold lines, rivers, streets: choose with --layer"):
        draw_roads(file)
    assert (draw_roads(file, layer="streets").mask.roads == mask).all()


def test_streams_are_not_drawn(tmp_path, mask):
    lines, highway, _ = streets()
    names = [str(k) for k in range(len(lines) + 1)]
    stream = lines[0].buffer(0.001).boundary
    file = write_vector(tmp_path / "a.gpkg", [*lines, stream], highway=[*highway, None], name=names)
    assert (draw_roads(file).mask.roads == mask).all()


def test_surfaces_are_filled_with_their_holes(tmp_path):
    """As a network's outlines of roads are saved: a ring road, as one polygon with a hole, and a street."""
    ring = shapely.Point(300, -300).buffer(200).difference(shapely.Point(300, -300).buffer(190))
    street = shapely.box(0, -304, 600, -296)
    file = write_vector(tmp_path / "roads.gpkg", [shapely.union(ring, street)], crs="EPSG:32629")
    drawing = draw_roads(file)
    area = float(drawing.mask.roads.sum()) * drawing.unit_m**2
    assert area == pytest.approx(shapely.union(ring, street).area, rel=0.15)  # and the pixels that outlines touch
    column, row = np.round((drawing.to_pixel @ (300, -250, 1))[:2]).astype(int)
    assert not drawing.mask.roads[row, column]


#: CRS whose units are no metres on the ground at 42 N, or are others; and two that serve.
ANY_CRS = [
    *("EPSG:3857", "EPSG:3395", "EPSG:4087", "EPSG:2249", "EPSG:4326", "EPSG:4269", "EPSG:6933"),
    *("+proj=utm +zone=19 +units=km", "+proj=lcc +lat_0=10 +lat_1=10 +lat_2=12 +lon_0=-70", "EPSG:32619", "EPSG:26986"),
]


@pytest.mark.filterwarnings("ignore:You will likely lose")
@pytest.mark.parametrize("container", ["gpkg", "shp", "fgb", "parquet", "geojson", "csv"])
@pytest.mark.parametrize("crs", ANY_CRS)
def test_lines_in_any_crs_are_true_to_scale(tmp_path, crs, container):
    if container in ("geojson", "fgb", "csv") and not crs.startswith("EPSG"):
        pytest.skip("has no name for it")
    table = gpd.GeoDataFrame(geometry=streets()[0], crs="EPSG:4326").to_crs(crs)
    path = tmp_path / f"a.{container}"
    if container == "csv":
        texts = [f"SRID={crs[5:]};{text}" for text in shapely.to_wkt(table.geometry.to_numpy(), rounding_precision=-1)]
        pd.DataFrame({"geometry": texts}).to_csv(path)
    else:
        table.to_parquet(path) if container == "parquet" else table.to_file(path, engine="pyogrio")
    drawing = draw_roads(path)
    right = gpd.GeoSeries(streets()[0], crs="EPSG:4326").to_crs("EPSG:32619").total_bounds
    size = np.array(drawing.mask.shape[::-1]) - 48
    assert size * drawing.unit_m == pytest.approx(right[2:] - right[:2], rel=0.03)
    middle = gpd.GeoSeries(streets()[0]).total_bounds.reshape(2, 2).mean(axis=0)
    assert drawing.middle == pytest.approx(middle, abs=0.01)
    assert (drawing.to_pixel is None) == (crs not in ("EPSG:32619", "EPSG:26986"))


def test_exchanged_coordinates_are_mentioned(tmp_path, caplog):
    lines = gpd.GeoSeries(streets()[0], crs="EPSG:4326").to_crs("EPSG:2249")
    turned = shapely.transform(lines.to_numpy(), lambda xy: xy[:, ::-1])
    draw_roads(write_vector(tmp_path / "a.gpkg", turned, crs="EPSG:2249"))
    assert "exchanged, x for y" in caplog.text
