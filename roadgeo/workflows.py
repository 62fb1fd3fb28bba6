"""The two straight lines: roads to a reference, and a mask to a place on it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import RoadSourceError
from roadgeo.geometry.mask import RoadMask
from roadgeo.kernels.warmup import warm_up
from roadgeo.location import Location
from roadgeo.matching.explanation import Explanation, tell
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import Searched, search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import Query, read_query
from roadgeo.matching.verdict import decide
from roadgeo.matching.veto import contest
from roadgeo.reference.opening import AnyReference
from roadgeo.reference.reference import BuildOptions, Reference, open_whole
from roadgeo.roads.network import build_network

if TYPE_CHECKING:
    from roadgeo.sources.roads import Roads

__all__ = ["LocateOptions", "build_reference", "explain", "locate"]


# --- roads to a reference ---------------------------------------------------------------------------------------------


def build_reference(
    roads: Roads,
    name: str = "",
    options: BuildOptions | None = None,
    *,
    path: str | Path | None = None,
    say: Say = say_nothing,
) -> Reference:
    """Build a reference from roads, as `roadgeo index` does; files and tables give them by `sources.roads`.

    Parameters
    ----------
    name : str
        Name of the reference.
    path : path, optional
        Write it there, and open it from there.

    Raises
    ------
    RoadSourceError
        Fewer than three intersections.
    OutputError
        It cannot be written.
    """
    warm_up(say, map_only=True)
    options = options or BuildOptions()
    meta = {"name": name, **roads.meta}
    network = build_network(roads.lines, roads.plane, meta, options, say, names=roads.names, kinds=roads.kinds)
    reference = Reference(build_index(network, options.index, say), network)
    if path is None:
        return reference
    reference.save(path, say)
    return open_whole(path)  # as `locate` has it: memory-mapped arrays are another type to compiled code


# --- a mask to a place ------------------------------------------------------------------------------------------------


def locate(
    mask: RoadMask | AnyArray | str | Path,
    reference: AnyReference | Sequence[AnyReference],
    options: LocateOptions | None = None,
    say: Say = say_nothing,
) -> Location:
    """Find where a road mask lies on one of the references.

    Pure: no file is written. A mask that is not found is a `Location` with a reason, not an error.

    Raises
    ------
    MaskError
        The mask cannot be read or shows no roads.
    """
    query, results, options = _search(mask, reference, options, say)
    return decide(query, results, options)


def explain(
    mask: RoadMask | AnyArray | str | Path,
    reference: AnyReference | Sequence[AnyReference],
    options: LocateOptions | None = None,
    say: Say = say_nothing,
) -> Explanation:
    """Locate a mask as `locate` does, and explain how far the search got, what it rejected and what was missing.

    >>> reference = roadgeo.open_reference("porto.gpkg")
    >>> explanation = roadgeo.explain("elsewhere.png", reference)
    >>> explanation.location.status
    'not_located'

    Raises
    ------
    MaskError
        The mask cannot be read or shows no roads.
    """
    query, results, options = _search(mask, reference, options, say, explained=True)
    stories = tuple(tell(query, one, options) for one in results)
    return Explanation(decide(query, results, options), query.scene, query.graph, stories)


def _search(
    mask: RoadMask | AnyArray | str | Path,
    reference: AnyReference | Sequence[AnyReference],
    options: LocateOptions | None,
    say: Say,
    explained: bool = False,
) -> tuple[Query, list[Searched], LocateOptions]:
    """Trace a mask, and search all references together for it, within the time that tracing left."""
    options = options or LocateOptions()
    references = list(reference) if isinstance(reference, Sequence) else [reference]
    if not references:
        raise RoadSourceError("no reference to search: build one with `roadgeo index`")
    warm_up()
    query = read_query(mask)
    left = max(options.search.time_limit_s - query.seconds.vectorize, 0.0)
    parts = [part for one in references for part in one.parts]
    if len(references) > 1:
        say(f"searching {len(references)} maps together")
    searched = search_references(query, parts, options, left, explained, say=say)
    return query, contest(query, searched, parts, options, left), options
