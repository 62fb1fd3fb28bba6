"""QGIS with the plugin installed, and a reference that it built."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.real_qgis import Qgis, find_qgis

from roadgeo.cli import main
from roadgeo.evaluation.demo import ROADS


@pytest.fixture(scope="session")
def qgis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Qgis]:
    found = find_qgis()
    if found is None:
        if os.environ.get("ROADGEO_REQUIRE_QGIS"):
            pytest.fail("ROADGEO_REQUIRE_QGIS is set, and QGIS is not installed")
        pytest.skip("QGIS is not installed (Debian: qgis python3-qgis qgis-providers)")
    folder = tmp_path_factory.mktemp("qgis")
    runtime = folder / "runtime"
    runtime.mkdir(mode=0o700)
    kept = {
        name: os.environ[name]
        for name in ("PATH", "HOME", "NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS")
        if name in os.environ
    }
    own = {
        "QGIS_CUSTOM_CONFIG_PATH": str(folder / "config"),
        "QT_QPA_PLATFORM": "offscreen",
        "XDG_RUNTIME_DIR": str(runtime),
        "ROADGEO_LIBRARY": str(folder / "library"),
        "LANG": "C.UTF-8",
        "PYTHONPATH": "/nowhere",  # what QGIS may set and roadgeo must not see
        "PROJ_LIB": "/usr/share/proj",
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("QGIS_CUSTOM_CONFIG_PATH", own["QGIS_CUSTOM_CONFIG_PATH"])
        assert main(["qgis", "install"]) == 0
    started = Qgis(*found, folder, {**kept, **own})
    yield started
    started.close()


@pytest.fixture(scope="session")
def porto(qgis: Qgis) -> Path:
    """The reference that *Build road reference* makes."""
    path = qgis.folder / "porto.gpkg"
    done = qgis.run("buildreference", ROADS=ROADS, KINDS="all", OUTPUT=path)
    assert done["results"]["OUTPUT"] == str(path)
    assert path.with_suffix(".index").exists()
    return path
