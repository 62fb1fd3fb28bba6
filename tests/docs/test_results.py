"""Numbers that pages take from results are those of the results that are kept; others stand beside their command."""

import csv
import json
import re
from statistics import median

import numpy as np
import pytest
from docs.test_numbers import FROM_CODE
from support.documents import ROOT, prose, said, value

from roadgeo.evaluation.scoring import share
from roadgeo.location import ERROR_RATES
from roadgeo.matching.options import LocateOptions

NEEDED = LocateOptions().min_log10_odds


def kept(path):
    """Return the rows of kept results."""
    with (ROOT / "examples" / path).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def is_right(row):
    return float(row["score"]) >= NEEDED and row["right"] == "1"


def digits(number, most=2):
    """Return a number of so many digits."""
    return float(f"{number:.{most}g}")


FULL, QUICK = kept("trust/results/full_seeds7731-9731.csv"), kept("trust/results/quick_seeds9100-9401.csv")
ABSENT = [row for row in (*FULL, *QUICK) if row["kind"] != "there"]
FOUND = sorted(float(row["score"]) for row in ABSENT)
ABOVE = share(sum(found >= NEEDED for found in FOUND), len(FOUND))
THERE = {name: [row for row in rows if row["kind"] == "there"] for name, rows in (("full", FULL), ("quick", QUICK))}
FLIGHTS, VERIFIED, PHOTOGRAPHS = (
    kept(f"{name}.csv")
    for name in ("results/faulty_flights", "verify/results/grids_seed77", "photographs/results/photographs")
)
COST = {row["what"]: row for row in kept("scale/results/cost.csv")}
FIGURE_7, FIGURE_8 = (
    json.loads((ROOT / f"examples/paper/results/boston/figure{number}.json").read_text(encoding="utf-8"))
    for number in (7, 8)
)
OF_TYPES = [of_type["tuples"] for of_type in FIGURE_7["types"]]
BESIDE = [row for row in VERIFIED if 0.0 <= float(row["off_m"]) <= 100.0]


def worn_seconds():
    """Return the least and the greatest median of the seconds of worn masks that are located rightly."""
    rows = [(effort, row) for effort, listed in THERE.items() for row in listed if is_right(row)]
    kinds = {(effort, row["worn"]) for effort, row in rows}
    medians = [np.nanmedian([float(row["seconds"]) for e, row in rows if (e, row["worn"]) == kind]) for kind in kinds]
    return round(min(medians), 2), round(max(medians), 1)


def photographs(name):
    """Count the photographs of a kind, and those of them that are located blind and told."""
    modes = [[row for row in PHOTOGRAPHS if row["mode"] == mode and name in row["file"]] for mode in ("blind", "told")]
    return len(modes[0]), *(sum(row["right"] == "1" for row in rows) for rows in modes)


def frame_seconds():
    """Return the least and the greatest seconds of frames of 512 m, located blind, and refused."""
    blind = [row for row in PHOTOGRAPHS if row["mode"] == "blind" and row["file"].startswith("lanes/")]
    seconds = [[float(row["cpu_s"]) for row in blind if row["right"] == right] for right in "10"]
    return [round(limit(some), 1) for some in seconds for limit in (min, max)]


def cost(name):
    """Return a row of the table of costs."""
    row = COST[name]
    masks = [int(row[key]) for key in ("located", "masks", "wrong")]
    return int(row["intersections"]), *masks, digits(float(row["median_s"])), digits(float(row["refusal_s"]))


def orders(noise):
    """Return the places that are right, of how many, and the hypotheses of those located, in both orders of drawing."""
    rows = [row for row in FIGURE_7["rarest_first"] if row["noise"] == noise]
    counts = [(row["recall"]["hits"], row["recall"]["of"], row["median_hypotheses_of_located"]) for row in rows]
    return [round(number) for row in counts for number in row]


def within(point):
    """Return the places that are right, of how many, those that are wrong, the share within 1 s, and the median."""
    hits, of = point["recall"]["hits"], point["recall"]["of"]
    return hits, of, point["located"] - hits, 100 * point["within_1_s"], round(np.sort(point["seconds"])[of // 2], 2)


ROW = r" \| ([\d,]+) \|[ \d]*\| (\d+) of (\d+); (\d+) \| ([\d.]+) s \| ([\d.]+) s \|"
#: Page; what it says, with a group for each number; the numbers of the results.
FROM_RESULTS = [
    ("docs/how-well.md", r"On the maps of (\d+) cities", len({row["city"] for row in FULL})),
    ("docs/how-well.md", r"([\d,]+) searches were made, ([\d,]+) with full", (len(FULL) + len(QUICK), len(FULL))),
    ("docs/how-well.md", r"\*\*(\w+) of ([\d,]+) masks without", (ABOVE.hits, ABOVE.of)),
    ("docs/how-well.md", r"with scores of ([\d.]+) and ([\d.]+):", [round(at, 1) for at in FOUND[:-3:-1]]),
    ("docs/how-well.md", r"All others: ([\d.]+) at most", round(FOUND[-3], 1)),
    (
        "docs/how-well.md",
        r"\(([\d.]+) %, at most ([\d.]+) %\)",
        [round(100 * at, 2) for at in (ABOVE.value, ABOVE.high)],
    ),
    (
        "docs/how-well.md",
        r"full effort locates ([\d,]+) of ([\d,]+) and quick effort (\d+) of (\d+)",
        [count for rows in THERE.values() for count in (sum(map(is_right, rows)), len(rows))],
    ),
    ("README.md", r"takes \[([\d.]+) to ([\d.]+) s\]", worn_seconds()),
    ("docs/faq.md", r"alone: \[([\d.]+) to ([\d.]+) s\]", worn_seconds()),
    ("docs/photographs.md", r"streets that wind \| (\d+) \| (\d+) \| (\d+)", photographs("boston")),
    ("docs/photographs.md", r"labelled lanes only \| (\d+) \| (\d+) \| (\d+)", photographs("miami")),
    ("docs/photographs.md", r"Berkeley \| (\d+) \| (\d+) \| (\d+)", photographs("berkeley")),
    ("docs/photographs.md", r"San Francisco \| (\d+) \| (\d+) \| (\d+)", photographs("sanfrancisco")),
    ("docs/photographs.md", r"South Africa \| (\d+) \| (\d+) \| (\d+)", photographs("rural")),
    (
        "docs/photographs.md",
        r"takes ([\d.]+) to ([\d.]+) s of one core blind, a refusal ([\d.]+) to ([\d.]+) s",
        frame_seconds(),
    ),
    ("docs/scale.md", "one city, mean of 20" + ROW, cost("one city (mean of 20)")),
    ("docs/scale.md", "a library of 20 cities" + ROW, cost("library of 20 cities")),
    ("docs/scale.md", "the atlas" + ROW, cost("atlas in shards")),
    ("docs/scale.md", "nine maps made of it" + ROW, cost("atlas and nine maps made of it")),
    (
        "docs/scale.md",
        r"built in (\d+) s, and takes (\d+) MB on disk",
        [int(COST["atlas in shards"][key]) for key in ("build_s", "disk_mb")],
    ),
    (
        "docs/scale.md",
        r"6\.8 s \| ([\d.]+) GB.* 24 s \| ([\d.]+) GB",
        [digits(int(COST[name]["memory_mb"]) / 1000) for name in ("atlas in shards", "atlas and nine maps made of it")],
    ),
    ("docs/paper.md", r"in ([\d.]+) s for the ([\d,]+) tuples", (round(FIGURE_7["build_s"], 1), sum(OF_TYPES))),
    ("examples/paper/README.md", r"built in ([\d.]+) s", round(FIGURE_7["build_s"], 1)),
    ("examples/paper/README.md", r"square has ([\d,]+) tuples of (\d+) types", (sum(OF_TYPES), len(OF_TYPES))),
    (
        "examples/paper/README.md",
        r"hold (\d+) %, four hold (\d+) %, and (\d+) types have fewer",
        (*(round(100 * sum(OF_TYPES[:most]) / sum(OF_TYPES)) for most in (2, 4)), sum(n < 100 for n in OF_TYPES)),
    ),
    *(
        ("examples/paper/README.md", rf"\| {noise} " + 2 * r"\| (\d+) of (\d+), ([\d,]+) ", orders(noise))
        for noise in ("clean", "segmented")
    ),
    *(
        (
            "examples/paper/README.md",
            rf"\| {point['name']} \| (\d+) of (\d+) \| (\d+) \| (\d+) % \| ([\d.]+) s",
            within(point),
        )
        for point in FIGURE_8["points"]
    ),
    ("docs/commands/track.md", r"(\d+) flights cross the grids", len(FLIGHTS)),
    (
        "docs/commands/track.md",
        r"displaced for (\d+) to (\d+) frames",
        [limit(int(row["length"]) for row in FLIGHTS) for limit in (min, max)],
    ),
    ("docs/commands/track.md", r"No frame of (\d+) lies farther off", sum(int(row["frames"]) for row in FLIGHTS)),
    (
        "docs/commands/track.md",
        r"and all (\d+) flights are placed",
        sum((row["placed"], row["wrong"]) == (row["frames"], "0") for row in FLIGHTS),
    ),
    ("docs/commands/verify.md", r"none of (\d+) is judged\.", sum(float(row["off_m"]) >= 500.0 for row in VERIFIED)),
    (
        "docs/commands/verify.md",
        r"100 m off (\d+) of (\d+) are judged",
        (sum(row["verdict"] != "unknown" for row in BESIDE), len(BESIDE)),
    ),
    (
        "docs/commands/verify.md",
        r"exact to ([\d.]+) m \(median; ([\d.]+) m at worst\)",
        [limit(float(row["error_m"]) for row in BESIDE if row["error_m"]) for limit in (median, max)],
    ),
    (
        "docs/commands/verify.md",
        r"None of (\d+) masks of another city",
        sum(row["off_m"] == "-1.0" for row in VERIFIED),
    ),
    (
        "docs/commands/verify.md",
        r"takes ([\d.]+) s of processor time",
        digits(median(float(row["cpu_s"]) for row in VERIFIED)),
    ),
]

#: Page; what it says; what another page says, whose numbers are the same.
FROM_PAGES = [
    (
        "README.md",
        r"steep views \| (\d+) of (\d+) \| (\d+) \|",
        "docs/how-well.md",
        r"\| all of them \| (\d+) of (\d+) \| (\d+) \|",
    ),
    ("README.md", r"\| ([\d,]+) of ([\d,]+) \| 3 \|", "docs/how-well.md", r"full effort locates ([\d,]+) of ([\d,]+)"),
    (
        "README.md",
        r"data \| (\d+) of (\d+) \((\d+) to (\d+) %\)",
        "docs/how-well.md",
        r"blind \| (\d+) of (\d+) \((\d+) to (\d+) %\)",
    ),
    ("README.md", r"(\w+) of ([\d,]+) masks without", "docs/how-well.md", r"\*\*(\w+) of ([\d,]+) masks without"),
    ("README.md", r"later and ([\d.]+) GB of disk", "docs/install.md", r"`pip install \.` \| ([\d.]+) GB"),
    ("docs/install.md", r"takes about ([\d.]+) GB of disk", "docs/install.md", r"`pip install \.` \| ([\d.]+) GB"),
]

PAGES = ["README.md", "SECURITY.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md")))]
#: What is measured: times, memory, shares, counts of trials, medians.
MEASURED = re.compile(
    r"(?<![\w.,])\.?\d[\d,.]*\s?(?:s|ms|seconds?|minutes?|[kMG]i?B|%)(?!\w)"
    r"|(?<![\w.,])\d[\d,]* of [\d,]*\d|\d m \(median"
)
#: Where a number comes from: a command with the commit that it ran at, a program of the repository or its results, a
#: test, the size of an installation.
SOURCE = re.compile(
    r"`[^`]*\broadgeo \w[^`]*`.*\bat [0-9a-f]{7}\b|`python (?:examples|tests)/|\]\((?:\.\./)*examples/|`examples/\w"
    r"|`tests/\S+`|`test_|`du -s|```bash\n.*roadgeo demo",
    re.DOTALL,
)


def sections(page):
    """Return the sections of a page by their headings; the first part is what stands before."""
    found = re.split(r"^(#{1,4} .*)$", (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(found[1::2], found[2::2], strict=True))


def measured(page, text):
    """Return the sentences, rows and items of a text with a measure that no list above compares."""
    for listed, sentence, *_ in (*FROM_CODE, *FROM_RESULTS, *FROM_PAGES):
        if listed == page:
            text = re.sub(sentence.replace(" ", r"\s+"), lambda found: re.sub(r"\d", "", found[0]), text)
    text = re.sub(r"[^.|]*\]\([^)]*how-well\.md#[^.|]*", "", text)
    text = re.sub(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->|95 % (?:confidence|interval)", "", prose(text), flags=re.DOTALL)
    return [" ".join(part.split()) for part in re.split(r"\n(?=\s*[-*|])|\n\n|\.\s", text) if MEASURED.search(part)]


def anchor(heading):
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def has_number(text):
    """Whether a text states a number, beside those in code, links and comments."""
    return bool(re.search(r"\d", re.sub(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->", "", text)))


def is_equal(page, sentence, numbers):
    return [value(text) for text in said(page, sentence)] == pytest.approx(np.atleast_1d(numbers).tolist())


def test_pages_state_the_numbers_of_results():
    assert [(page, sentence) for page, sentence, numbers in FROM_RESULTS if not is_equal(page, sentence, numbers)] == []


def test_pages_state_the_numbers_of_other_pages():
    stated = [(said(page, sentence), said(source, there)) for page, sentence, source, there in FROM_PAGES]
    assert [here for here, _ in stated] == [there for _, there in stated]


@pytest.mark.parametrize("page", PAGES)
def test_what_was_measured_stands_in_a_section_that_names_its_command_or_results(page):
    found = [part for text in sections(page).values() if not SOURCE.search(text) for part in measured(page, text)]
    assert found == []


def test_a_section_with_numbers_names_the_command_or_the_results_that_they_come_from():
    named = re.compile(r"`roadgeo \w+|`python\s+examples/|\]\((\.\./)?examples/|`examples/\w")
    found = sections("docs/how-well.md")
    assert [name for name, text in found.items() if has_number(text) and not named.search(text)] == []


def test_a_number_of_the_readme_leads_to_the_section_that_it_comes_from():
    how_well = sections("README.md")["## How well"].replace("The range is a 95 % interval.", "")
    known = [f"](docs/how-well.md#{anchor(name.lstrip('# '))})" for name in sections("docs/how-well.md")]
    *rows, text = [block for block in re.split(r"\n(?=\|)|\n\n", how_well) if block.strip()]
    stated = [part for part in [*rows, *re.split(r"\.\s", text)] if has_number(part)]
    assert [part for part in stated if not any(link in part for link in known)] == []


def test_the_table_of_error_rates_is_that_of_results():
    text = (ROOT / "docs/how-well.md").read_text(encoding="utf-8")
    of_kind = r"^\| ([a-z ]+) \| ([\d.]+) (?:to|and).*\| ([\d,]+) \| (\d+) \(at most ([\d.]+) %\) \|$"
    rows = [(kind, *map(value, row)) for kind, *row in re.findall(of_kind, text, re.MULTILINE)]
    assert rows == [
        (kind, rate.score, rate.reported, rate.wrong, pytest.approx(100.0 * rate.at_most, rel=0.02))
        for kind, rates in ERROR_RATES.items()
        for rate in rates
    ]
    assert {rates[0].score for rates in ERROR_RATES.values()} == {LocateOptions().min_log10_odds}
