"""Locate photographs whose place is known: on their own maps, blind and with hints, with more maps, on others alone.

    python examples/photographs/photographs.py blind FOLDER
    python examples/photographs/photographs.py told FOLDER              scale within 7 %, heading within 5 degrees
    python examples/photographs/photographs.py more FOLDER --maps ROADS ...      its own map and these, together
    python examples/photographs/photographs.py elsewhere FOLDER --maps ROADS ...    each of these alone: it has no place
    python examples/photographs/photographs.py table                    count the results again

FOLDER holds `truth.csv` with the columns file, lon, lat (of the middle), gsd_m, heading_deg and roads: a file of road
lines, its path from the folder above. Rows without roads are left out. A place is right when its middle lies within
15 m, or 3 pixels, of the truth. Every search is a row of results/photographs.csv; a run that was stopped goes on. Maps
are built once, in --built. Seconds are processor time.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import results

import roadgeo
from roadgeo.geometry.projection import metres_apart

RIGHT_M, RIGHT_PX = 15.0, 3.0
#: How far off a scale that is given may be, and a heading, degrees.
SCALE_OFF, HEADING_OFF_DEG = 0.07, 5.0
MODES = ("blind", "told", "more", "elsewhere")


@cache
def build(roads: Path, folder: Path) -> Any:
    """Open the map of a file of roads; build it unless an earlier run has."""
    path = folder / f"{roads.name.split('.')[0]}.gpkg"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "roadgeo", "index", "-q", "--roads", roads, "--out", path]
        subprocess.run(list(map(str, command)), check=True)
    return roadgeo.open_reference(path)


def searches(mode: str, own: Path, maps: list[Path]) -> Iterator[list[Path]]:
    """Yield the maps of each search for a photograph."""
    others = [path for path in maps if path.resolve() != own.resolve()]
    if mode == "elsewhere":
        yield from ([path] for path in others)
    else:
        yield [own, *others] if mode == "more" else [own]


def locate(mode: str, photograph: Path, row: dict[str, str], opened: list[Any]) -> dict[str, Any]:
    """Locate a photograph; return the outcome."""
    gsd = float(row["gsd_m"])
    scale = ((1.0 - SCALE_OFF) * gsd, (1.0 + SCALE_OFF) * gsd)
    hints = {"gsd": scale, "heading": (float(row["heading_deg"]), HEADING_OFF_DEG)} if mode == "told" else {}
    started = time.process_time()
    answer = roadgeo.locate(str(photograph), opened, time_limit=900.0, **hints)
    seconds = time.process_time() - started
    outcome = {"status": answer.status, "right": 0, "code": answer.reason_code.value, "off_m": "", "score": ""}
    if answer.log10_odds is not None:
        outcome["score"] = f"{answer.log10_odds:.2f}"
    if answer.center is not None and mode != "elsewhere":
        truth = np.array([float(row["lon"]), float(row["lat"])])
        off = float(metres_apart(np.array([answer.center.lon, answer.center.lat]), truth))
        near = off <= max(RIGHT_M, RIGHT_PX * gsd)
        outcome |= {"off_m": f"{off:.1f}", "right": int(answer.located and near)}
    return {**outcome, "cpu_s": f"{seconds:.2f}"}


def measure(mode: str, folder: Path, maps: list[Path], built: Path, out: Path) -> None:
    """Search for all that `out` does not hold yet."""
    version = results.commit()
    for row in results.read(folder / "truth.csv"):
        own = folder.parent / row["roads"]
        for searched in searches(mode, own, maps) if row["roads"] else ():
            key = {"mode": mode, "file": row["file"], "maps": " ".join(path.name for path in searched)}
            if not results.holds(out, key):
                opened = [build(path, built) for path in searched]
                outcome = locate(mode, folder / row["file"], row, opened)
                results.append(out, {**key, **outcome, "commit": version})


def count(path: Path) -> str:
    """Return the counts of each mode in a file of results, as Markdown."""
    rows, lines = results.read(path), []
    for mode in (mode for mode in MODES if any(row["mode"] == mode for row in rows)):
        mine = [row for row in rows if row["mode"] == mode]
        located = [row for row in mine if row["status"] == "located"]
        right = sum(row["right"] == "1" for row in located)
        wrong, there = results.share(len(located) - right, len(mine)), results.share(right, len(mine))
        scores = [float(row["score"]) for row in mine if row["score"] and row["right"] == "0"]
        spent = [[float(row["cpu_s"]) for row in mine if (row in located) == is_it] for is_it in (True, False)]
        medians = [f"{np.median(some):.2g}" if some else "-" for some in spent]
        highest = f"{max(scores):.1f}" if scores else "-"
        lines.append([mode, "-" if mode == "elsewhere" else there, wrong, highest, *medians])
    head = ["", "located right", "wrong", "highest score of others", "seconds located, median", "refused"]
    return results.table(head, lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=[*MODES, "table"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--maps", type=Path, nargs="+", default=[], help="files of roads")
    parser.add_argument("--built", type=Path, default=Path("maps"), help="folder of the maps that are built")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "photographs.csv")
    options = parser.parse_args(arguments)
    if options.mode != "table":
        if options.folder is None:
            parser.error("a folder with truth.csv is needed")
        if not options.maps and options.mode in ("more", "elsewhere"):
            parser.error(f"{options.mode}: --maps is needed")
        measure(options.mode, options.folder, options.maps, options.built, options.out)
    print(count(options.out))


if __name__ == "__main__":
    main()
