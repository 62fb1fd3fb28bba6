"""The HTML report of an evaluation."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from roadgeo.evaluation.report import render_report
from roadgeo.evaluation.scoring import evaluate
from roadgeo.evaluation.truth import Truth


def truth(k, on_map=True):
    matrix = np.array([[1.0, 0.0, 330000.0 + 100 * k], [0.0, -1.0, 4690000.0], [0.0, 0.0, 1.0]])
    properties = {"n_intersections": 10.0 * k, "tilt_deg": 3.0 * k}
    return Truth(f"q_{k}.png", "clean" if k % 2 else "<poor>", matrix, "EPSG:32619", (1000, 800), on_map, properties)


def answer(k, status="located"):
    return {
        "status": status,
        "crs": "EPSG:32619",
        "size": [1000, 800],
        "homography": truth(k).homography.tolist(),
        "corner_sigma_m": [1.0] * 4,
        "log10_odds": 7.5,
        "seconds": {"match": 0.02},
    }


@pytest.mark.parametrize("n", [0, 1, 12])
def test_a_report_is_one_well_formed_page(n):
    truths = [truth(k, on_map=k != 3) for k in range(n)]
    answers = [answer(k, "ambiguous" if k == 2 else "located") if k != 4 else None for k in range(n)]
    page = render_report(evaluate(truths, answers, {"seed": 1}), truths, "Boston & <more>")
    xml = re.sub(r"<meta [^>]*>|<!DOCTYPE html>", "", page)
    root = ET.fromstring(xml)
    assert root.find("body/main/h1").text == "Boston & <more>"
    assert "http" not in page
    assert "nan" not in page
    assert len(root.findall(".//polygon")) == sum(t.on_map for t in truths)


def test_charts_show_what_tables_say():
    truths = [truth(k) for k in range(12)]
    page = render_report(evaluate(truths, [answer(k) for k in range(12)]), truths, "all right")
    assert page.count("<figure>") == 3 + 5
    assert "No count contradicts the odds." in page
    assert "Tilt of the camera, degrees" in page


def test_masks_that_were_lost_are_named():
    truths = [truth(k, on_map=k != 3) for k in range(5)]
    answers = [answer(0), None, {**answer(2), "status": "ambiguous", "reason": "two <places>"}, answer(3), answer(4)]
    page = render_report(evaluate(truths, answers, {"gsd": (0.7, 1.4), "intersections": (30, 1_000_000)}), truths, "t")
    table = page[page.index("Masks that were lost") : page.index("Charts")]
    assert re.findall(r"<td>(q_\d.png)</td><td>([a-z ]+)</td>", table) == [
        ("q_3.png", "wrong"),
        ("q_2.png", "ambiguous"),
        ("q_1.png", "not located"),
    ]
    assert "two &lt;places&gt;" in table
    assert "gsd 0.7 to 1.4, intersections 30 or more" in page
    assert "<title>q_2.png: ambiguous</title>" in page
