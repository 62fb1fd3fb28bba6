"""What `--truth` takes: a place, a table, nothing without `--explain`."""

from pathlib import Path

import click
import pytest

from roadgeo.cli.truths import read_truths

TABLE = """file,kind,width,height,crs,h00,h01,h02,h10,h11,h12,h20,h21,h22
clean/q_0.png,clean,1000,1000,EPSG:32631,1,0,499500,0,-1,5000500,0,0,1
"""


def test_a_place_holds_for_every_mask():
    assert read_truths("-8.6,41.1", explain=True) == (("", -8.6, 41.1),)
    assert read_truths(None, explain=False) == ()


def test_a_table_tells_each_mask_its_middle(tmp_path: Path):
    (tmp_path / "truth.csv").write_text(TABLE)
    ((name, lon, lat),) = read_truths(str(tmp_path / "truth.csv"), explain=True)
    assert name == "clean/q_0.png"
    assert lon == pytest.approx(3.0, abs=1e-6)
    assert lat == pytest.approx(45.155, abs=0.01)


@pytest.mark.parametrize("given", ["here", "1,2,3", "200,10", "10,95", "1"])
def test_what_is_no_place_is_refused_in_a_line(given: str):
    with pytest.raises(click.UsageError, match="expected LON,LAT in degrees"):
        read_truths(given, explain=True)


def test_it_needs_explain():
    with pytest.raises(click.UsageError, match="add it"):
        read_truths("1,2", explain=False)
