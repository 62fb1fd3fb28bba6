"""`roadgeo vectorize`: the roads seen in a mask or a photograph, for inspection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from roadgeo._options import part, take
from roadgeo._text import counted, visible
from roadgeo.cli import ERROR
from roadgeo.cli.options import Shared, argument, command, hint, refuse_stated, threaded
from roadgeo.cli.printing import complain, echo
from roadgeo.cli.progress import show_steps
from roadgeo.running.options import SEGMENTING, ReadOptions
from roadgeo.running.tasks import Task, find_masks, name_tasks
from roadgeo.storage.files import make_folder

if TYPE_CHECKING:
    from roadgeo._progress import Say

__all__ = ["vectorize_command"]


@dataclass(frozen=True, kw_only=True)
class Vectorize:
    """The parameters of `roadgeo vectorize`."""

    images: tuple[str, ...] = argument("IMAGE...", many=True)
    out_dir: str = take(Shared, "out_dir")
    gsd_m: tuple[float, float] | None = hint("gsd")
    recursive: bool = take(Shared, "recursive")
    reading: ReadOptions = part(ReadOptions, *SEGMENTING)


@command("vectorize", Vectorize)
def vectorize_command(asked: Vectorize) -> int:
    """Show the roads and intersections seen in IMAGEs: the first thing to look at when one was not located.

    An image is a road mask or a photograph. For photo.jpg it writes
    photo_vectorized.gpkg, in pixel coordinates, which lies on the image when both are opened in QGIS,
    photo_vectorized.png, and of a photograph photo_mask.tif, the probability of road.

    \b
    Examples:
      roadgeo vectorize photo_mask.tif
      roadgeo vectorize photo.jpg --gsd 0.3
      roadgeo vectorize probability.tif --band 2 --threshold 0.4 --out-dir seen
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.errors import RoadgeoError, is_of_memory

    refuse_stated({"gsd_m": asked.gsd_m})
    make_folder(asked.out_dir)
    compile_once()
    reading = threaded(asked.reading)
    status = 0
    with show_steps() as say:
        for task in name_tasks(find_masks(asked.images, asked.recursive)):
            try:
                roads = _show(task, asked.out_dir, asked.gsd_m, reading, say)
            except RoadgeoError as error:
                complain(str(error))
                status = ERROR
                continue
            except Exception as error:  # of a library: nothing wrong with one mask stops the others
                what = f"{task.mask}: {type(error).__name__}: {error}; this is a fault of roadgeo, please report it"
                lack = f"{task.mask}: more memory is needed than there is; reduce it or cut it up"
                complain(lack if is_of_memory(error) else what)
                status = ERROR
                continue
            echo(visible(f"{task.mask}: {roads}"))
    return status


def _show(task: Task, out_dir: str, gsd_m: tuple[float, float] | None, reading: ReadOptions, say: Say) -> str:
    """Write the roads seen in an image; return them in words."""
    from roadgeo.errors import MaskError
    from roadgeo.matching.scene import trace_query
    from roadgeo.outputs.paths import output_paths
    from roadgeo.outputs.vectorized import write_vectorized
    from roadgeo.running.probability_files import keep_probability
    from roadgeo.running.queries import read_roads

    look = read_roads(task.mask, gsd_m, reading, say)
    kept = keep_probability(look.probability, output_paths(out_dir, task.stem))
    if kept and not look.mask.roads.any():
        raise MaskError(f"{task.mask}: no road is seen in it that is probable enough; wrote {kept[0]}, to look at")
    scene, graph = trace_query(look.mask)
    photo = None if look.probability is None else task.mask
    files = write_vectorized(
        out_dir, task.stem, look.mask, graph, scene.intersections, coarser=look.coarser, photo=photo
    )
    counts = f"{counted(len(scene.intersections), 'intersection')}, {counted(graph.n_edges, 'road')} between them"
    counts += f"; read {look.part}" if look.part else ""
    return f"{counts}; wrote {', '.join(map(str, files + kept))}"
