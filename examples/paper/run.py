"""The paper's experiments: Figures 5 to 10 and Tables 1 to 3, by one command.

    python examples/paper/run.py boston-ma --dataset massachusetts -o results

Li, Yang, Wang, He, "Road-network-based Rapid Geolocalization" (arXiv 1906.12174), section 4. `boston-ma` is a map of
Boston (`roadgeo index --osm "Boston, MA"`), `massachusetts` the folder of the dataset. All that is needed is looked for
first. Masks and maps are kept in WORK, from where another run takes them.
"""

from __future__ import annotations

import argparse
import os
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import experiments as paper
import tables

from roadgeo.errors import RoadgeoError
from roadgeo.reference.library import resolve_reference

EXPERIMENTS = ("figure5", "figure6", "figure7", "figure8", "tables")


def main() -> int:
    """Check that all inputs exist, and run the experiments."""
    options = _arguments().parse_args()
    missing = _missing(options)
    if missing:
        print("\n".join(["These are missing:", *missing]), file=sys.stderr)
        return 2
    work = options.out / "work" if options.work is None else options.work
    for folder in (options.out, work):
        folder.mkdir(parents=True, exist_ok=True)
    reference = resolve_reference(options.reference)
    setting = paper.Setting(
        reference,
        paper.cut_area(reference, work),
        options.dataset,
        options.out,
        work,
        options.queries,
        options.perspectives,
        options.seed,
        options.jobs,
        options.work_limit,
    )
    for name in options.only:
        import_module(name).run(setting)
    return 0


def _arguments() -> argparse.ArgumentParser:
    data = os.environ.get("ROADGEO_DATA", "")
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("reference", help="a map of Boston: REF.gpkg, or a name in the library")
    parser.add_argument(
        "--dataset", type=Path, default=Path(data) / "massachusetts", help="default: $ROADGEO_DATA/massachusetts"
    )
    parser.add_argument("--only", nargs="+", choices=EXPERIMENTS, default=EXPERIMENTS, help="default: all")
    parser.add_argument("-o", "--out", type=Path, default=Path("results"), help="folder of results")
    parser.add_argument("--work", type=Path, help="folder of masks and maps (default: OUT/work)")
    parser.add_argument("--queries", type=int, default=100, help="masks per point (default 100)")
    parser.add_argument("--perspectives", type=int, default=4, help="of each image in Table 3 (default 4)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument(
        "--work-limit", type=float, default=10.0, help="most work for a mask, seconds of a usual machine (default 10)"
    )
    return parser


def _missing(options: argparse.Namespace) -> list[str]:
    """Return what the experiments need and do not have, in sentences."""
    missing = []
    if find_spec("matplotlib") is None:
        missing.append("matplotlib draws the figures: pip install matplotlib")
    try:
        resolve_reference(options.reference)
    except RoadgeoError as error:
        missing.append(str(error))
    if "tables" in options.only:
        needed = [options.dataset / name for name in tables.NEEDED]
        missing += [f"{path}, of the Massachusetts Roads Dataset (--dataset)" for path in needed if not path.exists()]
    return missing


if __name__ == "__main__":
    sys.exit(main())
