"""Numbers that pages take from the code, or from another page, are those that stand there."""

import csv
import re

import numpy as np
import pytest
from support.documents import ROOT

from roadgeo.geometry.camera import CameraOptions
from roadgeo.kernels.road_rings import BEARINGS, RINGS
from roadgeo.location import ERROR_RATES
from roadgeo.matching import evidence, picture, rivals, triples, verdict, veto
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.paper import PairOptions
from roadgeo.matching.search import SearchOptions
from roadgeo.roads.intersections import IntersectionOptions

CAMERA, PAIR, TANGENT = CameraOptions(), PairOptions(), IntersectionOptions()
NEEDED = LocateOptions().min_log10_odds
WORDS = {"half": 0.5, "a tenth": 0.1, "two thirds": 0.67, "four": 4, "eight": 8, "ten": 10}
SECTION_8 = "docs/how-it-works.md"

#: Page; what it says, with a group for each number; the numbers in the code.
FROM_CODE = [
    ("docs/how-it-works.md", r"with a tolerance of (\w+) degrees", triples.TripleOptions().angle_tolerance_deg),
    ("docs/how-it-works.md", r"are (\d+) rings of (\d+) bits", (RINGS, BEARINGS)),
    ("docs/how-it-works.md", r"piece of about ([\d,]+) intersections", triples._USUAL_SIZE),
    ("docs/how-it-works.md", r"so (\d+) m of road count as one", evidence.STATEMENT_M),
    (SECTION_8, r"within (\d+) km that most of the roads", rivals._AROUND.reach_m / 1000.0),
    (SECTION_8, r"and (two thirds) of the roads met there", rivals._SAME),
    (SECTION_8, r"cut into pieces of (\d+) m", evidence._PIECE_M),
    (SECTION_8, r"next `n` places lie, (\d+) at most", rivals._TAIL),
    (SECTION_8, r"\*\*contradiction\*\*: (\d+) times the share", rivals._DOUBT),
    (SECTION_8, r"less than (a tenth) as much as it does elsewhere", evidence._HARDLY),
    (SECTION_8, r"of `n / ([\d,]+)` intersections", triples._USUAL_SIZE),
    (SECTION_8, r"traced roads is below (\d+), the picture is asked", rivals._CERTAIN),
    (SECTION_8, r"over the (\d+) m around is `pi`", picture._USUAL_M),
    (SECTION_8, r"(\d+) m of road count as one statement", picture._STATEMENT_M),
    (SECTION_8, r"within (\d+) km, in (\w+) turns", (rivals._REACHES_M[-1] / 1000.0, len(rivals._TURNS_DEG))),
    (
        SECTION_8,
        r"So beyond 10\^(\d+) the lead is (\d+) times the part",
        (picture._MOST_LIKELIHOOD, picture._MOST_LIKELIHOOD),
    ),
    (SECTION_8, r"and (half) of the lesser one", rivals._AGREEING),
    (SECTION_8, r"or the blocks beside it, by 10\^(\d+) is", rivals._CERTAIN),
    (SECTION_8, r"met is less than (half) of the score needed", rivals._MAY_LEAD),
    (SECTION_8, r"by traced roads and by 10\^([\d.]+),", veto._MORE),
    (SECTION_8, r"Two places agree with (\d+) % of the roads", round(100 * verdict._LIKE_THE_TRUTH)),
    (SECTION_8, r"A lead of 10\^([\d.]+) or more", NEEDED),
    ("docs/faq.md", r"A place is reported from ([\d.]+) on", NEEDED),
    ("docs/faq.md", r"a quarter turn, within (\d+) km", rivals._AROUND.reach_m / 1000.0),
    (
        "docs/faq.md",
        r"below ([\d.]+) or above (\d+) m \(`--gsd`\), more than (\d+) degrees",
        (*CAMERA.gsd_m, CAMERA.max_tilt_deg),
    ),
    ("docs/commands/locate.md", r"Needed below ([\d.]+) and above (\d+) ", CAMERA.gsd_m),
    ("docs/glossary.md", r"its score is ([\d.]+) or more", NEEDED),
    ("docs/scale.md", r"map of more than ([\d,]+) intersections a place also", triples._USUAL_SIZE),
    ("docs/commands/locate.md", r"`--max-tilt 20` \| the default is (\d+)", CAMERA.max_tilt_deg),
    ("docs/commands/locate.md", r"some (\w+) seconds of a usual machine at most", SearchOptions().work_limit_s),
    ("docs/how-well.md", r"\| ([\d.]+) to 5 \|", NEEDED),
    ("docs/paper.md", r"are fitted at (\d+) to (\d+) m", (TANGENT.skip_length, TANGENT.tangent_length)),
    ("docs/paper.md", r"first `n_px` = (\d+) pixels", PAIR.n_px),
    ("docs/paper.md", r"average error ([\d.]+) pixels", PAIR.fit_error_px),
    ("docs/paper.md", r"The center moves (\d+) m at most", TANGENT.max_shift),
    ("docs/paper.md", r"lines within (\d+)° are one tangent", TANGENT.merge_angle_deg),
    ("docs/paper.md", r"`delta` = ([\d.]+)", PAIR.delta),
    ("docs/paper.md", r"`delta_angle_deg` = (\d+)", PAIR.delta_angle_deg),
    ("docs/paper.md", r"`d_max_m` = ([\d,]+)", PAIR.d_max_m),
    ("docs/paper.md", r"`inlier_distance_m` = (\d+)", PAIR.inlier_distance_m),
    ("docs/paper.md", r"as stated, ([\d.]+), of at least `min_intersections` = (\d+)", (PAIR.delta_inlier, 30)),
    (
        "docs/paper.md",
        r"`lambda` = ([\d.]+), `lambda_1` = ([\d.]+) and `p_query` = ([\d.]+)",
        (PAIR.lambda_, PAIR.lambda_1, PAIR.p_query),
    ),
    ("docs/paper.md", r"also ends after (\d+) s of counted work", PAIR.work_limit_s),
]

#: Page; what it says; what another page says, whose numbers are the same.
FROM_PAGES = [
    ("README.md", r"steep views \| (\d+) of (\d+) \| 0 \|", "docs/how-well.md", r"(\d+) of (\d+) masks are located"),
    ("README.md", r"\| ([\d,]+) of ([\d,]+) \| 3 \|", "docs/how-well.md", r"full effort locates ([\d,]+) of ([\d,]+)"),
    (
        "README.md",
        r"data \| (\d+) of (\d+) \((\d+) to (\d+) %\)",
        "docs/how-well.md",
        r"blind \| (\d+) of (\d+) \((\d+) to (\d+) %\)",
    ),
    ("README.md", r"(\w+) of ([\d,]+) masks without", "docs/how-well.md", r"\*\*(\w+) of ([\d,]+) masks without"),
    ("README.md", r"later and ([\d.]+) GB of disk", "docs/install.md", r"It takes about ([\d.]+) GB of disk"),
]


def said(page: str, sentence: str) -> tuple[str, ...]:
    """Return the groups of a pattern on a page, whose lines are joined."""
    found = re.search(sentence, " ".join((ROOT / page).read_text(encoding="utf-8").split()))
    assert found, f"{page} no longer says: {sentence}"
    return found.groups()


def value(text: str) -> float:
    """Return the number that a text is, in digits or a word."""
    return WORDS[text] if text in WORDS else float(text.replace(",", ""))


#: A command of this repository, or a folder of its examples that keeps results.
SOURCE = re.compile(r"`roadgeo \w+|`python\s+examples/|\]\((\.\./)?examples/|`examples/\w")


def parts(page: str, mark: str) -> dict[str, str]:
    """Return the parts of a page by their first lines; each begins with a mark."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.split(rf"^{mark}", text, flags=re.MULTILINE)[1:]
    return {part.splitlines()[0]: part for part in found}


def anchor(heading: str) -> str:
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def has_number(text: str) -> bool:
    """Whether a text states a number, beside those in code, links and comments."""
    return bool(re.search(r"\d", re.sub(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->", "", text)))


def test_a_section_with_numbers_names_the_command_or_the_results_that_they_come_from():
    sections = parts("docs/how-well.md", "## ")
    assert [name for name, text in sections.items() if has_number(text) and not SOURCE.search(text)] == []


def test_a_number_of_the_readme_leads_to_the_section_that_it_comes_from():
    how_well = parts("README.md", "## ")["How well"].replace("The range is a 95 % interval.", "")
    known = [f"](docs/how-well.md#{anchor(name)})" for name in parts("docs/how-well.md", "## ")]
    *rows, text = [block for block in re.split(r"\n(?=\|)|\n\n", how_well) if block.strip()]
    said = [one for one in [*rows, *re.split(r"\.\s", text)] if has_number(one)]
    assert [one for one in said if not any(link in one for link in known)] == []


def test_pages_state_the_numbers_of_the_code():
    stated = {(page, sentence): [value(text) for text in said(page, sentence)] for page, sentence, _ in FROM_CODE}
    known = {(page, sentence): list(np.atleast_1d(numbers)) for page, sentence, numbers in FROM_CODE}
    assert stated == known


def test_pages_state_the_numbers_of_other_pages():
    stated = [(said(page, sentence), said(source, there)) for page, sentence, source, there in FROM_PAGES]
    assert [here for here, _ in stated] == [there for _, there in stated]


def test_the_page_of_verify_counts_its_kept_results():
    with (ROOT / "examples/verify/results/grids_seed77.csv").open(newline="") as file:
        rows = [(float(row["off_m"]), row["verdict"]) for row in csv.DictReader(file)]
    near = [verdict for off_m, verdict in rows if 0.0 <= off_m <= 100.0]
    far = [verdict for off_m, verdict in rows if off_m >= 500.0]
    counted = len(far), len(near) - near.count("unknown"), len(near), set(far)
    none_of, *judged = said(
        "docs/commands/verify.md", r"none of (\d+) is judged. 0, 30 and 100 m off (\d+) of (\d+) are judged"
    )
    assert (int(none_of), *map(int, judged), {"unknown"}) == counted


def test_the_table_of_error_rates_is_that_of_results():
    text = (ROOT / "docs/how-well.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\d.]+) (?:to|and).*\| ([\d,]+) \| (\d+) \(at most ([\d.]+) %\) \|$", text, re.MULTILINE)
    assert [tuple(map(value, row)) for row in rows] == [
        (rate.score, rate.reported, rate.wrong, pytest.approx(100.0 * rate.at_most, rel=0.02)) for rate in ERROR_RATES
    ]
