import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from worlds.answers import moved, placed, sure_to, with_place

from roadgeo.errors import CrsError, MaskError, OutputError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask, pixel_to_plane
from roadgeo.geometry.placement import Matches
from roadgeo.location import Content, Location
from roadgeo.outputs.footprint import GROUND, OUTSIDE, ROAD
from roadgeo.outputs.location_files import OutputOptions, write_location
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.placing import placement_of
from roadgeo.outputs.registry import OVERLAY, STYLE
from roadgeo.roads.graph import RoadGraph
from roadgeo.storage.geopackage import layer_names, read_layer

CRS = "EPSG:32629"
SHAPE = (300, 400)
#: Rotated by 30 degrees, 0.8 m per pixel, tilted so that the far side is a quarter coarser.
TURN = np.array([[0.693, 0.4, 531000.0], [0.4, -0.693, 4556000.0], [0.0, 0.0, 1.0]])
TILT = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0002, -0.0003, 1.0]])


def located(H: np.ndarray = TURN @ TILT) -> Location:
    pixels = np.array([[50.5, 60.5], [200.0, 150.0], [350.0, 20.0]])
    mapped = Homography(H)(pixels)
    graph = RoadGraph.from_polylines(
        pixel_to_plane(pixels), np.array([[0, 1], [1, 2]]), [pixel_to_plane(pixels[:2]), pixel_to_plane(pixels[1:])]
    )
    shift = np.array([[0.3, 0.4], [0.0, 0.0], [-0.6, 0.8]])
    matches = Matches(pixel_to_plane(pixels), mapped + shift, np.hypot(*shift.T))
    place = placed(
        H, CRS, score=40.0, reference="porto", corner_covariance_m2=sure_to(0.5, 0.6, 0.7, 0.8), matches=matches
    )
    return Location(
        query="photo_mask.png",
        status="located",
        reason="found",
        reference="porto",
        attribution="© somebody",
        places=(place,),
        content=Content((400, 300), graph, np.zeros((5, 2))),
    )


def road_mask() -> RoadMask:
    roads = np.zeros(SHAPE, bool)
    roads[140:150] = True
    roads[:, 200:212] = True
    roads[::37, ::41] = True
    return RoadMask(roads, name="photo_mask.png")


@pytest.mark.parametrize(("resolution_m", "unobserved"), [(None, False), (None, True), (0.5, True), (2.0, False)])
def test_the_warped_mask_agrees_with_the_homography(
    tmp_path: Path, resolution_m: float | None, unobserved: bool
) -> None:
    location, mask = located(), road_mask()
    if unobserved:
        observed = np.ones(SHAPE, bool)
        observed[:80, :80] = False
        mask = RoadMask(mask.roads & observed, observed)
    paths = output_paths(tmp_path, "photo_mask")
    write_location(location, mask, paths, OutputOptions(ImageOptions(resolution=resolution_m)))
    with rasterio.open(paths.footprint) as raster:
        labels, transform = raster.read(1), raster.transform
        rows, columns = np.indices(labels.shape)
        x, y = transform.c + transform.a * (columns + 0.5), transform.f + transform.e * (rows + 0.5)
    pixels = Homography(np.linalg.inv(location.homography))(np.stack([x, y], axis=-1))
    expected = np.full((*SHAPE, 1), OUTSIDE)
    expected[..., 0] = np.where(mask.roads, ROAD, GROUND)
    if mask.observed is not None:
        expected[~mask.observed] = OUTSIDE
    # Of all source pixels within 0.6 output pixels of where the homography says, one has the value drawn there.
    reach = 0.6 * (resolution_m or 0.8) / 0.8
    agrees = np.zeros(labels.shape, bool)
    for dx, dy in [(0, 0), *((reach * np.cos(a), reach * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 16))]:
        column, row = np.floor(pixels + np.array([dx, dy])).astype(int).transpose(2, 0, 1)
        inside = (column >= 0) & (column < SHAPE[1]) & (row >= 0) & (row < SHAPE[0])
        there = np.where(inside, expected[row * inside, column * inside, 0], OUTSIDE)
        agrees |= there == labels
    assert agrees.all()
    assert set(np.unique(labels)) == {OUTSIDE, GROUND, ROAD}


def test_the_warped_mask_is_a_cloud_optimized_geotiff_with_colours(tmp_path: Path) -> None:
    paths = output_paths(tmp_path, "a")
    write_location(located(), road_mask(), paths)
    with rasterio.open(paths.footprint) as raster:
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert raster.crs.to_epsg() == 32629
        assert raster.nodata == OUTSIDE
        assert raster.colormap(1)[ROAD] == (228, 87, 46, 255)
        assert raster.dataset_mask().min() == 0
        assert json.loads(raster.tags()["ROADGEO_HOMOGRAPHY"]) == located().homography.tolist()
    assert 'type="paletted"' in paths.of(STYLE).read_text()


def test_a_far_view_is_coarsened(tmp_path: Path) -> None:
    paths = output_paths(tmp_path, "a")
    write_location(located(), road_mask(), paths, OutputOptions(ImageOptions(max_pixels=10_000)))
    with rasterio.open(paths.footprint) as raster:
        assert raster.width * raster.height < 11_000


def test_the_geopackage_holds_footprint_roads_and_residuals(tmp_path: Path) -> None:
    location, paths = located(), output_paths(tmp_path, "a")
    write_location(location, road_mask(), paths)
    assert layer_names(paths.geopackage) == [
        *("footprint", "query_roads", "residuals", "matches", "corners", "alternatives", "layer_styles"),
    ]
    rings, attributes = read_layer(paths.geopackage, "footprint")
    np.testing.assert_allclose(rings[0][:4], location.footprint)
    assert attributes["query"] == ["photo_mask.png"]
    assert attributes["attribution"] == ["© somebody"]
    assert attributes["max_corner_sigma_m"] == pytest.approx([0.8])
    points, matches = read_layer(paths.geopackage, "matches")
    np.testing.assert_allclose(points, location.place.matches.reference_xy)
    np.testing.assert_allclose(matches["residual_m"], [0.5, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(matches["dx_m"], [0.3, 0.0, -0.6], atol=1e-6)
    assert (matches["column"][0], matches["row"][0]) == (50.5, 60.5)
    lines, _ = read_layer(paths.geopackage, "query_roads")
    np.testing.assert_allclose(lines[0][0], points[0] - (0.3, 0.4))
    arrows, _ = read_layer(paths.geopackage, "residuals")
    np.testing.assert_allclose(arrows[0][1] - arrows[0][0], 20 * np.array([0.3, 0.4]), atol=1e-6)


def test_the_geopackage_holds_other_places_and_how_sure_the_corners_are(tmp_path: Path) -> None:
    paths = output_paths(tmp_path, "a")
    covariance = np.kron(np.diag([1.0, 2.0, 3.0, 4.0]), [[1.0, 0.5], [0.5, 2.0]])
    location = with_place(located(), corner_covariance_m2=covariance)
    others = (moved(location.place, -1000.0, 20.0, score=3.5), moved(location.place, 0.0, 500.0, score=1.5))
    location = replace(location, places=(*location.places, *others))
    write_location(location, road_mask(), paths)
    points, corners = read_layer(paths.geopackage, "corners")
    np.testing.assert_allclose(points, location.footprint)
    assert corners["var_y_m2"] == [2.0, 4.0, 6.0, 8.0]
    assert corners["cov_xy_m2"] == [0.5, 1.0, 1.5, 2.0]
    points, places = read_layer(paths.geopackage, "alternatives")
    np.testing.assert_allclose(points, [other.center[2:] for other in others], atol=1e-9)
    assert (places["rank"], places["log10_odds"]) == ([2, 3], [3.5, 1.5])
    document = json.loads(paths.json.read_text())
    assert document["corner_covariance_m2"] == covariance.tolist()
    assert [first["log10_odds"] for first in document["alternatives"]] == [3.5, 1.5]


def test_the_json_is_the_location(tmp_path: Path) -> None:
    paths = output_paths(tmp_path, "a")
    written, files, *_ = write_location(located(), road_mask(), paths)
    assert all(path.exists() for path in files)
    assert json.loads(paths.json.read_text()) == json.loads(json.dumps(written.to_dict()))
    assert json.loads(paths.json.read_text())["attribution"] == "© somebody"
    assert written.seconds.write > 0


@pytest.mark.parametrize("status", ["ambiguous", "not_located"])
def test_nothing_georeferenced_stays_for_a_mask_that_was_not_located(tmp_path: Path, status: str) -> None:
    paths = output_paths(tmp_path, "a")
    write_location(located(), road_mask(), paths)
    paths.of(OVERLAY).write_bytes(b"an earlier picture")
    write_location(replace(located(), status=status), road_mask(), paths)
    assert [path.name for path in tmp_path.iterdir()] == ["a_location.json"]
    assert json.loads(paths.json.read_text())["status"] == status


def test_whoever_sees_the_json_finds_the_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names, rename = [], Path.replace
    monkeypatch.setattr(Path, "replace", lambda staged, target: (names.append(target.name), rename(staged, target)))
    _, paths, *_ = write_location(located(), road_mask(), output_paths(tmp_path, "a"))
    assert (len(names), names[-1]) == (len(paths), "a_location.json")


def test_all_files_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OutputError("disk full")

    monkeypatch.setattr("roadgeo.outputs.location_layers.dump_layers", fail)
    with pytest.raises(OutputError, match="disk full"):
        write_location(located(), road_mask(), output_paths(tmp_path, "a"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("image", "photo", "message"),
    [
        (ImageOptions("+proj=ortho +lat_0=-41 +lon_0=171"), None, "lies outside"),
        (ImageOptions(), (80, 90), "its mask 400 x 300"),
    ],
)
def test_where_nothing_can_be_drawn_the_place_is_written(
    tmp_path: Path, image: ImageOptions, photo: tuple[int, int] | None, message: str
) -> None:
    paths, picture = output_paths(tmp_path / "out", "a"), tmp_path / "photo.png"
    paths.folder.mkdir()
    cv2.imwrite(str(picture), np.zeros((photo or (300, 400)), np.uint8))
    write_location(located(), road_mask(), paths)  # an earlier run
    with pytest.raises((CrsError, MaskError), match=f"{message}.*what was found is in .*a_location.json"):
        write_location(located(), road_mask(), paths, OutputOptions(image), picture)
    assert [path.name for path in paths.folder.iterdir()] == ["a_location.json"]
    assert json.loads(paths.json.read_text())["footprint_lonlat"]


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        write_location(located(), road_mask(), output_paths(tmp_path / "missing", "a"))
    with pytest.raises(OutputError, match="no place"):
        placement_of(Location("a.png", "not_located", "nothing fits"))


@pytest.mark.parametrize(
    ("asked", "kept"), [("deflate", "deflate"), ("zstd", "zstd"), ("jpeg", "deflate"), ("webp", "deflate")]
)
def test_a_mask_is_compressed_as_asked_for_without_loss(tmp_path: Path, asked: str, kept: str) -> None:
    options = OutputOptions(ImageOptions(compression=asked))
    write_location(located(), road_mask(), output_paths(tmp_path, "a"), options)
    path = tmp_path / "a_footprint.tif"
    with rasterio.open(path) as raster:
        assert str(raster.compression.value).lower() == kept
        values = raster.read(1)
    if kept == "deflate":  # programs without ZSTD open it
        assert cv2.imread(str(path)).shape[:2] == values.shape
        with Image.open(path) as picture:
            np.testing.assert_array_equal(np.asarray(picture), values)
