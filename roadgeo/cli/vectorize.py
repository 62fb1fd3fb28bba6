"""`roadgeo vectorize`: what the program sees in a mask, for a person to look at."""

from __future__ import annotations

import click

from roadgeo._text import visible
from roadgeo.cli import ERROR
from roadgeo.cli.folders import make_folder
from roadgeo.cli.parameters import out_dir_option
from roadgeo.cli.printing import echo
from roadgeo.running.tasks import find_masks, name_tasks

__all__ = ["vectorize_command"]


@click.command("vectorize", short_help="Show what roads are seen in a mask.")
@click.argument("masks", metavar="MASK...", nargs=-1, required=True, type=click.Path())
@out_dir_option()
@click.option("--threshold", metavar="T", type=float, help="Values above T are road. Default: told by the values.")
@click.option(
    "--band", metavar="N", type=click.IntRange(1), help="Band that holds the mask. Default: told by the bands."
)
def vectorize_command(masks: tuple[str, ...], out_dir: str, threshold: float | None, band: int | None) -> int:
    """Show what roads and intersections the program sees in MASKs: the first thing to look at when one was not located.

    For photo_mask.tif it writes photo_mask_vectorized.gpkg, in pixel coordinates, which lies on the mask when both are
    opened in QGIS, and photo_mask_vectorized.png.

    \b
    Examples:
      roadgeo vectorize photo_mask.tif
      roadgeo vectorize probability.tif --band 2 --threshold 0.4 --out-dir seen
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.errors import RoadgeoError
    from roadgeo.matching.query import trace_query
    from roadgeo.outputs.vectorized import write_vectorized
    from roadgeo.sources.masks import read_mask

    make_folder(out_dir)
    compile_once(quiet=False)
    status = 0
    for task in name_tasks(find_masks(masks)):
        try:
            mask = read_mask(task.mask, band=band, threshold=threshold)
            scene, graph = trace_query(mask)
            files = write_vectorized(out_dir, task.stem, mask, graph, scene.intersections)
        except RoadgeoError as error:
            echo(f"Error: {error}", err=True)
            status = ERROR
            continue
        except Exception as error:  # of a library: nothing wrong with one mask stops the others
            what = visible(f"{task.mask}: {type(error).__name__}: {error}")
            echo(f"Error: {what}; this is a fault of roadgeo, please report it", err=True)
            status = ERROR
            continue
        seen = f"{len(scene.intersections)} intersections, {graph.n_edges} roads between them"
        echo(visible(f"{task.mask}: {seen}; wrote {', '.join(map(str, files))}"))
    return status
