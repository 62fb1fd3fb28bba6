"""Masks on a map that is divided among the workers of a cluster, for maps that no machine holds.

A part of the map, a shard or a whole reference, belongs to the worker for which a hash of the two is greatest
(rendezvous hashing): where a worker goes, its parts go to the others; all others stay where they were fetched. Masks
are read, traced and written where the batch was started. For each mask

1. each worker takes a quick look at its parts;
2. where no worker locates it, each worker searches its parts as thoroughly as was asked;
3. the parts that hold places which may be reported are searched together, by the worker whose place is the best: they
   are judged as the maps of a library are.

Places pay for the whole map in all three. A mask that no worker finds is refused with the words of the worker that came
nearest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from roadgeo.errors import RoadgeoError
from roadgeo.location import Location
from roadgeo.matching.methods import may_show, search_references
from roadgeo.matching.scene import Query, read_query
from roadgeo.matching.search import Ahead
from roadgeo.matching.triples import larger
from roadgeo.matching.verdict import decide
from roadgeo.matching.veto import contest
from roadgeo.reference.opening import open_references
from roadgeo.reference.shards import Shard
from roadgeo.running.cluster import Cluster, DaskWorkers
from roadgeo.running.locating import Locating, Outcome
from roadgeo.running.pool import Lost
from roadgeo.running.tasks import Task

if TYPE_CHECKING:
    from roadgeo.geometry.mask import RoadMask
    from roadgeo.matching.options import LocateOptions
    from roadgeo.matching.parts import Part
    from roadgeo.reference.opening import AnyReference

__all__ = ["owners", "run_divided"]

#: Seconds of work of the first look, on a map of 15,000 intersections: nearly all masks that are found need less.
_FIRST_LOOK_S = 0.1

#: Places that score less than an answer needs by no more than this are searched again, together: they may be rivals.
_BELOW = 2.0

#: Masks under way: while one is traced or written, workers search for the others.
_AHEAD = 3


def owners(parts: Sequence[str], workers: Sequence[str]) -> dict[str, list[str]]:
    """Return the parts of each worker that has any."""
    owned: dict[str, list[str]] = {}
    for part in parts:
        owner = max(workers, key=lambda worker: blake2b(f"{worker} {part}".encode()).digest())
        owned.setdefault(owner, []).append(part)
    return owned


class _Parts(NamedTuple):
    """Parts to search, best by one worker; all places are less likely by `against` (log10), for the rest of the map."""

    worker: str
    query: Query
    names: Sequence[str]
    options: LocateOptions
    against: float


class _PartAnswer(NamedTuple):
    """The result of the search of parts, and which of them hold places that may be reported, or be rivals."""

    location: Location
    strong: Sequence[str]


def run_divided(tasks: Sequence[Task], locating: Locating, cluster: Cluster) -> Iterator[Outcome]:
    """Locate masks on a map that is divided among workers; yield the outcomes in order.

    Raises
    ------
    RoadgeoError
        As for `Cluster.run`.
    """
    asked, options = locating.ask(), locating.options.search
    parts = _parts_of(asked.references)
    able = {name: part for name, part in parts.items() if may_show(part, options, math.inf)} or parts
    sizes = {name: _size(part) for name, part in able.items()}
    with cluster.connected(_Map(locating.references)) as workers, Ahead(_AHEAD) as ahead:
        locate = partial(_locate, workers, sizes)
        yield from ahead.map(lambda task: locating.do(task, asked, locate), tasks)


def _parts_of(references: Sequence[AnyReference]) -> dict[str, Part]:
    """Return all parts by their names: the number of the reference, and that of the part."""
    return {f"{k}/{n}": part for k, reference in enumerate(references) for n, part in enumerate(reference.parts)}


def _size(part: Part) -> int:
    """Return how many intersections a part has; a shard is not opened."""
    return part.entry.own_intersections if isinstance(part, Shard) else len(part.open())


def _locate(
    workers: DaskWorkers,
    sizes: Mapping[str, int],
    mask: RoadMask,
    references: Sequence[AnyReference],
    options: LocateOptions,
) -> Location:
    """Search all parts of a map for a mask (see `passes.Locate`).

    Raises
    ------
    RoadgeoError
        Workers died of it, one after another, or the scheduler, or all workers, went away.
    """
    query = read_query(mask)
    # Each of the three searches may take the time limit: waiting for a worker that is busy with other masks is no part.
    limits = replace(options.search, time_limit_s=max(options.search.time_limit_s - query.seconds.vectorize, 0.0))
    options = replace(options, search=limits)

    def search(searched: Mapping[str, Sequence[str]], options: LocateOptions) -> dict[str, _PartAnswer]:
        asked = []
        for worker, names in searched.items():
            share = larger(sum(sizes.values())) / larger(sum(sizes[name] for name in names))
            against = 2.0 * math.log10(share)  # as in `Rivals`, for the whole map
            asked.append(_Parts(worker, query, names, options, against))
        return dict(zip(searched, workers.run(asked), strict=True))

    all_parts = owners(list(sizes), workers.names())
    least_work = replace(options.search, work_limit_s=min(options.search.work_limit_s, _FIRST_LOOK_S))
    answers = search(all_parts, replace(options, effort="quick", search=least_work))
    if not any(answer.location.located for answer in answers.values()):
        answers = search(all_parts, options)
    locations = {worker: answer.location for worker, answer in answers.items()}
    nearest = max(locations, key=lambda worker: _rank(locations[worker]))
    if locations[nearest].status == "not_located":
        return _refused_by_all(locations[nearest], list(locations.values()), references)
    strong = {name for answer in answers.values() for name in answer.strong}
    # A place so weak that its part is not named may be ambiguous all the same: then all of its share is searched.
    chosen = [name for name in sizes if name in strong] or all_parts[nearest]
    return search({nearest: chosen}, options)[nearest].location


def _rank(location: Location) -> tuple[bool, float]:
    odds = location.log10_odds
    return location.status != "not_located", -math.inf if odds is None else odds


def _refused_by_all(refusal: Location, others: Sequence[Location], references: Sequence[AnyReference]) -> Location:
    """Return the refusal of the worker that came nearest as one of all maps."""
    owed = dict.fromkeys(name for location in others for name in location.attribution.split("; ") if name)
    refusal = replace(refusal, attribution="; ".join(owed))
    names = ", ".join(dict.fromkeys(reference.name for reference in references))
    if names == refusal.reference:
        return refusal
    reason = refusal.reason.partition(" (looked on ")[0]
    return replace(refusal, reference=names, reason=f"{reason} (looked on {names})")


# --- on a worker ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Map:
    """The references whose parts are searched; travels to the workers."""

    references: tuple[str, ...]

    def prepare(self) -> Callable[[_Parts], _PartAnswer]:
        """Open the references, none of their shards."""
        return partial(_search, _parts_of(open_references(self.references)))

    def give_up(self, task: _Parts, lost: Lost) -> _PartAnswer:
        """Refuse to answer without a part of the map."""
        raise RoadgeoError(f"{task.query.name}: a part of the map has no answer: {lost.said}")


def _search(named: Mapping[str, Part], asked: _Parts) -> _PartAnswer:
    """Search parts together."""
    query, options = asked.query, asked.options
    parts = {name: named[name] for name in asked.names}
    here, limit_s = list(parts.values()), options.search.time_limit_s
    searched = contest(query, search_references(query, here, options, limit_s), here, options, limit_s)
    searched = [result.less_likely(asked.against) for result in searched]
    least = options.min_log10_odds - _BELOW
    strong = {Path(place.index.path) for result in searched for place in result.compared if place.score >= least}
    return _PartAnswer(decide(query, searched, options), [name for name in parts if _path(parts[name]) in strong])


def _path(part: Any) -> Path:
    """Return where a part lies, which is not opened."""
    return getattr(part, "path", None) or Path(part.index.path)
