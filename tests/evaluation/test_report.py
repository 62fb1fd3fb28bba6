"""The HTML report of an evaluation."""

import csv
import io
import re
from dataclasses import replace

import numpy as np
import pytest
from outputs.test_report_pages import Reader

from roadgeo.evaluation.report import masks_to_csv, render_report
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
        "error_rate": {"kind": "mask", "score": 5.0, "at_most": 0.154},
        "seconds": {"match": 0.02},
    }


@pytest.mark.parametrize("n", [0, 1, 12])
def test_a_report_is_one_well_formed_page(n):
    truths = [truth(k, on_map=k != 3) for k in range(n)]
    answers = [answer(k, "ambiguous" if k == 2 else "located") if k != 4 else None for k in range(n)]
    evaluation = evaluate(truths, answers, {"seed": 1})
    page = render_report(evaluation, truths, "Boston & <more>")
    read = Reader(page)
    assert read.open == []
    assert "Boston & <more>" in read.text
    assert "nan" not in read.text
    rings = re.findall(r'<path d="M[^"]*z"><title>', page)
    assert len(rings) == sum(t.on_map for t in truths)
    rows = list(csv.DictReader(io.StringIO(masks_to_csv(evaluation))))
    assert [row["file"] for row in rows] == [t.file for t in truths]


def test_tables_and_verdicts_are_shown(town):
    truths = [replace(truth(k), crs=town[1].plane.crs) for k in range(12)]
    answers = [{**answer(k), "crs": town[1].plane.crs} for k in range(12)]
    page = render_report(evaluate(truths, answers), truths, "all right", [town[1]])
    assert "no count contradicts their error rates" in page
    assert "Tilt of the camera, degrees" in page
    assert '<g class="map-roads">' in page


def test_masks_that_were_lost_are_named():
    truths = [truth(k, on_map=k != 3) for k in range(5)]
    answers = [answer(0), None, {**answer(2), "status": "ambiguous", "reason": "two <places>"}, answer(3), answer(4)]
    page = render_report(evaluate(truths, answers, {"gsd": (0.7, 1.4), "intersections": (30, 1_000_000)}), truths, "t")
    table = page[page.index("Masks that were lost") :]
    assert re.findall(r"<td>(q_\d.png)</td><td>([a-z ]+)</td>", table) == [
        ("q_3.png", "wrong"),
        ("q_2.png", "ambiguous"),
        ("q_1.png", "not located"),
    ]
    assert "two &lt;places&gt;" in table
    assert "gsd 0.7 to 1.4, intersections 30 or more" in page
    assert "<title>q_2.png: ambiguous</title>" in page
