"""Fetch, change, build and run the programs of the paper's authors on queries whose place is known.

    python examples/peers/programs.py build --build FOLDER [--source FOLDER]
    python examples/peers/programs.py run --build FOLDER --queries FOLDER [--programs v1 v2 plbg] [--most 3] --out CSV

`build` clones each program at a commit, applies our patch (`patches`), and compiles it with g++; it needs OpenCV 4,
shapelib, nanoflann and glog with their headers (Debian: libopencv-dev libshp-dev libnanoflann-dev libgoogle-glog-dev).
`--source` names a folder with the repositories, where there is no network. `run` takes the queries that
`results/programs.csv` names, and writes the same columns: `found`, the error of the frame's middle in metres, the
program's own time in seconds, and its best similarity or vote.

What `run` does to the queries: masks are mirrored, for the programs take maps with y upwards, images with y downwards,
and their search for pairs expects one sense of rotation in both. Maps are in metres from a corner, since the programs
write six digits. An offset of 213 m that version 1 adds to y is taken off again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import geopandas as gpd
import numpy as np
import results

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "programs.csv"
#: Names that OpenCV 3 had, and libraries.
HEADERS = ("imgproc/types_c.h", "calib3d/calib3d_c.h", "highgui/highgui_c.h", "imgcodecs/legacy/constants_c.h")
LIBRARIES = (
    "opencv_core",
    "opencv_imgproc",
    "opencv_imgcodecs",
    "opencv_highgui",
    "opencv_calib3d",
    "opencv_flann",
    "shp",
    "glog",
)
#: Inliers and relative error of the cross ratio: as shipped, and the paper's.
PARAMETERS = {"def": ("0.6", "0.2"), "paper": ("0.5", "0.3")}
#: Version 1 adds this to y, metres.
V1_OFFSET_M = 213.0
MIDDLE = np.array([749.5, 749.5, 1.0])


@dataclass(frozen=True)
class Program:
    """A program: its repository and commit, and executables with the file that holds the main function of each."""

    repository: str
    commit: str
    executables: dict[str, str]


PROGRAMS = {
    "v1": Program(
        "RCLGeolocalization",
        "7a2ead4bf9ee188a8ab7f07c1cdca9659ef0cc50",
        {"map": "exe/make_map.cc", "locate": "exe/main.cc"},
    ),
    "v2": Program(
        "RCLGeolocalization-2.0",
        "2325fd11b23789630b6c12ecd0258c9dec84644a",
        {
            "map": "test/shp_to_map.cc",
            "surface": "test/shp_to_voronoi.cc",
            "locate": "test/single_img_localization.cc",
        },
    ),
    "plbg": Program("PLBGHashing", "289d0a66c9091602abedf2860c2b3ae9d763fed0", {"locate": "test/auto_geolocalize.cc"}),
}


# --- building ---------------------------------------------------------------------------------------------------------


def fetch(program: Program, patch: Path, source: Path | None, to: Path) -> None:
    """Clone a program at its commit, from GitHub or a folder, and apply our changes."""
    shutil.rmtree(to, ignore_errors=True)
    origin = f"https://github.com/FlyAlCode/{program.repository}" if source is None else source / program.repository
    for command in (
        ["git", "clone", "--quiet", origin, to],
        ["git", "-C", to, "checkout", "--quiet", program.commit],
        ["git", "-C", to, "apply", "--unidiff-zero", patch.resolve()],
    ):
        done = subprocess.run(list(map(str, command)), check=False)
        if done.returncode:
            raise SystemExit(f"Error: {program.repository} cannot be fetched; give --source")


def build(name: str, source: Path | None, folder: Path) -> None:
    """Compile a program: everything in `src` but main functions once, then each executable."""
    program, tree = PROGRAMS[name], folder / name
    fetch(program, HERE / "patches" / f"{name}.patch", source, tree)
    older = folder / "opt" / "ros" / "kinetic" / "include"  # headers are included from there, by a path up from here
    older.mkdir(parents=True, exist_ok=True)
    include = subprocess.run(["pkg-config", "--cflags-only-I", "opencv4"], capture_output=True, text=True, check=True)
    if not (older / "opencv-3.3.1-dev").exists():
        (older / "opencv-3.3.1-dev").symlink_to(include.stdout.strip().removeprefix("-I"))
    flags = ["-std=c++14", "-O3", "-DNDEBUG", "-w", *include.stdout.split(), f"-I{folder.resolve() / 'a' / 'b'}"]
    (folder / "a" / "b").mkdir(parents=True, exist_ok=True)
    flags += [f"-I{path}" for path in [tree / "include", *(tree / "include").rglob("*")] if path.is_dir()]
    flags += [word for header in HEADERS for word in ("-include", f"opencv2/{header}")]
    mains = set(program.executables.values())
    shared = [path for path in sorted((tree / "src").rglob("*.cc")) if path.parent.name not in ("exe", "test")]
    objects = [compile_one(path, flags) for path in shared]
    for executable, main in program.executables.items():
        linked = [*objects, compile_one(tree / "src" / main, flags)]
        command = ["g++", *linked, "-o", folder / f"{name}_{executable}", *(f"-l{library}" for library in LIBRARIES)]
        subprocess.run(list(map(str, command)), check=True)
    print(f"{name}: built {', '.join(program.executables)} of {len(shared) + len(mains)} files")


def compile_one(path: Path, flags: list[str]) -> Path:
    made = path.with_suffix(".o")
    subprocess.run(["g++", "-c", *flags, str(path), "-o", str(made)], check=True)
    return made


# --- running ----------------------------------------------------------------------------------------------------------


def prepare(name: str, city: Path, area: int, folder: Path) -> list[Any]:
    """Make the map of a city for a program; return the arguments that name it."""
    made = folder / "maps" / f"{city.name}_{area}"
    made.mkdir(parents=True, exist_ok=True)
    roads, points = made / "roads.shp", made / f"{name}.txt"
    if not roads.is_file():
        meta = json.loads((city / "meta.json").read_text(encoding="utf-8"))
        lines = gpd.read_file(city / f"ref_{area}km.gpkg", layer="roads").geometry
        lines.set_crs(None, allow_override=True).translate(-meta["origin_e"], -meta["origin_n"]).to_file(roads)
    if name == "plbg":
        return [roads]
    if not points.is_file():
        call(folder / f"{name}_map", roads, points, 1000 * area + 500)
    if name == "v1":
        return [points]
    surface = made / "surface.info"
    if not surface.is_file():
        call(folder / "v2_surface", roads, surface, made / "tile", 1, 2000)
    return [points, surface, roads]


def call(*command: Any) -> None:
    subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def locate(name: str, params: str, city: Path, area: int, masks: list[Path], folder: Path) -> Iterator[dict[str, Any]]:
    """Run a program on some masks; yield the outcome of each."""
    truth = {row["file"]: row for row in results.read(city / "truth.csv")}
    the_map = prepare(name, city, area, folder)
    with tempfile.TemporaryDirectory() as scratch:
        (Path(scratch) / "masks").mkdir()
        for path in masks:
            cv2.imwrite(f"{scratch}/masks/{path.name}", cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[:, ::-1])
        out = Path(scratch) / "out.txt"
        command = [folder / f"{name}_locate", *the_map, f"{scratch}/masks"]
        command += {"v1": [0, 0, out], "v2": [out], "plbg": [out, f"{scratch}/"]}[name]
        call(*command, *(() if name == "plbg" else PARAMETERS[params]))
        answers = read_hashing(out) if name == "plbg" else read_answers(out, V1_OFFSET_M if name == "v1" else 0.0)
        for path, (found, seconds, matrix, similarity) in zip(masks, answers, strict=True):
            row = truth[f"{path.parent.name}/{path.name}"]
            off = ""
            if matrix is not None and np.abs(matrix).sum():
                x, y, w = matrix @ MIDDLE
                off = f"{np.hypot(x / w - float(row['centre_x']), y / w - float(row['centre_y'])):.1f}"
            numbers = {"time_s": f"{seconds:.3f}", "best_similarity": f"{similarity:.3f}"}
            yield {"found": int(found), "centre_err_m": off, **numbers}


Answer = tuple[bool, float, "np.ndarray | None", float]


def read_answers(path: Path, offset_m: float) -> Iterator[Answer]:
    """Read the answers of versions 1 and 2: number, success, milliseconds, homography, similarity."""
    for line in path.read_text().splitlines():
        _, success, spent, *numbers, similarity = map(float, line.split())
        matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -offset_m], [0.0, 0.0, 1.0]]) @ np.reshape(numbers, (3, 3))
        yield success > 0, spent / 1000.0, matrix if np.abs(numbers).sum() else None, similarity


def read_hashing(path: Path) -> Iterator[Answer]:
    """Read the answers of the hashing: for each mask number, seconds and count of models, then vote and matrix each."""
    lines = iter([line.split() for line in path.read_text().splitlines() if line.strip()])
    for _, seconds, count in lines:
        models = [list(map(float, next(lines))) for _ in range(int(count))]
        vote, *matrix = max(models, default=[0.0])
        yield bool(models), float(seconds), np.reshape(matrix, (3, 3)) if models else None, vote


def run(names: list[str], areas: list[int], folder: Path, queries: Path, most: int, out: Path) -> None:
    """Run programs on the first `most` queries of each set that `out` does not hold yet."""

    def of_set(row: dict[str, str]) -> tuple[str, ...]:
        return tuple(row[name] for name in ("peer", "params", "city", "area_km", "kind"))

    rows = [row for row in results.read(RESULTS) if row["peer"] in names and int(row["area_km"]) in areas]
    rows = [row for row in rows if (queries / row["city"]).is_dir()]
    for key, members in groupby(sorted(rows, key=lambda row: (*of_set(row), row["query"])), of_set):
        peer, params, city, area, kind = key
        named = dict(zip(("peer", "params", "city", "area_km", "kind"), key, strict=True))
        keys = [{**named, "query": row["query"]} for row in members][:most]
        keys = [row for row in keys if not results.holds(out, row)]
        masks = [queries / city / kind / f"{row['query']}.png" for row in keys]
        for row, outcome in zip(keys, locate(peer, params, queries / city, int(area), masks, folder), strict=True):
            results.append(out, {**row, **outcome})


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("build", "run"))
    parser.add_argument("--build", type=Path, required=True, help="folder of the programs that are built")
    parser.add_argument("--source", type=Path, help="folder of the repositories")
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=list(PROGRAMS))
    parser.add_argument("--queries", type=Path, help="folder of the cities")
    parser.add_argument("--areas", nargs="+", type=int, choices=(10, 20), default=[10, 20], help="of the map, km")
    parser.add_argument("--most", type=int, default=1000, help="queries of each set")
    parser.add_argument("--out", type=Path, default=Path("programs.csv"))
    options = parser.parse_args(arguments)
    os.environ["OMP_NUM_THREADS"] = "1"
    options.build.mkdir(parents=True, exist_ok=True)
    if options.what == "build":
        for name in options.programs:
            build(name, options.source, options.build)
    elif options.queries is None:
        parser.error("run: --queries is needed")
    else:
        run(options.programs, options.areas, options.build, options.queries, options.most, options.out)


if __name__ == "__main__":
    main()
