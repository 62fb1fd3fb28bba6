"""`roadgeo simulate`: query masks whose place is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from roadgeo._options import part, take
from roadgeo.cli.command_line import made_by
from roadgeo.cli.options import Shared, Verbosity, argument, command
from roadgeo.cli.printing import tell
from roadgeo.cli.progress import count_up
from roadgeo.cli.queries import Queries, query_sets

__all__ = ["simulate_command"]


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """The parameters of `roadgeo simulate`."""

    reference: str = argument("REF", type=None)
    out_dir: str = take(Shared, "out_dir", help="Where to write.", default=None, required=True)
    drawn: Queries = part(Queries)
    verbosity: Verbosity = part(Verbosity, "quiet")


@command("simulate", Simulate)
def simulate_command(asked: Simulate) -> None:
    """Draw road masks from a reference's own roads, as a camera would see them and a segmenter get them wrong.

    Writes NOISE/q_NNNN.png, footprints.gpkg, and truth.csv and truth.json, which hold for each mask the homography from
    its pixels to the CRS (h00 to h22; the centre of the top-left pixel is (0.5, 0.5)), the camera, and the changes to
    the roads. The same options draw the same masks.

    \b
    Examples:
      roadgeo simulate boston-ma -o queries
      roadgeo simulate boston-ma -o drone --noise segmented --gsd 0.3:0.6 --tilt 30:50 --intersections 12:30
      roadgeo simulate boston-ma -o plan --window 1500 --gsd 1:1 --tilt 0 --heading 0 -n 100
    """
    import cv2

    from roadgeo.evaluation.simulation import simulate_query
    from roadgeo.evaluation.trials import read_landscape
    from roadgeo.evaluation.truth import write_truth
    from roadgeo.reference.library import resolve_whole
    from roadgeo.storage.files import make_folder, write_bytes

    sets = query_sets(asked.drawn)
    landscape = read_landscape(resolve_whole(asked.reference), asked.drawn.roads)
    folder, truths = Path(asked.out_dir), []
    with count_up(sum(count for _, count in sets)) as advance:
        for simulation, count in sets:
            make_folder(folder / simulation.kind)
            for k in range(count):
                query = simulate_query(landscape, simulation, k)
                write_bytes(folder / query.truth.file, cv2.imencode(".png", query.mask)[1].tobytes())
                truths.append(query.truth)
                advance(simulation.kind)
    write_truth(asked.out_dir, truths, made_by())
    how = f"roadgeo evaluate {asked.reference} --queries {asked.out_dir}"
    tell(f"{len(truths)} masks in {asked.out_dir}; next: {how}", err=True)
