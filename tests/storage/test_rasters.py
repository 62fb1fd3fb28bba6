"""Rasters of strangers: what they name is neither read, nor fetched, nor written."""

import os
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import rasterio
import rasterio.control
from support.loopback import counting_server
from worlds.hostile import mrf, virtual
from worlds.pngs import png
from worlds.rasters import write_raster
from worlds.turned import mark_turned, save_turned

from roadgeo.errors import MaskError, OutputError
from roadgeo.outputs.orthophoto import read_preview
from roadgeo.sources.exif import read_focal_length
from roadgeo.sources.masks import open_mask, read_mask
from roadgeo.sources.segmentation.photograph import open_photograph
from roadgeo.storage.gdal import CONSENT
from roadgeo.storage.rasters import (
    is_raster,
    name_page,
    open_raster,
    page_of,
    raster_size,
    sidecar_nodata,
    writing_raster,
)

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIZE = 1100  # large enough that only part of the values are looked at first


@pytest.fixture
def roads() -> np.ndarray:
    image = np.zeros((SIZE, SIZE), np.uint8)
    for k in range(6):
        cv2.line(image, (0, 100 + 180 * k), (SIZE, 60 + 190 * k), 255, 9)
        cv2.line(image, (80 + 190 * k, 0), (150 + 180 * k, SIZE), 255, 9)
    return image


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A file that no mask may touch."""
    path = tmp_path / "victim.sh"
    path.write_text("safe")
    return path


READERS: list[Callable[[Path], object]] = [read_mask, lambda path: read_preview(path, 200), read_focal_length]


def read_or_miss(read: Callable[[Path], object], path: Path) -> None:
    """Read a mask or a picture; of a focal length there is none."""
    with pytest.raises(MaskError, match="focal length") if read is read_focal_length else nullcontext():
        read(path)


@pytest.mark.parametrize("read", READERS, ids=["mask", "picture", "exif"])
class TestNothingIsWritten:
    @pytest.mark.parametrize(
        ("name", "content", "message"),
        [
            ("mask.png", "{mrf}", "is text"),
            ("mask.tif", "{vrt}", "virtual raster"),
        ],
    )
    def test_by_a_file_of_another_format(self, tmp_path, victim, read, name, content, message):
        inner, path = tmp_path / "inner.bin", tmp_path / name
        inner.write_text(mrf(tmp_path, victim).read_text())
        path.write_text(content.format(mrf=inner.read_text(), vrt=virtual(tmp_path, str(inner)).read_text()))
        with pytest.raises(MaskError, match=message):
            read(path)
        assert victim.read_text() == "safe"

    @pytest.mark.parametrize("sibling", [".ovr", ".msk", ".aux.xml"])
    def test_by_a_sibling(self, tmp_path, victim, roads, read, sibling):
        path = write_raster(tmp_path / "mask.tif", roads)
        Path(f"{path}{sibling}").write_text(mrf(tmp_path, victim).read_text())
        read_or_miss(read, path)
        assert victim.read_text() == "safe"

    @pytest.mark.parametrize("inside", [True, False])
    def test_by_overviews_that_metadata_name(self, tmp_path, victim, roads, read, inside):
        path, evil = tmp_path / "mask.tif", tmp_path / "evil"
        evil.write_text(mrf(tmp_path, victim).read_text())
        write_raster(path, roads)
        if inside:
            with rasterio.open(path, "r+") as sink:
                sink.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=str(evil))
            with pytest.raises(MaskError, match="overviews"):
                read(path)
        else:
            domain = f'<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{evil}</MDI></Metadata>'
            Path(f"{path}.aux.xml").write_text(f"<PAMDataset>{domain}</PAMDataset>")
            read_or_miss(read, path)
        assert victim.read_text() == "safe"


def test_the_exploit_works_where_gdal_is_free(tmp_path, victim):
    """Else the tests above prove nothing."""
    path = tmp_path / "mask.png"
    path.write_text(mrf(tmp_path, victim).read_text())
    # In a process of its own: a command that other tests ran here has already shut the drivers out.
    free = {name: value for name, value in os.environ.items() if not name.startswith("GDAL_")}
    code = "import sys, rasterio; rasterio.open(sys.argv[1]).read(1)"
    subprocess.run([sys.executable, "-c", code, str(path)], check=True, env=free, capture_output=True)
    assert victim.stat().st_size > 4


@pytest.fixture
def server() -> Iterator[tuple[str, list[str]]]:
    with counting_server() as served:
        yield served


@pytest.mark.parametrize("read", READERS, ids=["mask", "picture", "exif"])
def test_nothing_is_fetched(tmp_path, server, victim, roads, read):
    address, asked = server
    texts = {
        "vrt": virtual(tmp_path, f"/vsicurl/{address}/a.tif").read_text(),
        "wms": f'<GDAL_WMS><Service name="TMS"><ServerUrl>{address}/${{z}}</ServerUrl></Service></GDAL_WMS>',
        "wcs": f"<WCS_GDAL><ServiceURL>{address}/?</ServiceURL><CoverageName>a</CoverageName></WCS_GDAL>",
        "wmts": f"<GDAL_WMTS><GetCapabilitiesUrl>{address}/?</GetCapabilitiesUrl></GDAL_WMTS>",
        "gti": f"<GDALTileIndexDataset><IndexDataset>/vsicurl/{address}/i.gpkg</IndexDataset></GDALTileIndexDataset>",
        "stac": f'{{"type": "FeatureCollection", "stac_version": "1", "features": [], "href": "{address}/s"}}',
    }
    for name, text in texts.items():
        path = tmp_path / f"{name}.png"
        path.write_text(text)
        with pytest.raises(MaskError, match=CONSENT if name == "vrt" else "format"):
            read(path)
    path = write_raster(tmp_path / "linked.tif", roads)
    with rasterio.open(path, "r+") as sink:
        sink.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"/vsicurl/{address}/o.tif")
    with pytest.raises(MaskError, match="overviews"):
        read(path)
    assert asked == []


def test_a_virtual_raster_is_read_by_consent(tmp_path, roads, monkeypatch):
    path = tmp_path / "mask.vrt"
    text = virtual(tmp_path, str(write_raster(tmp_path / "part.tif", roads))).read_text().replace('="64"', f'="{SIZE}"')
    path.write_text(text)
    with pytest.raises(MaskError, match=f"{CONSENT}=VRT"):
        read_mask(path)
    monkeypatch.setenv(CONSENT, "VRT")
    assert np.array_equal(read_mask(path).roads, roads > 0)


def test_other_drivers_are_used_by_consent(tmp_path, roads, monkeypatch):
    path = tmp_path / "mask.asc"
    header = f"ncols {SIZE}\nnrows {SIZE}\nxllcorner 0\nyllcorner 0\ncellsize 1\n"
    path.write_text(header + "\n".join(" ".join(map(str, row)) for row in (roads // 255).tolist()))
    with pytest.raises(MaskError, match=CONSENT):
        read_mask(path)
    monkeypatch.setenv(CONSENT, "HF2, AAIGrid")
    assert np.array_equal(read_mask(path).roads, roads > 0)


def test_internal_masks_count_and_nodata_beside_the_file(tmp_path, roads):
    """What stays of what lies beside a file: the nodata value."""
    path = tmp_path / "mask.png"
    seen = np.where(np.arange(SIZE) < 700, roads, 7).astype(np.uint8)
    cv2.imwrite(str(path), seen)
    band = '<PAMRasterBand band="1"><NoDataValue>7.00000000000000E+00</NoDataValue></PAMRasterBand>'
    Path(f"{path}.aux.xml").write_text(f"<PAMDataset>{band}</PAMDataset>")
    observed = read_mask(path).observed
    assert observed is not None
    assert np.array_equal(observed, np.broadcast_to(np.arange(SIZE) < 700, roads.shape))


@pytest.mark.parametrize("read", [*READERS[:2]], ids=["mask", "picture"])
def test_what_is_no_regular_file(tmp_path, read):
    os.mkfifo(tmp_path / "pipe.png")
    for path, message in ((tmp_path / "pipe.png", "pipe"), (Path("/dev/zero"), "pipe or device"), (tmp_path, "folder")):
        with pytest.raises(MaskError, match=message):
            read(path)
    with pytest.raises(MaskError, match="cannot be read"):
        read(tmp_path / ("n" * 300 + ".png"))
    with pytest.raises(MaskError, match="cannot be read"):
        read(Path("a\0.png"))


class TestSizes:
    @pytest.mark.parametrize(
        ("side", "reported"),
        [(100_000, "100000 x 100000 pixels; expected 32 to 20000"), (2**31 - 1, "not a raster that can be read")],
    )
    def test_a_header_says_too_much(self, tmp_path, side, reported):
        (tmp_path / "a.png").write_bytes(png(side, side))
        with pytest.raises(MaskError, match=reported):
            read_mask(tmp_path / "a.png")

    @pytest.mark.parametrize("bits", [24, 32])
    def test_a_bmp_that_gdal_does_not_read_is_refused_in_a_line(self, tmp_path, bits):
        path = tmp_path / "a.bmp"
        if bits == 24:
            path.write_bytes(b"BM" + bytes(12) + struct.pack("<iiiHH", 40, 20_000, 20_000, 1, 24) + bytes(24))
        else:  # with masks of its channels, as newer versions of OpenCV write it
            size = struct.pack("<iiiHHii", 124, 8, 8, 1, 32, 3, 256) + bytes(16)
            masks = struct.pack("<IIII", 0xFF0000, 0xFF00, 0xFF, 0xFF000000)
            path.write_bytes((b"BM" + struct.pack("<iii", 394, 0, 138) + size + masks).ljust(394, b"\0"))
        with pytest.raises(MaskError, match="not a raster"):
            read_mask(path)


class TestValues:
    def test_complex_numbers(self, tmp_path, roads):
        path = write_raster(tmp_path / "mask.tif", roads.astype(np.complex64))
        with pytest.raises(MaskError, match="complex64; expected real numbers"):
            read_mask(path)

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize(("dtype", "value"), [(np.float64, 1e308), (np.float64, -1.7e308), (np.float32, -3.4e38)])
    def test_what_only_stands_for_no_value(self, tmp_path, roads, dtype, value):
        values = np.where(np.arange(SIZE) < 700, roads / 255, value).astype(dtype)
        mask = read_mask(write_raster(tmp_path / "mask.tif", values))
        assert np.array_equal(mask.roads[:, :690], roads[:, :690] > 0)
        if dtype == np.float64:
            assert mask.observed is not None
            assert not mask.observed[:, 700:].any()


def test_what_goes_wrong_inside_gdal_is_told_in_a_line(tmp_path, roads):
    """A damaged block raises what rasterio has no error of its own for."""
    path = write_raster(tmp_path / "mask.tif", roads, compress="deflate")
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 2000] = bytes(2000)
    path.write_bytes(content)
    with pytest.raises(MaskError, match="damaged or cut short"):
        read_mask(path)


def test_names_are_no_text_for_gdal(tmp_path, roads, monkeypatch):
    """A virtual raster may stand in for its own path."""
    monkeypatch.chdir(tmp_path)
    name = "<VRTDataset rasterXSize='64' rasterYSize='64'>.tif"
    shutil.move(write_raster(tmp_path / "a.tif", roads), name)
    assert read_mask(name).shape == roads.shape
    with open_raster(name) as raster:
        assert raster.driver == "GTiff"


# --- pictures that are to be turned -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_raster_is_upright(tmp_path: Path, roads: np.ndarray, kind: str, orientation: int) -> None:
    picture = np.repeat(roads[:300, :200, None], 3, axis=2)
    path = save_turned(tmp_path / f"photo.{kind}", picture, orientation)
    with open_raster(path) as raster:
        found = np.moveaxis(raster.read(), 0, 2)
        assert (raster.width, raster.height) == raster_size(path) == (200, 300)
        assert np.abs(found.astype(int) - picture).mean() < 2
        part = raster.read([1, 3], window=((10, 60), (20, 180)), out_shape=(2, 25, 80))
        assert np.abs(part[1].astype(int) - picture[10:60:2, 20:180:2, 2]).mean() < 60
        assert "EXIF_Orientation" not in raster.tags() or orientation == 1
    with open_raster(path, upright=False) as raster:
        assert raster.shape == ((300, 200) if orientation < 5 else (200, 300))


def test_a_georeference_is_turned_with_its_raster(tmp_path: Path, roads: np.ndarray) -> None:
    stored = roads[:300, :200]
    transform = rasterio.Affine(2.0, 0.0, 500_000.0, 0.0, -2.0, 4_600_000.0)
    place = {"transform": transform, "crs": "EPSG:32629", "nodata": 7}
    path = mark_turned(write_raster(tmp_path / "map.tif", stored, **place), 6)
    with open_raster(path) as raster:
        assert (raster.width, raster.height, raster.nodata, raster.crs.to_epsg()) == (300, 200, 7, 32629)
        column, row = 120, 30
        np.testing.assert_array_equal(raster.read(1), np.rot90(stored, -1))
        there = np.array(raster.transform).reshape(3, 3) @ (column + 0.5, row + 0.5, 1.0)
    back = np.linalg.inv(np.array(transform).reshape(3, 3)) @ there
    assert back[:2] == pytest.approx((row + 0.5, 300 - column - 0.5))


def test_what_a_raster_says_of_itself_is_kept_where_it_is_turned(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rgba = rng.integers(0, 256, (40, 60, 4)).astype(np.uint8)
    with open_raster(save_turned(tmp_path / "alpha.png", rgba, 5)) as raster:
        assert [item.name for item in raster.colorinterp] == ["red", "green", "blue", "alpha"]
        np.testing.assert_array_equal(raster.dataset_mask(), np.where(rgba[..., 3] > 0, rgba[..., 3], 0))
    classes = PIL.Image.fromarray(rng.integers(0, 3, (40, 60)).astype(np.uint8), "P")
    classes.putpalette([0, 0, 0, 250, 10, 10, 20, 30, 240])
    exif = PIL.Image.Exif()
    exif[274] = 3
    classes.save(tmp_path / "palette.png", exif=exif.tobytes())
    with open_raster(tmp_path / "palette.png") as raster:
        assert raster.colormap(1)[1][:3] == (250, 10, 10)
        np.testing.assert_array_equal(raster.read(1), np.asarray(classes)[::-1, ::-1])


def test_control_points_are_turned(tmp_path: Path, roads: np.ndarray) -> None:
    points = [rasterio.control.GroundControlPoint(r, c, 10.0 * c, -10.0 * r) for r in (0, 90) for c in (5, 100)]
    path = mark_turned(write_raster(tmp_path / "points.tif", roads[:100, :120], gcps=points, crs="EPSG:32629"), 3)
    with open_raster(path) as raster:
        found, crs = raster.gcps
    assert crs.to_epsg() == 32629
    for before, after in zip(points, found, strict=True):
        assert (after.x, after.y) == (before.x, before.y)
        assert (after.col, after.row) == (120 - before.col, 100 - before.row)


# --- arrays that NumPy saved ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["bool", "uint8", "int64", "float16", "float32", ">f8"])
@pytest.mark.parametrize("bands", ["none", "first", "last"])
def test_an_array_is_a_raster(tmp_path: Path, dtype: str, bands: str) -> None:
    values = np.random.default_rng(0).integers(0, 2, (40, 60)).astype(dtype)
    shaped = {"none": values, "first": values[None], "last": np.stack([values, values], 2)}[bands]
    np.save(tmp_path / "mask.npy", shaped)
    with open_raster(tmp_path / "mask.npy") as raster:
        assert (raster.shape, raster.count) == ((40, 60), 2 if bands == "last" else 1)
        np.testing.assert_array_equal(raster.read(1), values)
        assert raster.transform.is_identity


def pnm(kind: str, roads: np.ndarray) -> bytes:
    """Write a mask in a format of the family of PNM, in which PBM has black for 1."""
    height, width = roads.shape
    levels, size = 255 * roads.astype(np.uint8), f"\n# by hand\n{width} {height}\n".encode()
    pam = f"P7\nWIDTH {width}\nHEIGHT {height}\nDEPTH 1\nMAXVAL 255\nTUPLTYPE GRAYSCALE\nENDHDR\n".encode()
    return {
        "P1": b"P1" + size + " ".join(map(str, 1 - roads.ravel())).encode(),
        "P2": b"P2" + size + b"255\n" + " ".join(map(str, levels.ravel())).encode(),
        "P3": b"P3" + size + b"255\n" + " ".join(f"{v} {v} {v}" for v in levels.ravel()).encode(),
        "P4": b"P4" + size + np.packbits(1 - roads, axis=1).tobytes(),
        "P5": b"P5" + size + b"255\n" + levels.tobytes(),
        "P6": b"P6" + size + b"255\n" + np.repeat(levels, 3).tobytes(),
        "P7": pam + levels.tobytes(),
        "Pf": f"Pf\n{width} {height}\n-1.0\n".encode() + roads[::-1].astype("<f4").tobytes(),
    }[kind]


@pytest.mark.parametrize("kind", ["P1", "P2", "P3", "P4", "P5", "P6", "P7", "Pf"])
def test_all_of_pnm_are_read(tmp_path: Path, kind: str) -> None:
    roads = (crossing() > 0).astype(np.uint8)
    (tmp_path / "a.pnm").write_bytes(pnm(kind, roads))
    np.testing.assert_array_equal(read_mask(tmp_path / "a.pnm").roads, roads > 0)
    (tmp_path / "a.pnm").write_bytes(pnm(kind, roads)[: 2000 if kind != "P4" else 500])
    with pytest.raises(MaskError, match="damaged or cut short"):
        read_mask(tmp_path / "a.pnm")


def test_an_archive_of_arrays_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", crossing())
    with pytest.raises(MaskError, match=r"an archive of arrays; save the one that is the mask with numpy\.save"):
        read_mask(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.array([{"a": 1}]), "no array that can be read"),
        (np.array(["road"] * 3), "expected .rows, columns. of real numbers"),
        (np.zeros((40, 60), complex), "array of complex128"),
        (np.zeros((2, 40, 60, 3)), "bands first or last"),
        (np.zeros((0, 60)), "no array that can be read|bands first"),
    ],
)
def test_what_is_no_array_of_numbers_is_said(tmp_path: Path, content: np.ndarray, message: str) -> None:
    np.save(tmp_path / "a.npy", content, allow_pickle=True)
    with pytest.raises(MaskError, match=message) as raised, open_raster(tmp_path / "a.npy"):
        pass
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kept", [7, 20, 100, 1000])
def test_an_array_that_is_cut_short_is_said(tmp_path: Path, kept: int) -> None:
    np.save(tmp_path / "a.npy", np.zeros((40, 60), np.uint8))
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:kept])
    with pytest.raises(MaskError, match="no array that can be read"), open_raster(tmp_path / "a.npy"):
        pass


# --- what may be behind an error -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reason", "free", "doubt"),
    [
        ("The WKT could not be parsed. OGR Error code 5", 1 << 40, ""),
        ("TIFFAppendToStrip:Write error at scanline 3", 1 << 40, "is the disk full?"),
        ("Compression failed", 1 << 20, "the disk is full: 1 MB are left"),
        ("band 1: IReadBlock failed at X offset 0", 1 << 40, "is the picture damaged?"),
        ("Cannot find proj.db", 1 << 40, "PROJ's data are missing: unset PROJ_DATA and PROJ_LIB"),
    ],
)
def test_a_cause_is_named_where_something_speaks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: str, free: int, doubt: str
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: shutil._ntuple_diskusage(1 << 41, 0, free))
    with pytest.raises(OutputError) as raised, writing_raster(tmp_path / "a.tif"):
        raise rasterio.errors.RasterioError(reason)
    reported = str(raised.value)
    assert f"{reason}; {doubt}" in reported if doubt else reported.endswith(reason)


@pytest.mark.parametrize("text", [b"<NoDataValue" * 80_000, b"<NoDataValue>" + b" " * 1_000_000])
def test_what_has_no_end_beside_a_raster_is_looked_at_once(text: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.png.aux.xml").write_bytes(text)
    started = time.process_time()
    assert sidecar_nodata(tmp_path / "a.png") is None
    assert time.process_time() - started < 1.0


def test_text_that_is_called_an_image_is_said_to_be_text(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("404: no such file\n", encoding="utf-8")
    output = r"a\.jpg: is text, whatever its name says; expected an image"
    with pytest.raises(MaskError, match=output), open_raster(tmp_path / "a.jpg"):
        pass


def test_an_imagine_file_keeps_overviews_of_its_own_and_pixels_beside_it(tmp_path: Path) -> None:
    spilled = write_raster(tmp_path / "spilled.img", np.ones((64, 64), np.uint8), "HFA", USE_SPILL="YES")
    with rasterio.open(write_raster(tmp_path / "a.img", np.ones((64, 64), np.uint8), "HFA"), "r+") as raster:
        raster.build_overviews([2])
    for path in (spilled, tmp_path / "a.img"):
        with open_raster(path) as raster:
            assert raster.read(1).all()
    with open_raster(tmp_path / "a.img") as raster:
        assert raster.overviews(1) == [2]


# --- raw photographs, and pages ---------------------------------------------------------------------------------------


def tiff_tags(path: Path, *entries: tuple[int, int, int, int], canon: bool = False) -> Path:
    """Write a TIFF whose first directory has these entries: tag, type, count, value."""
    at = 16
    head = struct.pack("<2sHI", b"II", 42, at) + (b"CR\2\0" if canon else b"").ljust(8, b"\0")
    rows = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    path.write_bytes(head + struct.pack("<H", len(entries)) + rows + bytes(4))
    return path


@pytest.mark.parametrize("name", ["a.DNG", "a.nef", "a.cr3", "dng.tif", "nef.tif", "cr2.tif"])
def test_raw_photographs_are_refused_by_name(tmp_path: Path, name: str) -> None:
    entries = {"dng.tif": [(50706, 1, 4, 1)], "nef.tif": [(254, 4, 1, 1), (330, 4, 1, 8)]}.get(name, [(256, 4, 1, 64)])
    with pytest.raises(MaskError, match=r"a raw photograph .*thumbnail could be read; develop it: save it as"):
        read_mask(tiff_tags(tmp_path / name, *entries, canon=name == "cr2.tif"))


def test_a_pyramid_is_no_raw_photograph(tmp_path: Path) -> None:
    path = tiff_tags(tmp_path / "a.tif", (254, 4, 1, 0), (330, 4, 1, 8))
    with pytest.raises(MaskError, match="not a raster that can be read"):
        read_mask(path)


def crossing() -> np.ndarray:
    roads = np.zeros((80, 100), np.uint8)
    cv2.line(roads, (0, 20), (100, 30), 255, 5)
    cv2.line(roads, (40, 0), (30, 80), 255, 5)
    return roads


def two_pages(path: Path) -> tuple[Path, np.ndarray]:
    roads = crossing()
    pages = [PIL.Image.fromarray(image) for image in (roads[::-1].copy(), roads)]
    pages[0].save(path, save_all=True, append_images=pages[1:])
    return path, roads


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_pages_of_a_tiff(tmp_path: Path) -> None:
    path, roads = two_pages(tmp_path / "pages.tif")
    for page, right in ((None, roads[::-1]), (1, roads[::-1]), (2, roads)):
        with open_mask(name_page(str(path), page)) as opened:
            assert opened.part == ("page 1 of 2" if page is None else f"page {page}")
            np.testing.assert_array_equal(opened.read(opened.thresholds[0]).roads, right > 0)
    assert raster_size(name_page(str(path), 2)) == (100, 80)
    with pytest.raises(MaskError, match=r"pages\.tif: not a raster that can be read"):
        read_mask(name_page(str(path), 3))
    cv2.imwrite(str(tmp_path / "a.png"), roads)
    with pytest.raises(MaskError, match="holds no pages"):
        read_mask(name_page(str(tmp_path / "a.png"), 2))
    assert page_of(tmp_path / "a.png") == ""


@pytest.mark.parametrize("kind", ["mask", "photograph"])
@pytest.mark.parametrize(
    ("name", "part"),
    [("a.tif", "page 1 of 3"), ("turned.tif", "page 1 of 3"), ("a.gif", "picture 1 of 3"), ("a.png", "picture 1 of 3")],
)
def test_the_first_of_several_pictures_is_read_and_named(tmp_path: Path, name: str, part: str, kind: str) -> None:
    save_several(tmp_path / name, roads := crossing())
    if kind == "mask":
        with open_mask(tmp_path / name) as opened:
            assert opened.part == part
            np.testing.assert_array_equal(opened.read(opened.thresholds[0]).roads, roads > 0)
        return
    with open_photograph(tmp_path / name) as photograph:
        assert photograph.page == part
        np.testing.assert_array_equal(photograph.read(0, 0, 100, 80, (80, 100))[0][..., 1] > 127, roads > 0)


def test_an_animated_webp_is_refused(tmp_path: Path) -> None:
    save_several(tmp_path / "a.webp", crossing())
    with pytest.raises(MaskError, match="an animated WebP, which is not read; save its pictures"):
        read_mask(tmp_path / "a.webp")


def save_several(path: Path, image: np.ndarray) -> None:
    """Write an image, and two others that are like it upside down and turned around."""
    exif = PIL.Image.Exif()
    if path.stem == "turned":
        exif[274], image = 3, image[::-1, ::-1]
    pages = [PIL.Image.fromarray(one) for one in (image, image[::-1].copy(), image[:, ::-1].copy())]
    pages[0].save(path, save_all=True, append_images=pages[1:], exif=exif)


def save_pages(path: Path, kinds: tuple[int, ...], sizes: tuple[int, ...], order: str, tag: int) -> Path:
    """Write a TIFF of pages that say by a tag what they are."""
    pages = [PIL.Image.fromarray(np.full((size, size), k, np.uint8)) for k, size in enumerate(sizes)]
    pages[0].save(path, save_all=True, append_images=pages[1:], tiffinfo={tag: 9}, big_tiff="big" in order)
    content, at = bytearray(path.read_bytes()), 0
    for kind in kinds:
        at = content.index(struct.pack("<H", tag) + (b"\x04" if tag == 254 else b"\x03"), at)
        value = at + (12 if "big" in order else 8)
        assert content[value] == 9
        content[value], at = kind, value
    path.write_bytes(content)
    return path


THUMB, WHOLE = 96, 200


@pytest.mark.parametrize(
    ("kinds", "sizes", "tag", "page"),
    [
        ((1, 0), (THUMB, WHOLE), 254, 2),
        ((1, 1, 0), (64, THUMB, WHOLE), 254, 3),
        ((4, 0), (WHOLE, WHOLE), 254, 2),  # its mask comes first
        ((3, 2), (THUMB, WHOLE), 254, 2),  # of a document of several pages
        ((2, 1), (THUMB, WHOLE), 255, 2),  # as TIFF 5.0 says it
        ((0, 1), (WHOLE, THUMB), 254, 1),
        ((1, 1), (THUMB, WHOLE), 254, 1),
    ],
)
@pytest.mark.parametrize("order", ["small", "big"])
def test_a_thumbnail_in_front_is_no_picture(
    kinds: tuple[int, ...], sizes: tuple[int, ...], tag: int, page: int, order: str, tmp_path: Path
) -> None:
    path = save_pages(tmp_path / "a.tif", kinds, sizes, order, tag)
    size = (sizes[page - 1],) * 2
    assert raster_size(path) == size
    with open_raster(path) as dataset, open_photograph(path) as photograph:
        assert dataset.shape == (photograph.height, photograph.width) == size
        assert dataset.read(1)[0, 0] == page - 1
        assert (f"page {page}" in page_of(path)) == (f"page {page}" in photograph.page) == (page > 1)
    if sizes[0] >= 64:
        with open_raster(name_page(str(path), 1)) as dataset:  # which one may ask for
            assert dataset.shape == (sizes[0],) * 2


@pytest.mark.parametrize("read", READERS, ids=["mask", "picture", "exif"])
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg", "npy", "jp2"])
def test_an_empty_file_is_called_so(tmp_path: Path, read, suffix: str) -> None:
    (tmp_path / f"a.{suffix}").touch()
    with pytest.raises(MaskError, match="is empty"):
        read(tmp_path / f"a.{suffix}")


@pytest.mark.parametrize("brand", [b"heic", b"heix", b"mif1", b"avif", b"avis"])
@pytest.mark.parametrize("name", ["a.HEIC", "a.jpg", "a.avif", "a"])
def test_pictures_of_phones_that_are_not_read_are_named(tmp_path: Path, brand: bytes, name: str) -> None:
    (tmp_path / name).write_bytes(b"\0\0\0\x18ftyp" + brand + b"\0\0\0\0mif1" + bytes(4000))
    assert is_raster(tmp_path / name)  # and no video
    message = "a picture in HEIC or AVIF, which is not read; save it as JPEG or TIFF"
    with pytest.raises(MaskError, match=message), open_raster(tmp_path / name):
        pass


CUT = {
    **{f"a.{suffix}": {} for suffix in ("png", "jpg", "bmp", "gif", "jp2", "tif", "pgm", "ppm")},
    **{f"{kind}.tif": {"compression": kind} for kind in ("tiff_lzw", "jpeg", "tiff_deflate")},
}


@pytest.mark.parametrize("name", CUT)
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_pictures_that_are_cut_off_say_so_in_plain_words(tmp_path: Path, name: str, share: float) -> None:
    path = tmp_path / name
    PIL.Image.fromarray(np.random.default_rng(0).integers(0, 255, (300, 300), np.uint8)).save(path, **CUT[name])
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    message = r"damaged or cut short; copy or export it again$"
    with pytest.raises(MaskError, match=message), open_raster(path) as raster:
        raster.read()
