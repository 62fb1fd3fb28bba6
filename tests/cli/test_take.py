"""A refusal lists the best places, and `--take N` writes the N-th as one that the user chose."""

import json
from pathlib import Path

import numpy as np
import pytest
from worlds.demo import MASKS

import roadgeo
from roadgeo.cli import main
from roadgeo.errors import NotLocatedError
from roadgeo.evaluation import scoring
from roadgeo.evaluation.truth import Truth
from roadgeo.outputs.wording import format_lonlat

PATHS = {name: str(mask.path) for name, mask in MASKS.items()}
LOCATE = ["locate", PATHS["elsewhere"], "--effort", "quick"]


@pytest.fixture(scope="module")
def refused(porto: Path) -> roadgeo.Location:
    """The demonstration's mask of another city."""
    return roadgeo.locate(PATHS["elsewhere"], str(porto), effort="quick")


def test_a_refusal_lists_distinct_places_with_footprints_the_best_first(refused):
    places = refused.to_dict()["alternatives"]
    assert (refused.status, refused.center) == ("not_located", None)
    assert 1 < len(places) <= 5
    scores = [place["log10_odds"] for place in places]
    assert scores[1:] == sorted(scores[1:], reverse=True)
    assert scores[0] == refused.log10_odds
    middles = np.array([[place["center"]["x"], place["center"]["y"]] for place in places])
    apart = np.hypot(*(middles[:, None] - middles[None]).transpose(2, 0, 1))
    assert apart[np.triu_indices(len(places), 1)].min() > 50.0
    for place in places:
        corners = np.array(place["footprint_lonlat"])
        assert corners.shape == (4, 2)
        assert np.abs(corners.mean(axis=0) - (place["center"]["lon"], place["center"]["lat"])).max() < 0.02


def test_a_refusal_shows_the_places_by_their_numbers(porto, refused, capfd):
    assert main([*LOCATE, "-r", str(porto)]) == 3
    said = capfd.readouterr().out
    assert "\n  best places; where you know one to be right, --take its number:\n    1: " in said
    second = refused.alternatives[1]
    assert f"\n    2: {format_lonlat(*second.center[2:])} on porto, score {second.score:z.1f}\n    3: " in said


@pytest.mark.parametrize("n", [1, 2])
def test_a_listed_place_is_taken_and_the_result_says_so(porto, refused, n, capfd):
    assert main([*LOCATE, "-r", str(porto), "--take", str(n), "--report"]) == 0
    assert "elsewhere.png: chosen at" in capfd.readouterr().out
    written = {path.name for path in Path().iterdir()}
    assert {"elsewhere_footprint.tif", "elsewhere_location.gpkg", "elsewhere_report.html"} <= written
    found, listed = json.loads(Path("elsewhere_location.json").read_text()), refused.alternatives
    assert (found["status"], found["reason_code"], found["error_rate"]) == ("chosen", "chosen", None)
    score = min(listed[n - 1].score, listed[0].score)
    assert found["log10_odds"] == pytest.approx(score)
    assert found["reason"] == (
        f"chosen by you: place {n} of {len(listed)}; the score is {score:z.1f}, 3.5 is asked for"
    )
    off = np.array(found["footprint_lonlat"]) - listed[n - 1].footprint_lonlat
    assert np.abs(off).max() < 0.001
    others = [place["center"]["lon"] for place in found["alternatives"]]
    assert others == [place.center.lon for place in listed if place is not listed[n - 1]]
    assert found["command"].count("--take") == 1


@pytest.fixture
def answered(porto, monkeypatch, capfd):
    """An answer lies in the folder; whoever searches from here on fails."""
    assert main([*LOCATE, "-r", str(porto)]) == 3
    capfd.readouterr()

    def fail(*_, **__):
        raise AssertionError("searched again")

    monkeypatch.setattr("roadgeo.workflows.search_references", fail)
    return json.loads(Path("elsewhere_location.json").read_text())["alternatives"]


def test_taking_a_place_of_an_answer_searches_nothing(answered, porto, capfd):
    assert main([*LOCATE, "-r", str(porto), "--take", "2"]) == 0
    assert capfd.readouterr().err == ""
    taken = json.loads(Path("elsewhere_location.json").read_text())
    assert taken["status"] == "chosen"
    assert np.allclose(taken["homography"], answered[1]["homography"], rtol=1e-9)
    assert np.allclose(taken["corner_covariance_m2"], answered[1]["corner_covariance_m2"], rtol=1e-6)
    assert min(taken["corner_sigma_m"]) > 0.0
    assert taken["n_matched"] > 0  # matched anew, on the map that is named
    assert {"elsewhere_footprint.tif", "elsewhere_location.gpkg"} <= {path.name for path in Path().iterdir()}


def test_the_listed_place_nearest_to_a_point_is_taken(answered, porto):
    lon, lat = answered[2]["center"]["lon"], answered[2]["center"]["lat"]
    assert main([*LOCATE, "-r", str(porto), "--take", f"{lon:.5f},{lat:.5f}"]) == 0
    taken = json.loads(Path("elsewhere_location.json").read_text())
    assert taken["center"]["lon"] == pytest.approx(lon, abs=1e-5)
    assert taken["reason"].startswith("chosen by you: place 3 of ")
    assert main([*LOCATE, "-r", str(porto), "--take", f"{lon + 1.0:.5f},{lat:.5f}"]) == 1


def test_without_an_answer_it_is_searched_first_which_is_said(porto, caplog):
    assert main([*LOCATE, "-r", str(porto), "--take", "1"]) == 0
    assert "no earlier answer lies in .: searching first" in caplog.text


def test_a_missing_image_is_no_reason_to_search(porto, caplog, capfd):
    assert main(["locate", "missing.png", "-r", str(porto), "--take", "2"]) == 1
    assert "missing.png: no such file" in capfd.readouterr().err
    assert "searching first" not in caplog.text


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "nowhere", "200,10", "1,2,3"])
def test_what_is_no_place_is_a_usage_error(text, porto, capfd):
    assert main([*LOCATE, "-r", str(porto), "--take", text]) == 2
    assert "expected the number of a place, from 1, or LON,LAT near it" in capfd.readouterr().err


def test_an_answer_in_python_gives_its_places(refused):
    taken = refused.take(2)
    assert (taken.status, len(taken.places)) == ("chosen", len(refused.places))
    assert taken.center == refused.places[1].center
    near = refused.take((refused.places[2].center.lon, refused.places[2].center.lat))
    assert near.center == refused.places[2].center
    assert taken.write("taken")


def test_a_place_that_is_not_listed_cannot_be_taken(porto, refused, capfd):
    assert main([*LOCATE, "-r", str(porto), "--take", "9"]) == 1
    err = capfd.readouterr().err
    assert f"there is no place 9: {len(refused.alternatives)} are listed" in err
    assert len(err.strip().splitlines()) == 1
    assert not list(Path().glob("*_footprint.tif"))
    assert main([*LOCATE, "-r", str(porto), "--take", "0"]) == 2


def test_a_located_mask_stays_located(porto):
    usual, taken = (roadgeo.locate(PATHS["drone"], str(porto), take=take) for take in (None, 1))
    assert (taken.status, taken.reason) == ("located", usual.reason)
    assert taken.center == usual.center


def test_python_takes_a_place_too(porto, refused):
    taken = roadgeo.locate(PATHS["elsewhere"], str(porto), effort="quick", take=2)
    assert (taken.status, taken.located, taken.error_rate) == ("chosen", False, None)
    assert taken.to_xarray().shape
    with pytest.raises(NotLocatedError, match="there is no place 9"):
        roadgeo.locate(PATHS["elsewhere"], str(porto), effort="quick", take=9)
    with pytest.raises(ValueError, match="take"):
        roadgeo.locate(PATHS["elsewhere"], str(porto), effort="quick", take=0)


def test_a_chosen_place_does_not_count_as_located(porto):
    taken = roadgeo.locate(PATHS["elsewhere"], str(porto), effort="quick", take=1)
    truth = Truth("elsewhere.png", "no place", taken.homography, taken.crs, taken.size, on_map=False)
    assert not scoring.score(truth, taken.to_dict()).located


def test_the_report_of_a_refusal_names_the_places_and_the_option(porto, refused):
    assert main([*LOCATE, "-r", str(porto), "--report"]) == 3
    page = Path("elsewhere_report.html").read_text()
    assert "--take N" in page
    for place in refused.alternatives:
        assert f"{place.center.lat:.5f}" in page
