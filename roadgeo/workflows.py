"""The two straight lines: roads to a reference, and a mask to a place on it."""

from __future__ import annotations

import os
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
from roadgeo.matching.methods import Found, search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import Query, read_query
from roadgeo.matching.verdict import decide
from roadgeo.reference.reference import AnyReference, BuildOptions, Reference, open_whole
from roadgeo.roads.kinds import RoadKind
from roadgeo.roads.network import build_network

if TYPE_CHECKING:
    import geopandas as gpd

    from roadgeo.sources.roads import Roads

__all__ = ["LocateOptions", "build_reference", "explain", "locate"]


# --- roads to a reference ---------------------------------------------------------------------------------------------


def build_reference(
    roads: Roads | gpd.GeoDataFrame | str | os.PathLike[str],
    name: str = "",
    options: BuildOptions | None = None,
    *,
    path: str | Path | None = None,
    kinds: RoadKind = "drivable",
    tunnels: bool = False,
    attribution: str | None = None,
    say: Say = say_nothing,
) -> Reference:
    """Build a reference from road lines, as `roadgeo index` does.

    Parameters
    ----------
    roads : Roads, GeoDataFrame or path
        Lines in any CRS; a path is a road file or a folder of them.
    name : str
        Name of the reference.
    path : path, optional
        Write it there, and open it from there.
    kinds, tunnels
        Kinds of roads to take from a table or a file, where it has kinds; `Roads` are taken as they are.
    attribution : str, optional
        Attribution beside the map, where the roads have none.

    Raises
    ------
    CrsError, RoadSourceError
        No CRS; no lines; fewer than three intersections.
    OutputError
        It cannot be written.
    """
    from roadgeo.sources.roads import choose_roads

    chosen = choose_roads(roads, kinds, tunnels, attribution, say)
    warm_up(say, map_only=True)
    options = options or BuildOptions()
    meta = {"name": name, **chosen.meta}
    network = build_network(chosen.lines, chosen.plane, meta, options, say, names=chosen.names, kinds=chosen.kinds)
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
) -> Location:
    """Find where a road mask lies on one of the references.

    Pure: no file is written. A mask that is not found is a `Location` with a reason, not an error.

    Raises
    ------
    MaskError
        The mask cannot be read or shows no roads.
    """
    options, references = options or LocateOptions(), _as_list(reference)
    query = _read(mask)
    return decide(query, _search(query, references, options), options)


def explain(
    mask: RoadMask | AnyArray | str | Path,
    reference: AnyReference | Sequence[AnyReference],
    options: LocateOptions | None = None,
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
    options, references = options or LocateOptions(), _as_list(reference)
    query = _read(mask)
    found = _search(query, references, options, explained=True)
    stories = tuple(tell(query, one, options) for one in found)
    return Explanation(decide(query, found, options), query.scene, query.graph, stories)


def _as_list(reference: AnyReference | Sequence[AnyReference]) -> list[AnyReference]:
    references = list(reference) if isinstance(reference, Sequence) else [reference]
    if not references:
        raise RoadSourceError("no reference to search: build one with `roadgeo index`")
    return references


def _read(mask: RoadMask | AnyArray | str | Path) -> Query:
    warm_up()
    return read_query(mask)


def _search(
    query: Query,
    references: Sequence[AnyReference],
    options: LocateOptions,
    explained: bool = False,
) -> list[Found]:
    """Search all references together, within the time that tracing left."""
    left = max(options.search.time_limit_s - query.seconds.vectorize, 0.0)
    parts = [part for one in references for part in one.parts]
    return search_references(query, parts, options, left, explained)
