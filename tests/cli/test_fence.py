"""Files of strangers that name others: nothing that they name is opened, whichever way it is written."""

import os
import re
import shutil
import sqlite3
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import click
import pytest
import rasterio
from support.loopback import counting_server
from worlds.demo import DRONE
from worlds.hostile import MAPS, MASKS, mrf, naming, virtual

from roadgeo import plugins
from roadgeo.cli import cli, main
from roadgeo.cli.fencing import fence_of
from roadgeo.storage.fence import abi_version
from roadgeo.storage.folders import cache_dir
from roadgeo.storage.gdal import CONSENT
from roadgeo.storage.rasters import _DRIVERS, _WRITTEN, raster_size

pytestmark = pytest.mark.skipif(not abi_version(), reason="this system has no Landlock (Linux 5.13 and later)")

#: Reads all that lies in a folder, inside a fence around that folder, and prints what it made of each.
READ = """
import sys
from pathlib import Path
import roadgeo
from roadgeo.errors import RoadgeoError
from roadgeo.sources.georeference import read_georeference
from roadgeo.sources.masks import read_mask
from roadgeo.sources.roads import read_roads
from roadgeo.storage.rasters import name_page
assert roadgeo.fence(sys.argv[1])
for path in sorted(Path(sys.argv[1]).glob("*/*.*")):
    reads = {"mask": (read_mask, read_georeference, lambda path: read_georeference(name_page(str(path), 2)))}
    for read in reads.get(path.stem, [lambda path: read_roads(path, which="all")]):
        try:
            read(path)
            said = "read"
        except RoadgeoError as error:
            said = str(error)
            assert "\\n" not in said
        print(path, said)
"""


@pytest.fixture(scope="module")
def strace() -> list[str]:
    command = ["strace", "-f", "-qq", "--seccomp-bpf", "-s", "4096", "-e", "trace=open,openat"]
    traced = shutil.which("strace") and subprocess.run([*command, "true"], capture_output=True, check=False)
    if not traced or traced.returncode:
        pytest.skip("strace is missing, or must not trace")
    return command


def surroundings(folder: Path) -> dict[str, str]:
    return {**os.environ, "ROADGEO_CACHE": str(cache_dir()), "ROADGEO_LIBRARY": str(folder / "library")}


def test_no_map_and_no_mask_has_another_file_opened(tmp_path: Path, strace: list[str]) -> None:
    """By the system's own account; where the fence is down, most of them have it opened, and pipes never end."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "grid.gsb").write_bytes(bytes(4096))
    os.mkfifo(tmp_path / "elsewhere" / "fifo.ige")
    for target, ways in (("grid.gsb", slice(0, None, 3)), ("fifo.ige", slice(1))):
        file = str(tmp_path / "elsewhere" / target)
        makers = [(make, crs) for make in MAPS for crs in naming(file)[ways]] + [(make, file) for make in MASKS]
        for n, (make, named) in enumerate(makers):
            folder = tmp_path / "given" / f"{target}-{n}-{make.__name__}"
            folder.mkdir(parents=True)
            make(folder, named)
    command = [*strace, "-o", str(tmp_path / "trace"), sys.executable, "-c", READ, str(tmp_path / "given")]
    done = subprocess.run(
        command, cwd=tmp_path, env=surroundings(tmp_path), capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    tried = [line for line in (tmp_path / "trace").read_text().splitlines() if re.search(r'elsewhere/[a-z.]+"', line)]
    assert not [line for line in tried if " = -1 " not in line]
    assert {kind for line in tried if "EACCES" in line for kind in ("grid.gsb", "fifo.ige") if kind in line} == {
        "grid.gsb",
        "fifo.ige",
    }
    assert len(tried) > 100


def roadgeo(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "roadgeo", *words]
    return subprocess.run(
        command, cwd=folder, env=surroundings(folder), capture_output=True, text=True, timeout=300, check=False
    )


def test_neither_is_what_lies_beside_it_where_results_go(tmp_path: Path, strace: list[str]) -> None:
    (tmp_path / "beside.gsb").write_bytes(bytes(4096))
    MAPS[0](tmp_path, naming(str(tmp_path / "beside.gsb"))[0])
    command = ["-m", "roadgeo", "index", "--roads", "roads.geojson", "--out", "made.gpkg"]
    traced = [*strace, "-o", "trace", sys.executable, *command]
    subprocess.run(traced, cwd=tmp_path, env=surroundings(tmp_path), capture_output=True, timeout=300, check=False)
    tried = [line for line in (tmp_path / "trace").read_text().splitlines() if 'beside.gsb"' in line]
    assert tried
    assert not [line for line in tried if " = -1 " not in line]


def test_a_virtual_raster_reads_what_it_names_where_that_is_allowed(porto: Path, tmp_path: Path) -> None:
    (tmp_path / "tiles").mkdir()
    shutil.copy(DRONE, tmp_path / "tiles" / "drone.png")
    size = raster_size(DRONE)
    text = virtual(tmp_path, "tiles/drone.png").read_text()
    text = text.replace('YSize="64"', f'YSize="{size[1]}"').replace('XSize="64"', f'XSize="{size[0]}"')
    (tmp_path / "mask.vrt").write_text(text.replace('relativeToVRT="0"', 'relativeToVRT="1"'))
    refused = roadgeo(tmp_path, "locate", "mask.vrt", "-r", str(porto))
    assert refused.returncode == 1
    assert refused.stderr.count("\n") == 1
    assert "--allow" in refused.stderr
    assert roadgeo(tmp_path, "locate", "mask.vrt", "-r", str(porto), "--allow", "tiles").returncode == 0


def test_nothing_is_read_of_the_standard_input(tmp_path: Path) -> None:
    """Its end is waited for: a pipe is no file, to which the fence has rules."""
    MAPS[0](tmp_path, naming("/dev/stdin")[0])
    virtual(tmp_path, "/proc/self/fd/0")
    reading, writing = os.pipe()
    try:
        for command in (["index", "--roads", "roads.geojson", "--out", "made.gpkg"], ["vectorize", "mask.vrt"]):
            program = [sys.executable, "-m", "roadgeo", *command]
            how = {"cwd": tmp_path, "env": surroundings(tmp_path), "stdin": reading, "timeout": 60}
            subprocess.run(program, **how, capture_output=True, check=False)
    finally:
        os.close(reading)
        os.close(writing)


VIRTUAL = """
import sys
import roadgeo
from roadgeo.errors import MaskError
from roadgeo.sources.masks import read_mask
if sys.argv[2] == "loaded":
    import rasterio
    rasterio.Env().__enter__()
assert roadgeo.fence(sys.argv[1])
try:
    read_mask(f"{sys.argv[1]}/mask.vrt")
except MaskError as error:
    print(error)
"""


@pytest.mark.parametrize("gdal", ["loaded", "not loaded"])
def test_what_a_virtual_raster_names_writes_nothing_where_machine_code_is_kept(tmp_path: Path, gdal: str) -> None:
    """The cache may be written inside the fence, and GDAL has a driver that writes where a file says."""
    (tmp_path / "cache").mkdir(mode=0o700)
    (tmp_path / "given").mkdir()
    virtual(tmp_path / "given", str(mrf(tmp_path / "given", tmp_path / "cache" / "planted")))
    command = [sys.executable, "-c", VIRTUAL, str(tmp_path / "given"), gdal]
    environment = {**surroundings(tmp_path), "ROADGEO_CACHE": str(tmp_path / "cache")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=120)
    assert not (tmp_path / "cache" / "planted").exists()
    assert "not recognized" in done.stdout


def test_no_driver_of_any_build_is_left_but_those_that_are_listed(tmp_path: Path) -> None:
    """Builds of GDAL have drivers of their own; a program may have loaded it, and be reading, before."""
    virtual(tmp_path, "nothing.tif")
    code = VIRTUAL + "with rasterio.Env() as env:\n    print(*sorted(env.drivers()), sep=',')"
    command = [sys.executable, "-c", code, str(tmp_path), "loaded"]
    environment = {**surroundings(tmp_path), CONSENT: "netCDF,ENVI"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=120)
    left = {*done.stdout.splitlines()[-1].split(",")}
    assert {"GTiff", "PNG", "VRT"} <= left <= {*_WRITTEN, *(driver for _, driver in _DRIVERS), "netCDF", "ENVI"}


@pytest.mark.parametrize(
    "source", ["/vsicurl/{}/a.tif", "ZARR:&quot;/vsicurl/{}/z&quot;", "NETCDF:&quot;{}/a#mode=bytes&quot;:v"]
)
def test_a_virtual_raster_fetches_nothing_where_connections_are_made(tmp_path: Path, source: str) -> None:
    """As in a command that asks a server, or where the system cannot forbid connections."""
    (tmp_path / "given").mkdir()
    with counting_server() as (address, asked):
        virtual(tmp_path / "given", source.format(address))
        code = VIRTUAL.replace("sys.argv[1])", "sys.argv[1], network=True)")
        command = [sys.executable, "-c", code, str(tmp_path / "given"), "not loaded"]
        environment = {**surroundings(tmp_path), "no_proxy": "127.0.0.1"}
        subprocess.run(command, env=environment, capture_output=True, check=True, timeout=120)
    assert asked == []


def test_what_is_no_raster_is_named_inside_too(tmp_path: Path) -> None:
    (tmp_path / "mask.png").write_text("no picture")
    (tmp_path / "mask.nc").write_bytes(b"CDF\1" + bytes(100))
    for name, message in (("mask.png", "is text, whatever its name says"), ("mask.nc", "not a raster of a format")):
        assert message in roadgeo(tmp_path, "vectorize", name).stderr


def test_drivers_that_are_left_out_are_left_out_without_a_word(porto: Path, tmp_path: Path) -> None:
    shutil.copy(DRONE, tmp_path)
    for command in (("index", "--roads", str(porto), "--out", "again.gpkg", "-q"), ("vectorize", "drone.png")):
        done = roadgeo(tmp_path, *command)
        assert (done.returncode, done.stderr) == (0, "")


def test_a_reference_in_another_folder_gets_its_index_there(porto: Path, tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    shutil.copy(porto, tmp_path / "maps")
    shutil.copy(DRONE, tmp_path)
    for name in ("maps/porto.gpkg", "maps/porto"):
        done = roadgeo(tmp_path, "locate", "drone.png", "-r", name, "-o", "found", "-j", "2", "-q")
        assert done.returncode == 0, done.stderr
        assert (tmp_path / "maps" / "porto.index").is_file()
    assert not list(tmp_path.rglob(".roadgeo*"))


def test_a_map_of_where_it_works_is_written_here(porto: Path, tmp_path: Path) -> None:
    view = ("--height", "400", "--size", "400", "--noise", "clean", "-n", "4")
    done = roadgeo(tmp_path, "evaluate", str(porto), "--map", *view)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "porto_localizability.tif").is_file()


def test_images_are_corrected_where_they_lie(porto: Path, tmp_path: Path) -> None:
    shutil.copy(DRONE, tmp_path)
    assert main(["locate", "drone.png", "-r", str(porto), "-q"]) == 0
    with rasterio.open(tmp_path / "drone_footprint.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as raster:
        raster.transform = rasterio.Affine.translation(30.0, 20.0) @ raster.transform
    done = roadgeo(tmp_path, "verify", "drone_footprint.tif", "-r", str(porto), "--in-place", "-o", "said")
    assert done.returncode == 4, done.stderr
    assert main(["verify", "drone_footprint.tif", "-r", str(porto), "-o", "said", "-q"]) == 0


def test_a_photographs_mask_of_an_earlier_run_may_be_looked_at(tmp_path: Path) -> None:
    """It is made anew only if it is ours."""
    (tmp_path / "photo_mask.tif").touch()
    (tmp_path / "other_mask.tif").symlink_to("/etc/passwd")
    read = fence_of("locate", {"images": ["photo.jpg"], "out_dir": str(tmp_path)}, ()).read
    assert str(tmp_path / "photo_mask.tif") in read
    assert str(tmp_path / "other_mask.tif") not in read


def test_the_segmenter_of_another_package_may_be_read_and_may_fetch_its_model(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = EntryPoint("theirs", "sqlite3.dbapi2:connect", plugins.SEGMENTERS)
    monkeypatch.setattr(plugins, "find_plugins", lambda group: {"theirs": theirs} if group == theirs.group else {})
    command = cli.get_command(click.Context(cli), "locate")
    assert command is not None
    given = command.make_context("locate", ["photo.jpg", "--segmenter=theirs"]).params
    fence = fence_of("locate", given, ())
    assert str(Path(sqlite3.__file__).parent) in fence.read
    assert fence.network
