"""README.md and docs say what is true: every command and program in them runs, offline, and gives what they show."""

import os
import re
import shutil
import subprocess
import sys
import time
from collections import UserDict
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np
import pytest
from support import documents
from support.documents import ROOT, blocks, run_page
from support.real_qgis import find_qgis
from worlds.fake_osm import OUTLINE, fake_osm, place
from worlds.fenway import streets, write_streets, write_vector

from roadgeo.cli import main
from roadgeo.kernels.compilation import kernel_folder

README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
}
LINKING = [
    *ROOT.glob("*.md"),
    *(path for one in ROOT.glob("[!.]*/") if one.name != "build" for path in one.rglob("*.md")),
]
DEMO = "docs/commands/demo.md"

#: Blocks that are not run with their page, by how they begin: .ci/run takes the first two from README.md and runs them
#: on clean copies of this repository; for what runs inside QGIS see `test_the_commands_for_qgis_run_there`.
ELSEWHERE = ("python3 -m venv .venv", "qgis_process run roadgeo:", "processing.run(")


class Places(UserDict):
    """A Nominatim that finds every place in the same few streets of Fenway."""

    def get(self, asked, default=None):
        return [place(asked, OUTLINE)]


@pytest.fixture(scope="session")
def demonstrated(tmp_path_factory):
    """The folder that the page of the demonstration makes, for pages that begin after it."""
    folder = tmp_path_factory.mktemp("demonstrated")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_page(PAGES[DEMO])
    return folder / "porto"


@pytest.fixture(scope="session")
def shelf(tmp_path_factory):
    """A folder with all that readers are told to have: stand-ins for files of their own."""
    folder = tmp_path_factory.mktemp("shelf")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_streets(folder / "massachusetts.osm.pbf")
        lines, highway, tunnel = streets()
        roads = gpd.GeoDataFrame({"highway": highway, "tunnel": tunnel}, geometry=lines, crs="EPSG:4326")
        roads.to_crs("EPSG:26986").to_file(folder / "streets.shp")
        roads.to_crs("EPSG:26986").to_file(folder / "streets.gpkg")
        (folder / "streets.prj").unlink()
        (folder / "more").mkdir()
        shutil.copy(folder / "massachusetts.osm.pbf", folder / "more")
        write_vector(folder / "outline.geojson", [OUTLINE])
        # Masks of the same streets stand for those that readers draw.
        index = ["index", "--roads", "massachusetts.osm.pbf", "--out", "city.gpkg", "--quiet"]
        view = ["--noise", "clean", "--size", "600", "--gsd", "1:1", "--intersections", "40:1000", "--count", "3"]
        assert main(index) == 0
        assert main(["simulate", "city.gpkg", "--out-dir", "drawn", "--quiet", *view]) == 0
        (folder / "drawn" / "clean").rename(folder / "masks")
        for name in ("photo_mask.tif", "photo_mask.png", "photo.tif", "photo.jpg"):
            shutil.copy(folder / "masks" / "q_0000.png", folder / name)
        shutil.copytree(folder / "masks", folder / "flight")
        shutil.rmtree("drawn")
    return folder


@pytest.fixture
def desk(shelf, tmp_path, monkeypatch):
    """A copy of the shelf to work in, with an empty library and a home of its own; no kernel is compiled anew."""
    folder = tmp_path / "desk"
    shutil.copytree(shelf, folder)
    kernels = kernel_folder()
    shutil.copytree(kernels, tmp_path / "roadgeo_cache" / kernels.name)  # within the fence of what is started
    for name in ("HOME", "XDG_DATA_HOME", "ROADGEO_CACHE", "ROADGEO_LIBRARY"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    (tmp_path / "home").mkdir()
    (tmp_path / "xdg_data_home/QGIS/QGIS3/profiles/surveys").mkdir(parents=True)
    monkeypatch.delenv("QGIS_CUSTOM_CONFIG_PATH", raising=False)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("page", PAGES)
def test_a_page_does_what_it_says(page: str, desk: Path, request: pytest.FixtureRequest) -> None:
    """Its blocks run in order in one folder, end as it says, print what it shows, and leave the files it names."""
    if page == DEMO:  # run once for all
        assert not documents.missing_files(PAGES[page], request.getfixturevalue("demonstrated").parent)
        return
    if re.search("roadgeo_demo|`roadgeo demo", PAGES[page]) and "\nroadgeo demo\n" not in PAGES[page]:
        shutil.copytree(request.getfixturevalue("demonstrated"), desk / "roadgeo_demo")
    left_out = {block.line for block in blocks(PAGES[page]) if block.text.startswith(ELSEWHERE)}
    with fake_osm() as osm:
        osm.places = Places()
        servers = ["--overpass-url", f"{osm.url}/api", "--nominatim-url", osm.url]
        run_page(PAGES[page], servers, left_out, figures=page == "docs/tutorial.md")
    assert not documents.missing_files(PAGES[page], desk)


def test_pages_name_only_commands_and_options_that_exist() -> None:
    wrong = {page: documents.unknown_names(text) for page, text in PAGES.items()}
    assert not {page: names for page, names in wrong.items() if names}


def test_links_and_pictures_lead_somewhere() -> None:
    broken = {path: documents.broken_links(path, path.read_text(encoding="utf-8")) for path in LINKING}
    assert not {path: links for path, links in broken.items() if links}


def test_every_page_can_be_reached() -> None:
    """From the README, by links."""
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page in reached or page.suffix != ".md":
            continue
        reached.add(page)
        links = re.findall(r"\]\(([^)\s#]+)", documents.prose(page.read_text(encoding="utf-8")))
        waiting += [(page.parent / link).resolve() for link in links if not link.startswith("https:")]
    assert {ROOT / page for page in PAGES} <= reached


def test_every_command_has_a_page() -> None:
    from roadgeo.cli import COMMANDS

    titles = " ".join(text.splitlines()[0] for page, text in PAGES.items() if page.startswith("docs/commands/"))
    assert set(re.findall(r"\w+", titles)) >= set(COMMANDS)


def test_the_figure_is_what_its_program_draws(tmp_path: Path) -> None:
    """But for the type faces and the rasterizer of this machine."""
    pytest.importorskip("matplotlib")
    shutil.copy(ROOT / "docs" / "draw_how_it_works.py", tmp_path)
    subprocess.run([sys.executable, "-W", "error", "draw_how_it_works.py"], cwd=tmp_path, check=True)
    drawn, kept = (cv2.imread(str(folder / "how-it-works.png")) for folder in (tmp_path, ROOT / "docs"))
    assert drawn.shape == kept.shape
    assert np.abs(cv2.blur(drawn, (25, 25)).astype(int) - cv2.blur(kept, (25, 25))).mean() < 3


def elsewhere() -> list[tuple[str, str]]:
    """Page and text of the blocks that `test_a_page_does_what_it_says` leaves out."""
    found = [(page, block.text) for page, text in PAGES.items() for block in blocks(text)]
    return [(page, text) for page, text in found if text.startswith(ELSEWHERE)]


def test_only_what_is_said_to_runs_elsewhere() -> None:
    assert [page for page, _ in elsewhere()] == ["README.md"] * 2 + ["docs/qgis.md"] * 2
    commands = {text for page, text in elsewhere() if page == "README.md"}
    first = [block.text for block in blocks(README)][:2]
    assert commands == set(first)  # the first two blocks: those that .ci/run takes


def test_the_commands_for_qgis_run_there(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = find_qgis()
    if found is None:
        if os.environ.get("ROADGEO_REQUIRE_QGIS"):
            pytest.fail("ROADGEO_REQUIRE_QGIS is set, and QGIS is not installed")
        pytest.skip("QGIS is not installed")
    monkeypatch.setenv("QGIS_CUSTOM_CONFIG_PATH", str(desk / "config"))
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    assert main(["qgis", "install"]) == 0
    shell, script = (text for page, text in elsewhere() if page == "docs/qgis.md")
    functions = f'qgis_process() {{ "{found[0]}" "$@"; }}; set -e\n'
    done = subprocess.run(["bash", "-c", functions + shell], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "STATUS:\tlocated" in done.stdout
    assert (desk / "found" / "photo_mask_location.gpkg").exists()
    assert (desk / "seen" / "photo_mask_vectorized.gpkg").exists()
    # The call from Python asks for the same.
    for name, value in re.findall(r'"([A-Z_]+)": "([^"]+)"', script):
        assert f"{name}={value}" in shell


def test_the_first_screen_holds_a_picture_and_two_commands() -> None:
    """One sets up and shows the main job, one sets up and tests; nothing more is asked of a newcomer."""
    first, second = [block.text for block in blocks(README) if block.language == "bash"][:2]
    picture = re.search(r"!\[.*\]\((.*\.(?:png|jpg))\)", README)
    assert picture is not None
    assert (ROOT / picture[1]).stat().st_size < 300_000
    assert README[: README.index(second)].count("\n") < 30
    for block, last in ((first, "roadgeo demo"), (second, "pytest")):
        assert block.count("\n") == 1
        assert block.startswith("python3 -m venv .venv && .venv/bin/pip install ")
        assert block.rstrip().endswith(f".venv/bin/{last}")


# --- and these checks can fail ----------------------------------------------------------------------------------------

GOOD = (
    "```bash\nroadgeo vectorize photo_mask.png --out-dir seen\nls seen\n```\n```text\nphoto_mask_vectorized.png\n```\n"
)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("photo_mask.png --out-dir", "no_such.png --out-dir"),
        ("--out-dir", "--outdir"),
        ("vectorize", "vectorise"),
        ("ls seen", "ls unseen"),
        ("ls seen", "ls seen  # status 2"),
        ("_vectorized.png\n", "_vectors.png\n"),
        ("ls seen\n```\n", "ls seen\n```\n```python\nraise SystemError\n```\n"),
    ],
)
def test_a_page_with_a_mistake_fails(old: str, new: str, desk: Path) -> None:
    assert old in GOOD
    with pytest.raises((AssertionError, SystemError)):
        run_page(GOOD.replace(old, new))
