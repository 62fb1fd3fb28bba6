"""Georeferences of rasters: read from every place where they may stand, and moved."""

import html
import warnings
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np
import PIL.Image
import pyproj
import pytest
import rasterio
import shapely
from rasterio.control import GroundControlPoint
from worlds.rasters import write_raster
from worlds.turned import mark_turned, save_turned

from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane, to_lonlat, transformer
from roadgeo.sources.georeference import read_georeference, read_stated
from roadgeo.sources.roads import choose_roads

PLACE = rasterio.Affine(0.5, 0.1, 330_000.0, 0.1, -0.5, 4_690_000.0)
PLANE = LocalPlane("EPSG:32619", (330_000.0, 4_690_000.0))


def at(place: rasterio.Affine, column: float, row: float) -> tuple[float, float]:
    a, b, c, d, e, f = place[:6]
    return a * column + b * row + c, d * column + e * row + f


def spread(place: rasterio.Affine) -> list[tuple[float, float, float, float]]:
    return [(column, row, *at(place, column, row)) for column, row in [(0, 0), (80, 0), (80, 60), (0, 60)]]


BLACK = np.zeros((60, 80), np.uint8)
WORLD_FILE = "0.5\n0.1\n0.1\n-0.5\n330000.3\n4689999.8\n"


def write(path: Path, **given: object) -> Path:
    return write_raster(path, BLACK, **given)


def test_a_geotransform_is_read_and_taken_to_a_plane(tmp_path: Path) -> None:
    found = read_georeference(write(tmp_path / "a.tif", crs="EPSG:32619", transform=PLACE))
    assert found is not None
    assert (found.crs, found.size, found.source) == ("EPSG:32619", (80, 60), "geotransform")
    assert Homography(found.on_plane(PLANE))(np.array([80.0, 60.0])) == pytest.approx((46.0, -22.0), abs=1e-6)


def test_another_crs_comes_out_to_a_millimetre_and_moves_back(tmp_path: Path) -> None:
    to = transformer("EPSG:32619", "EPSG:3857")
    west, north = to.transform(330_000, 4_690_000)
    place = rasterio.Affine(0.7, 0, west, 0, -0.7, north)
    found = read_georeference(write(tmp_path / "a.tif", crs="EPSG:3857", transform=place))
    assert found is not None
    on_plane = found.on_plane(PLANE)
    x, y = transformer("EPSG:3857", "EPSG:32619").transform(*at(place, 33, 41))
    assert PLANE.to_crs(Homography(on_plane)(np.array([33.0, 41.0]))) == pytest.approx((x, y), abs=1e-3)
    assert found.moved(on_plane, PLANE).matrix == pytest.approx(found.matrix, abs=1e-3)


@pytest.mark.parametrize("count", [3, 4, 5, 9])
def test_control_points_are_fitted(tmp_path: Path, count: int) -> None:
    spots = [(0, 0), (80, 0), (80, 60), (0, 60), (40, 30), (20, 10), (60, 10), (20, 50), (60, 50)][:count]
    points = [GroundControlPoint(row, column, *at(PLACE, column, row)) for column, row in spots]
    found = read_georeference(write(tmp_path / "a.tif", gcps=points, crs="EPSG:32619"))
    assert found is not None
    assert found.source == "control points"
    pixels, there = found.control_points()
    assert there == pytest.approx(np.array([at(PLACE, *pixel) for pixel in pixels]), abs=1e-4)


def test_a_world_file_beside_a_picture_is_read(tmp_path: Path) -> None:
    path = tmp_path / "scan.png"
    cv2.imwrite(str(path), BLACK)
    assert read_georeference(path) is None
    (tmp_path / "scan.pgw").write_text(WORLD_FILE)
    with pytest.raises(CrsError, match="--crs"):
        read_georeference(path)
    found = read_georeference(path, "EPSG:32619")
    assert found is not None
    assert found.matrix == pytest.approx(np.array(PLACE).reshape(3, 3), abs=1e-9)
    (tmp_path / "scan.pgw").write_text("no numbers here")
    with pytest.raises(MaskError, match="six numbers"):
        read_georeference(path, "EPSG:32619")


@pytest.mark.parametrize(
    ("picture", "beside"),
    [
        *(
            ("scan.png", f"scan.{name}")
            for name in ("pgw", "pgwx", "pngw", "pngwx", "wld", "PGW", "PNGW", "PGWX", "WLD")
        ),
        *(("scan.jpg", f"scan.{name}") for name in ("jgw", "jgwx", "jpgw", "JGW", "JPGWX")),
        *(("scan.TIF", f"scan.{name}") for name in ("tfw", "tfwx", "tifw", "TFW", "TFWX", "TIFW")),
        *(("scan.jpeg", f"scan.{name}") for name in ("jgw", "jgwx", "jpegw", "JPEGW")),
        *(("scan.webp", f"scan.{name}") for name in ("wpw", "webpw")),
    ],
)
def test_world_files_have_many_names(tmp_path: Path, picture: str, beside: str) -> None:
    cv2.imwrite(str(tmp_path / picture), BLACK)
    (tmp_path / beside).write_text(WORLD_FILE)
    found = read_georeference(tmp_path / picture, "EPSG:32619")
    assert found is not None
    assert found.matrix == pytest.approx(np.array(PLACE).reshape(3, 3), abs=1e-9)


@pytest.mark.parametrize("version", ["WKT1_ESRI", "WKT2_2019"])
def test_a_prj_beside_a_world_file_names_its_crs(tmp_path: Path, version: str) -> None:
    path = tmp_path / "scan.png"
    cv2.imwrite(str(path), BLACK)
    path.with_suffix(".pgw").write_text(WORLD_FILE)
    path.with_suffix(".prj").write_text(pyproj.CRS(32619).to_wkt(version))
    found = read_georeference(path)
    assert found is not None
    assert found.crs == "EPSG:32619"
    assert read_georeference(path, "WGS 84 / UTM zone 20N").crs == "EPSG:32620"
    path.with_suffix(".prj").write_text("EPSG:nowhere")
    with pytest.raises(CrsError, match=r"scan.prj: 'EPSG:nowhere' is no CRS that PROJ knows"):
        read_georeference(path)


@pytest.mark.parametrize("written", ["utf-8-sig", "utf-16", "utf-16-be", "crlf"])
@pytest.mark.parametrize("of", ["pgw", "prj", "png.aux.xml"])
def test_files_beside_a_picture_are_text_as_programs_write_it(tmp_path: Path, of: str, written: str) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), BLACK)
    texts = {"pgw": WORLD_FILE, "prj": pyproj.CRS(32619).to_wkt("WKT1_ESRI")}
    if of == "png.aux.xml":
        crs, numbers = texts["prj"], ", ".join(map(str, PLACE.to_gdal()))
        texts = {of: f"<PAMDataset>\n<SRS>{crs}</SRS>\n<GeoTransform>{numbers}</GeoTransform>\n</PAMDataset>"}
    for name, text in texts.items():
        encoding = written if name == of and written != "crlf" else "utf-8"
        mark = "\ufeff" if encoding == "utf-16-be" else ""
        (tmp_path / f"a.{name}").write_bytes((mark + text.replace("\n", "\r\n")).encode(encoding))
    found = read_georeference(tmp_path / "a.png")
    assert found is not None
    assert found.crs == "EPSG:32619"
    assert found.matrix == pytest.approx(np.array(PLACE).reshape(3, 3), abs=1e-9)


@pytest.mark.parametrize("orientation", [3, 6, 7])
def test_a_world_file_speaks_of_stored_pixels(tmp_path: Path, orientation: int) -> None:
    path = save_turned(tmp_path / "scan.png", np.zeros((60, 80), np.uint8), orientation)
    with PIL.Image.open(path) as stored_picture:
        width, height = stored_picture.size
    (tmp_path / "scan.pgw").write_text(WORLD_FILE)
    found = read_georeference(path, "EPSG:32619")
    assert found is not None
    assert found.size == (80, 60)
    last = {3: (0, 0), 6: (width, 0), 7: (0, 0)}[orientation]  # of the file, where the upright picture ends below right
    assert Homography(found.matrix)(np.array([80.0, 60.0])) == pytest.approx(at(PLACE, *last), abs=1e-6)
    stored = found.of_stored(orientation)
    assert stored.matrix == pytest.approx(np.array(PLACE).reshape(3, 3), abs=1e-9)
    assert stored.size == (width, height)


def test_a_place_without_an_area_is_refused(tmp_path: Path) -> None:
    flat = rasterio.Affine(0.5, 0.0, 330_000.0, 0.5, 0.0, 4_690_000.0)
    with pytest.raises(MaskError, match="to a line"):
        read_georeference(write(tmp_path / "a.tif", crs="EPSG:32619", transform=flat))


SHIFTED = {
    "utm": "+proj=utm +zone=29 +ellps=intl +towgs84=-87,-98,-121 +units=m",
    "utm, far": "+proj=utm +zone=29 +ellps=intl +towgs84=-231,-196.1,482.2 +units=m",
    "degrees": "+proj=longlat +ellps=bessel +towgs84=582,105,414,1.04,0.35,-3.08,8.3",
    "gauss-krueger": "+proj=tmerc +lon_0=9 +x_0=3500000 +ellps=bessel +towgs84=598.1,73.7,418.2,.202,.045,-2.455,6.7",
    "of a datum with a number": (
        'PROJCS["ED50 / UTM zone 29N",GEOGCS["ED50",DATUM["European_Datum_1950",'
        'SPHEROID["International 1924",6378388,297],TOWGS84[-223.237,110.193,36.649,0,0,0,0],'
        'AUTHORITY["EPSG","6230"]],PRIMEM["Greenwich",0],UNIT["degree",'
        '0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],PARAMETER['
        '"central_meridian",-9],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],PARAMETER['
        '"false_northing",0],UNIT["metre",1]]'
    ),
    "of no name": "+proj=utm +zone=29 +ellps=intl +units=m",
}


@pytest.mark.parametrize(
    "where",
    [
        *("geotransform", "control points", "turned", "jp2", "img", "prj", "aux.xml", "aux.xml and world file"),
        *("aux.xml of control points", "aux.xml of ArcGIS"),
    ],
)
@pytest.mark.parametrize("name", SHIFTED)
def test_the_datum_shift_of_a_crs_is_its_own(tmp_path: Path, name: str, where: str) -> None:
    if (name, where) == ("of no name", "img"):
        pytest.skip("Imagine names its datum")
    crs = pyproj.CRS(SHIFTED[name])
    west, north = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(-8.6, 41.15)
    step = 1e-5 if name == "degrees" else 1.0
    place = rasterio.Affine(step, 0, west, 0, -step, north)
    named = crs.to_wkt("WKT1_GDAL") if "number" in name else crs.to_wkt()
    kept = rasterio.Env(OSR_STRIP_TOWGS84="NO")  # as other programs write
    if where in ("geotransform", "jp2", "img"):
        driver = {"jp2": {"driver": "JP2OpenJPEG"}, "img": {"driver": "HFA"}}.get(where, {})
        with kept:
            path = write(tmp_path / f"a.{where}", crs=named, transform=place, **driver)
    elif where in ("control points", "turned"):
        points = [GroundControlPoint(row, column, x, y) for column, row, x, y in spread(place)]
        with kept:
            path = write(tmp_path / "a.tif", gcps=points, crs=named)
        if where == "turned":
            mark_turned(path, 3)
    else:
        path = tmp_path / "a.png"
        cv2.imwrite(str(path), BLACK)
        if "points" not in where and where != "aux.xml":
            path.with_suffix(".wld").write_text(f"{step}\n0\n0\n{-step}\n{west + step / 2}\n{north - step / 2}\n")
        if where == "prj":
            path.with_suffix(".prj").write_text(crs.to_wkt("WKT1_GDAL"))
        else:
            numbers = ", ".join(map(str, place.to_gdal())) if where == "aux.xml" else ""
            wkt = html.escape(crs.to_wkt("WKT1_GDAL"))
            points = (f'<GCP Id="" Pixel="{u}" Line="{v}" X="{x!r}" Y="{y!r}"/>' for u, v, x, y in spread(place))
            stated = {
                "aux.xml of control points": f'<GCPList Projection="{wkt}">{"".join(points)}</GCPList>',
                "aux.xml of ArcGIS": f"<Metadata><SpatialReference><WKT>{wkt}</WKT></SpatialReference></Metadata>",
            }.get(where, f'<SRS dataAxisToSRSAxisMapping="1,2">{wkt}</SRS><GeoTransform> {numbers}</GeoTransform>')
            Path(f"{path}.aux.xml").write_text(f"<PAMDataset>{stated}</PAMDataset>")
    found = read_georeference(path)
    assert found is not None
    middle = pyproj.Transformer.from_crs(crs, 4326, always_xy=True).transform(*at(place, 40, 30))
    assert found.middle() == pytest.approx(middle, abs=1e-7)
    assert "EPSG:2" not in found.crs[:6]


@pytest.mark.parametrize("container", ["gpkg", "shp", "fgb", "sqlite", "parquet", "frame"])
@pytest.mark.parametrize("name", ["utm", "degrees", "of a datum with a number"])
def test_and_so_it_is_in_maps(tmp_path: Path, name: str, container: str) -> None:
    crs = pyproj.CRS(SHIFTED[name])
    x, y = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform([-8.6, -8.59], [41.15, 41.16])
    frame = gpd.GeoDataFrame({"a": [1]}, geometry=[shapely.LineString(np.c_[x, y])], crs=crs)
    path = tmp_path / f"roads.{container}"
    with warnings.catch_warnings(action="ignore"):
        if container == "parquet":
            frame.to_parquet(path)
        elif container != "frame":
            drivers = {"sqlite": "SQLite", "fgb": "FlatGeobuf"}
            frame.to_file(path, engine="pyogrio", driver=drivers.get(container))
        if container == "shp":
            path.with_suffix(".prj").write_text(crs.to_wkt("WKT1_GDAL"))
        roads = choose_roads(frame if container == "frame" else path)
    lonlat = to_lonlat(roads.plane.crs, roads.plane.to_crs(shapely.get_coordinates(roads.lines)))
    np.testing.assert_allclose(lonlat, [[-8.6, 41.15], [-8.59, 41.16]], atol=1e-7)


@pytest.mark.parametrize(
    ("crs", "steps", "shape"),
    [
        ("EPSG:4326", (1e-5, -1e-5), (np.cos(np.radians(60)), False)),
        ("EPSG:4326", (1e-5, 1e-5), (np.cos(np.radians(60)), True)),
        ("EPSG:4326", (2e-5, -1e-5), (None, False)),
        ("EPSG:32632", (1.0, -1.0), (None, False)),
        ("EPSG:32632", (1.5, -1.0), (1.5, False)),
        ("EPSG:32632", (1.0, 1.0), (None, True)),
        ("EPSG:32632", (-1.0, 1.0), (None, False)),
        ("EPSG:3857", (1.0, -1.0), (None, False)),
        ("EPSG:4087", (1.0, -1.0), (np.cos(np.radians(60)), False)),  # plate carree
    ],
)
def test_the_shape_of_pixels_is_as_the_file_states_it(tmp_path, crs, steps, shape) -> None:
    x, y = transformer("EPSG:4326", crs).transform(9.0, 60.0)
    path = write(tmp_path / "a.tif", crs=crs, transform=rasterio.Affine(steps[0], 0, x, 0, steps[1], y))
    stretch, is_mirrored, _ = read_stated(path)
    assert is_mirrored is shape[1]
    assert stretch == (None if shape[0] is None else pytest.approx(shape[0], rel=0.01))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("where", ["world file", "aux.xml"])
def test_files_beside_a_picture_state_the_shape_of_its_pixels(tmp_path: Path, where: str) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), BLACK)
    if where == "world file":
        (tmp_path / "a.pgw").write_text("2\n0\n0\n1\n530000\n4557000\n")
        (tmp_path / "a.prj").write_text(pyproj.CRS(32629).to_wkt("WKT1_ESRI"))
    else:
        stated = (
            f"<SRS>{pyproj.CRS(32629).to_wkt('WKT1_GDAL')}</SRS><GeoTransform>530000,2,0,4557000,0,1</GeoTransform>"
        )
        (tmp_path / "a.png.aux.xml").write_text(f"<PAMDataset>{stated}</PAMDataset>")
    aspect, is_mirrored, _ = read_stated(tmp_path / "a.png")
    assert aspect == pytest.approx(2.0, rel=1e-3)
    assert is_mirrored


def test_files_that_state_no_shape_have_square_pixels(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((60, 80), np.uint8))
    assert read_stated(tmp_path / "a.png") == (None, False, None)
    assert read_stated(write(tmp_path / "a.tif"))[:2] == (None, False)
    assert read_stated(write(tmp_path / "b.tif", transform=rasterio.Affine(0.5, 0, 0, 0, 0.7, 0)))[:2] == (None, False)
