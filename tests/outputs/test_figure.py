import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from outputs.test_location_files import located, road_mask
from outputs.test_overlay import map_roads, subject

from roadgeo.errors import OutputError
from roadgeo.outputs.figure import draw_figure, write_figure

pytest.importorskip("matplotlib")


def test_everything_is_drawn_to_scale() -> None:
    figure = draw_figure(located(), road_mask(), map_roads(), "© OpenStreetMap contributors")
    left, right = figure.axes
    height, width = road_mask().shape
    assert (left.get_xlim(), left.get_ylim()) == ((0, width), (height, 0))
    assert left.images[0].get_array().shape == (height, width)
    assert right.get_aspect() == 1
    low = located().footprint.min(axis=0)
    margin = 0.12 * np.ptp(located().footprint, axis=0).max()
    outline = next(line for line in right.lines if line.get_label() == "footprint").get_xydata()
    np.testing.assert_allclose(outline[:4] * 1e3 + low - margin, located().footprint)
    roads, query = (one.get_segments() for one in right.collections)
    assert len(roads) == 2  # the one far away is left out
    np.testing.assert_allclose(np.concatenate(roads)[0] * 1e3 + low - margin, map_roads()[0, :2])
    assert len(query) == located().evidence.query_graph.n_edges
    assert "OpenStreetMap" in right.texts[0].get_text()


@pytest.mark.parametrize(("kind", "magic"), [("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG")])
def test_it_is_written_as_the_name_tells(tmp_path: Path, kind: str, magic: bytes) -> None:
    path = tmp_path / f"a.{kind}"
    write_figure(path, subject())
    assert path.read_bytes().startswith(magic)
    if kind == "png":
        assert cv2.imread(str(path)).shape[:2] == (1176, 2100)


def test_what_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OutputError, match="no place"):
        draw_figure(replace(located(), homography=None), road_mask(), map_roads())
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(OutputError, match=r"-m pip install matplotlib"):
        write_figure(tmp_path / "a.pdf", subject())
