"""Numbers that pages take from the code are those that stand there."""

import re

import numpy as np
from support.documents import ROOT, said, value

from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.scoring import RADIUS_M, share
from roadgeo.flights import tracker
from roadgeo.geometry import pose, projection
from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.mask import PROBABILITY_SURE, PROBABILITY_UNKNOWN
from roadgeo.geometry.transformation import exactness
from roadgeo.kernels.road_rings import BEARINGS, RINGS
from roadgeo.kernels.triple_codes import MAX_ANCHORS
from roadgeo.matching import (
    checking,
    evidence,
    hints,
    pairs,
    paper,
    picture,
    rivals,
    road_search,
    scene,
    triples,
    verdict,
    veto,
)
from roadgeo.matching.index import COARSENESS
from roadgeo.matching.methods import N_PLACES
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.paper import PAPER, PairOptions
from roadgeo.matching.search import SearchOptions
from roadgeo.matching.shifts import LocalSearchOptions
from roadgeo.outputs import location_layers, subject
from roadgeo.roads import intersections, vectorization
from roadgeo.roads.intersections import IntersectionOptions
from roadgeo.running import photographs, queries, sharding
from roadgeo.serving import guard, server, workers
from roadgeo.serving.options import ServeOptions
from roadgeo.sources import camera, masks, overpass
from roadgeo.sources.segmentation import onnx_file, scales
from roadgeo.storage import memory, rasters, unpacking, vectors

CAMERA, PAIR, TANGENT, SERVE = CameraOptions(), PairOptions(), IntersectionOptions(), ServeOptions()
NEARBY, CHECK = LocalSearchOptions(), checking.CheckOptions()
NEEDED = LocateOptions().min_log10_odds
SECTION_8 = "docs/how-it-works.md"
MARGIN_M = sharding.ShardOptions().margin_m
MIB, GIB = 1 << 20, 1 << 30


def noise(name: str) -> tuple[float, ...]:
    """Return the least and the greatest share of missing and of false roads of a kind of mask, percent."""
    model = NOISE_MODELS[name]
    return tuple(round(100.0 * part, 6) for part in (*model.missing, *model.false_roads))


#: Page; what it says, with a group for each number; the numbers in the code.
FROM_CODE = [
    ("docs/how-it-works.md", r"with a tolerance of (\w+) degrees", triples.TripleOptions().angle_tolerance_deg),
    ("docs/how-it-works.md", r"are (\d+) rings of (\d+) bits", (RINGS, BEARINGS)),
    ("docs/how-it-works.md", r"piece of about ([\d,]+) intersections", triples._USUAL_SIZE),
    ("docs/how-it-works.md", r"so (\d+) m of road count as one", evidence.STATEMENT_M),
    (SECTION_8, r"within (\d+) km that most of the roads", rivals._AROUND.reach_m / 1000.0),
    (SECTION_8, r"and (two thirds) of the roads met there", rivals._SAME),
    (SECTION_8, r"cut into pieces of (\d+) m", scene.APART_M),
    (SECTION_8, r"next `n` places lie, (\d+) at most", rivals._TAIL),
    (SECTION_8, r"\*\*contradiction\*\*: (\d+) times the share", rivals._PENALTY),
    (SECTION_8, r"less than (a tenth) as much as it does elsewhere", evidence._HARDLY),
    (SECTION_8, r"of `n / ([\d,]+)` intersections", triples._USUAL_SIZE),
    (SECTION_8, r"traced roads is below (\d+), the picture is asked", rivals._CERTAIN),
    (SECTION_8, r"over the (\d+) m around is `pi`", picture._USUAL_M),
    (SECTION_8, r"(\d+) m of road count as one statement", picture._STATEMENT_M),
    (SECTION_8, r"within (\d+) km, in (\w+) turns", (rivals._AROUND.reach_m / 1000.0, len(rivals._TURNS_DEG))),
    (
        SECTION_8,
        r"So beyond 10\^(\d+) the lead is (\d+) times the part",
        (picture._MOST_LIKELIHOOD, picture._MOST_LIKELIHOOD),
    ),
    (SECTION_8, r"or the blocks beside it, by 10\^(\d+) is", rivals._CERTAIN),
    (SECTION_8, r"met is less than (half) of the score needed", rivals._MAY_LEAD),
    (SECTION_8, r"explain more by 10\^([\d.]+) refuses", veto._MORE),
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
    ("docs/commands/locate.md", r"probabilities, (\d+) to ([\d,]+) pixels", (masks.MIN_SIDE, masks.MAX_SIDE)),
    (
        "docs/commands/locate.md",
        r"([\d.]+) alone stands for ([\d.]+) to ([\d.]+)\.",
        (0.3, 0.3 / hints.GSD_FACTOR, 0.3 * hints.GSD_FACTOR),
    ),
    ("docs/commands/locate.md", r"scale is known to (\d+) %", round(100 * (queries._SCALED - 1))),
    ("docs/commands/locate.md", r"may be off \(default (\d+)\)", hints._HEADING_OFF_DEG),
    ("docs/commands/locate.md", r"original pixels: (\d+) control points", subject._GRID**2),
    ("docs/commands/locate.md", r"lists up to (\w+) places", N_PLACES),
    ("docs/commands/locate.md", r"and the best (\w+), each", N_PLACES),
    ("docs/commands/locate.md", r"Beyond (\d+) % of the frame's side", 100 * verdict._MOST_UNSURE),
    ("docs/commands/locate.md", r"height is known to (\d+) % only", 100 * pose.USUAL_SIGMA),
    ("docs/masks.md", r"size from (\d+) to ([\d,]+) pixels", (masks.MIN_SIDE, masks.MAX_SIDE)),
    ("docs/faq.md", r"err: (\d+) m where no accuracy", camera._POSITION_M),
    ("docs/faq.md", r"(\d+) m from ETRS89", exactness("EPSG:25832", "EPSG:4326", (10.0, 50.0)).sigma_m),
    (
        "docs/faq.md",
        r"to WGS 84, (\d+) m from the British",
        exactness("EPSG:27700", "EPSG:4326", (-1.0, 52.0)).sigma_m,
    ),
    ("docs/faq.md", r"range of at least (\d+) m of height", camera._HEIGHT_M),
    ("docs/faq.md", r"from a compass, within (\d+) degrees", camera._YAW_OFF_DEG),
    (
        "docs/faq.md",
        r"`segmented` above lacks (\d+) to (\d+) % of the roads and has (\d+) to (\d+) % false ones",
        noise("segmented"),
    ),
    (
        "docs/faq.md",
        r"`poor` (\d+) to (\d+) % and (\d+) to (\d+) %",
        noise("poor"),
    ),
    (
        "docs/commands/evaluate.md",
        r"\((\d+)-(\d+) % of the roads missing, (\d+)-(\d+) % false\)",
        noise("segmented"),
    ),
    (
        "docs/commands/evaluate.md",
        r"`poor`: a weak one \((\d+)-(\d+) %, (\d+)-(\d+) %\)",
        noise("poor"),
    ),
    (
        "docs/commands/evaluate.md",
        r"(\d+) right leave a recall between (\d+) and (\d+) %",
        (40, round(100 * share(40, 40).low), 100 * share(40, 40).high),
    ),
    ("docs/commands/verify.md", r"`--tolerance` \((\d+) m\)", CHECK.tolerance_m),
    (
        "docs/commands/verify.md",
        r"`--reach` \((\d+) m\) and `--max-turn` \((\d+)°\)",
        (NEARBY.reach_m, NEARBY.turn_deg),
    ),
    (
        "docs/commands/verify.md",
        r"needs a score of (\d+), or of (\d+) where",
        (checking._MIN_SCORE, checking._MIN_SCORE_AS_GIVEN),
    ),
    ("docs/commands/verify.md", r"`IMAGE_fixed.points`: (\d+) control points", subject._GRID**2),
    ("docs/commands/track.md", r"compared with the (\w+) before", tracker._N_BEFORE),
    (
        "docs/commands/track.md",
        r"odds may fall below (\w+) of theirs while the share of its roads that lie on the map falls by ([\d.]+),",
        (tracker._FALLEN, tracker._SHARE_FALLEN),
    ),
    ("docs/commands/serve.md", r"a head (\d+) KiB", server._HEAD_BYTES >> 10),
    ("docs/commands/serve.md", r"must come within (\d+) seconds", SERVE.body_s),
    ("docs/commands/serve.md", r"`--waiting` \+ (\d+) connections", SERVE.connections),
    (
        "docs/commands/serve.md",
        r"takes (\d+) seconds more is ended: 503; a job has (\d+) seconds more",
        (workers._GRACE_S, workers._PATIENT_S),
    ),
    ("docs/commands/serve.md", r"latest (\w+) answers stay", SERVE.kept_jobs),
    ("docs/photographs.md", r"from 0 to (\d+). Nodata \((\d+)\)", (PROBABILITY_SURE, PROBABILITY_UNKNOWN)),
    ("docs/photographs.md", r"then up to (\w+) scales", photographs._MAX_SCALES),
    ("docs/photographs.md", r"is enlarged, at most (\w+) times", scales._MOST_ENLARGED),
    (
        "docs/photographs.md",
        r"gets (\d+) GiB of memory and (\w+) minutes for a tile",
        (onnx_file._MAX_MEMORY / GIB, onnx_file._MAX_SECONDS / 60.0),
    ),
    ("docs/qgis.md", r"residuals × (\d+)\*", location_layers._EXAGGERATION),
    ("docs/qgis.md", r"are drawn (\d+) times as long", location_layers._EXAGGERATION),
    ("docs/references.md", r"kept for (\d+) days", overpass._MOST_AGE_S / 86400.0),
    (
        "docs/references.md",
        r"true to scale \(([\d.]+) %\) and angle \(([\d.]+)°\)",
        (100.0 * projection._MOST_SCALE_ERROR, projection._MOST_ANGLE_DEG),
    ),
    ("docs/references.md", r"pieces of some ([\d,]+) straight", sharding._SEGMENTS),
    ("docs/references.md", r"not smaller than (\d+) km\)", sharding._CELL_M / 1000.0),
    ("docs/references.md", r"neighbours share. (\d+) km by default", MARGIN_M / 1000.0),
    ("docs/references.md", r"enough for (\d+) pixels of ([\d.]+) m", (1500, round(MARGIN_M / 750.0 / 2.0**0.5, 1))),
    (
        "docs/references.md",
        r"Images of (\d+) to (\d+) m pixels",
        (round(COARSENESS * road_search.COARSE_PIXEL_M), CAMERA.gsd_m[1]),
    ),
    ("docs/references.md", r"merged (\w+) times as far as usual", COARSENESS),
    ("docs/references.md", r"where `--gsd` is below (\d+) m", round(COARSENESS * road_search.COARSE_PIXEL_M)),
    ("docs/scale.md", r"more than (\d+) megapixels", vectorization._MAX_WORKING_PIXELS / 1e6),
    ("docs/scale.md", r"keeps up to ([\d.]+) GB of road rasters", road_search._MOST_BYTES / 1e9),
    ("docs/scale.md", r"at most 2\^(\d+) intersections \(([\d.]+) million\)", (24, round(MAX_ANCHORS / 1e6, 1))),
    ("SECURITY.md", r"among (\w+) formats; NumPy", len({name for _, name in rasters._DRIVERS} - {"NumPy", "VRT"})),
    ("SECURITY.md", r"GDAL has (\d+) drivers", len(vectors._DRIVERS)),
    (
        "SECURITY.md",
        r"unpack to (\d+) MiB plus (\d+) times their size",
        (unpacking._FREE / MIB, unpacking._TIMES),
    ),
    (
        "SECURITY.md",
        r"they run: (\d+) GiB of memory, whatever operator asks for it, and (\w+) minutes for a tile",
        (onnx_file._MAX_MEMORY / GIB, onnx_file._MAX_SECONDS / 60.0),
    ),
    ("SECURITY.md", r"takes at most (\d+) GB of memory and (\d+) times", (memory._FREE / GIB, memory._TIMES)),
    (
        "SECURITY.md",
        r"is of (\d+) MB at most, comes within (\w+) minutes",
        (overpass._MOST_BYTES / MIB, overpass._MOST_S / 60.0),
    ),
    ("SECURITY.md", r"one after another, (half) a second apart", guard._GUESS_S),
    ("docs/how-well.md", r"\| ([\d.]+) to 5 \|", NEEDED),
    ("docs/how-well.md", r"middle lies within (\d+) m, or", RADIUS_M),
    ("docs/paper.md", r"are fitted at (\d+) to (\d+) m", (TANGENT.skip_length, TANGENT.tangent_length)),
    (
        "docs/paper.md",
        r"([\d.]+) to ([\d.]+) road widths in a mask",
        (scene._SKIP, scene._TANGENT),
    ),
    ("docs/paper.md", r"a line with the weight ([\d.]+):", intersections._STIFFNESS),
    ("docs/paper.md", r"On the map only, from (\d+) m on", pairs._SKIP_M),
    ("docs/paper.md", r"At most ([\d,]+) intersections of a mask", scene.MAX_COSTLY),
    ("docs/paper.md", r"first `n_px` = (\d+) pixels", PAIR.n_px),
    ("docs/paper.md", r"average error ([\d.]+) pixels", PAIR.fit_error_px),
    ("docs/paper.md", r"The center moves (\d+) m at most", TANGENT.max_shift),
    ("docs/paper.md", r"lines within (\d+)° are one tangent", TANGENT.merge_angle_deg),
    ("docs/paper.md", r"`delta` = ([\d.]+)", PAIR.delta),
    ("docs/paper.md", r"`delta_angle_deg` = (\d+)", PAIR.delta_angle_deg),
    ("docs/paper.md", r"`d_max_m` = ([\d,]+)", PAIR.d_max_m),
    ("docs/paper.md", r"`inlier_distance_m` = (\d+)", PAIR.inlier_distance_m),
    (
        "docs/paper.md",
        r"as stated, ([\d.]+), of at least `min_intersections` = (\d+)",
        (PAIR.delta_inlier, PAIR.min_intersections),
    ),
    (
        "docs/paper.md",
        r"`lambda` = ([\d.]+), `lambda_1` = ([\d.]+) and `p_query` = ([\d.]+)",
        (PAIR.lambda_, PAIR.lambda_1, PAIR.p_query),
    ),
    ("docs/paper.md", r"also ends after (\d+) s of counted work", PAIR.work_limit_s),
]


def test_pages_state_the_numbers_of_the_code():
    stated = {(page, sentence): [value(text) for text in said(page, sentence)] for page, sentence, _ in FROM_CODE}
    known = {(page, sentence): list(np.atleast_1d(numbers)) for page, sentence, numbers in FROM_CODE}
    assert stated == known


def test_the_page_of_the_paper_names_every_option_and_those_of_the_paper():
    text = (ROOT / "docs/paper.md").read_text(encoding="utf-8")
    assert [name for name in paper.thresholds() if f"`{name}" not in text] == []
    marked = re.findall(r"\*\(p\)\* `(\w+=\w+)`", text)
    assert paper.read_options(marked, PAIR) == PAPER
