"""Masks on a map that is divided among the workers of a cluster, for maps that no machine holds.

A part of the map, a shard or a whole reference, belongs to the worker for which a hash of the two is greatest
(rendezvous hashing): where a worker goes, its parts go to the others; all others stay where they were fetched. Tasks
under way when a worker died are sent once more. For a group of masks

1. each worker takes a quick look for every mask on its parts;
2. masks that no worker located are searched for on all parts, as thoroughly as was asked;
3. the parts that hold places which may be reported are searched together, by the worker of the best of them, which
   writes the results: one rule of odds, margin and twins over the whole map.

In all three a place is charged as if all parts had been searched in one process (`LocateOptions.elsewhere`). A mask
that no worker finds is refused with the words of the one that came nearest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roadgeo.errors import IndexFormatError
from roadgeo.location import Location
from roadgeo.matching.methods import may_show, search_references
from roadgeo.matching.verdict import decide
from roadgeo.reference.shards import ShardedReference
from roadgeo.running.batch import Asked, Locating, Outcome, open_references
from roadgeo.running.cluster import RETRIES, Cluster, Made, Stream, connected, prepared
from roadgeo.running.queries import locate_query
from roadgeo.running.tasks import Task

if TYPE_CHECKING:
    from roadgeo.geometry.mask import RoadMask
    from roadgeo.matching.options import LocateOptions
    from roadgeo.matching.parts import Part
    from roadgeo.reference.reference import AnyReference

__all__ = ["Ballot", "Vote", "count", "owners", "run_divided"]

#: Seconds of work of the first look, on a map of 15,000 intersections: nearly all masks that are found need less.
_FIRST_LOOK_S = 0.1

#: Seconds after which it is looked whether all workers live that a group waits for.
_LOOK_AGAIN_S = 2.0


@dataclass(frozen=True)
class Vote:
    """The result of the search of one share of the map for a mask.

    Attributes
    ----------
    places : tuple of (float, str)
        Log10 odds of places that may be reported, or be rivals of one that is, and the parts that they lie on.
    answer : Location or None
        None: the mask cannot be searched for, or was left alone.
    missing : str
        The fault of a part that cannot be opened.
    """

    places: tuple[tuple[float, str], ...] = ()
    answer: Location | None = None
    missing: str = ""


@dataclass(frozen=True)
class Ballot:
    """The result of all shares together for a mask.

    Attributes
    ----------
    parts : tuple of str
        To be searched together, that of the best place first; one where there is no place.
    located : bool
        Whether a share has one.
    refusal : Location or None
        Of the share that came nearest, where none has a place.
    missing : str
        The fault of a part of the map, which was not searched: then the mask has no answer.
    """

    parts: tuple[str, ...]
    located: bool = False
    refusal: Location | None = None
    missing: str = ""


def count(votes: Sequence[Vote], shares: Sequence[Sequence[str]]) -> Ballot:
    """Count the votes of all shares for one mask."""
    missing = next((vote.missing for vote in votes if vote.missing), "")
    if missing:
        return Ballot((shares[0][0],), missing=missing)
    answers = [vote.answer for vote in votes]
    found = [k for k, answer in enumerate(answers) if answer is not None and answer.status != "not_located"]
    if found:
        places = sorted((place for vote in votes for place in vote.places), reverse=True)
        # A place so weak that its part is not named may be ambiguous all the same: then all of its share is searched.
        chosen = tuple(dict.fromkeys(part for _, part in places)) or tuple(shares[found[0]])
        return Ballot(chosen, any(answer is not None and answer.located for answer in answers))
    nearest = max(range(len(votes)), key=lambda k: _odds(answers[k]))
    refusal = answers[nearest]
    owed = dict.fromkeys(one for answer in answers if answer for one in answer.attribution.split("; ") if one)
    refusal = None if refusal is None else replace(refusal, attribution="; ".join(owed))
    return Ballot((shares[nearest][0],), refusal=refusal)


def _odds(answer: Location | None) -> float:
    if answer is None:
        return -math.inf
    return -1e300 if answer.log10_odds is None else answer.log10_odds


def owners(parts: Sequence[str], workers: Sequence[str]) -> dict[str, list[str]]:
    """Return the parts of each worker that has any."""
    owned: dict[str, list[str]] = {}
    for part in parts:
        owner = max(workers, key=lambda worker: blake2b(f"{worker} {part}".encode()).digest())
        owned.setdefault(owner, []).append(part)
    return owned


# --- where the batch was started --------------------------------------------------------------------------------------


def run_divided(tasks: Sequence[Task], locating: Locating, cluster: Cluster) -> Iterator[Outcome]:
    """Locate masks on a map that is divided among workers; yield the outcomes in order.

    Raises
    ------
    RoadgeoError
        As for `cluster.run_on_cluster`.
    """
    options = locating.options.search
    parts = _parts_of(open_references(locating.references))
    able = {name: part for name, part in parts.items() if may_show(part, options, math.inf)} or parts
    work = _Division(locating, {name: _size(part) for name, part in able.items()})
    with connected(cluster) as client:
        yield from _DividedStream(client, work, cluster.together).results(tasks)


def _parts_of(references: Sequence[AnyReference]) -> dict[str, Part]:
    """Return all parts by their names: the number of the reference, and of a sharded one the shard."""
    named: dict[str, Part] = {}
    for k, one in enumerate(references):
        if isinstance(one, ShardedReference):
            named.update({f"{k}/{part.entry.name}": part for part in one.parts})
        else:
            named[f"{k}/"] = one.parts[0]
    return named


def _size(part: Part) -> int:
    """Return how many intersections a part has; a shard is not opened."""
    entry = getattr(part, "entry", None)
    return len(part.open()) if entry is None else int(entry.own_intersections)


@dataclass(frozen=True)
class _Sent:
    """A group of masks under way: its future, the workers that must live, and how often it was sent before."""

    futures: Sequence[Any]
    group: Sequence[Any]
    workers: frozenset[str]
    again: int


class _DividedStream(Stream):
    """Sends every group of masks to all workers."""

    died = "the workers that hold parts of the map died, again and again"

    def _send(self, group: Sequence[Any], again: int = 0) -> Any:
        work: _Division = self.work
        shares = owners(list(work.sizes), sorted(self.client.nthreads()) or [""])
        all_shares = list(shares.values())

        def on_each(do: Any, *more: Any) -> list[Any]:
            # There and nowhere else: were it allowed, idle workers would take shares over, and fetch them.
            where = {"allow_other_workers": False, "pure": False, "retries": RETRIES}
            sent = (self.made, list(group))
            return [self.client.submit(do, *sent, share, *more, workers=[at], **where) for at, share in shares.items()]

        looked = self.client.submit(_count_all, all_shares, *on_each(_vote_all, True, None), pure=False)
        voted = self.client.submit(_count_all, all_shares, *on_each(_vote_all, False, looked), pure=False)
        futures = on_each(_finish_all, self.client.submit(_decided, looked, voted, pure=False))
        return _Sent(futures, group, frozenset(shares), again)

    def _results_of(self, future: Any) -> list[Any] | None:
        sent: _Sent = future
        found: dict[int, Outcome] = {}
        left = list(sent.futures)
        while left:
            try:
                found.update(left[-1].result(timeout=_LOOK_AGAIN_S))
                left.pop()
            except TimeoutError:
                if sent.workers <= set(self.client.nthreads()):
                    continue
                # A worker is gone, and nobody else may do what it was to do: all of the group is sent once more.
                self.client.cancel(sent.futures)
                if sent.again == RETRIES:
                    return None
                return self._results_of(self._send(sent.group, sent.again + 1))
        return [found[k] for k in range(len(found))]


# --- on a worker ------------------------------------------------------------------------------------------------------


def _vote_all(
    made: Made, tasks: Sequence[Task], share: Sequence[str], first: bool, ballots: Sequence[Ballot] | None
) -> list[Vote]:
    """Search for masks on a share; those that were located already are left alone."""
    voter: _Voter = prepared(made)
    done = [ballot.located for ballot in ballots] if ballots else [False] * len(tasks)
    return [Vote() if is_done else voter.vote(task, share, first) for task, is_done in zip(tasks, done, strict=True)]


def _count_all(shares: Sequence[Sequence[str]], *votes: Sequence[Vote]) -> list[Ballot]:
    """Count the votes of all shares for each mask of a group."""
    return [count(of_mask, shares) for of_mask in zip(*votes, strict=True)]


def _decided(looked: Sequence[Ballot], voted: Sequence[Ballot]) -> list[Ballot]:
    """Return the ballot of the first look for each mask that was located then, else of the search."""
    return [one if one.located else other for one, other in zip(looked, voted, strict=True)]


def _finish_all(
    made: Made, tasks: Sequence[Task], share: Sequence[str], ballots: Sequence[Ballot]
) -> dict[int, Outcome]:
    """Write the results of the masks whose best place lies on a share; return the outcomes by the masks' numbers."""
    voter: _Voter = prepared(made)
    return {
        k: voter.finish(task, ballot)
        for k, (task, ballot) in enumerate(zip(tasks, ballots, strict=True))
        if ballot.parts[0] in share
    }


@dataclass(frozen=True)
class _Division:
    """The work for every mask, and the parts of the map with their sizes; travels to the workers."""

    locating: Locating
    sizes: Mapping[str, int]

    def prepare(self) -> _Voter:
        """Open the references, none of their shards."""
        return _Voter(self, self.locating.ask())

    def give_up(self, task: Task, reason: str) -> Outcome:
        """Make the outcome of a mask that could not be worked on."""
        return self.locating.give_up(task, reason)


@dataclass(frozen=True)
class _Voter:
    """Searches for masks on parts of the map."""

    division: _Division
    asked: Asked

    @cached_property
    def names(self) -> dict[str, str]:
        """Names of all parts by their files."""
        return {_path(part): name for name, part in _parts_of(self.asked.references).items()}

    def vote(self, task: Task, share: Sequence[str], first: bool) -> Vote:
        """Search a share for a mask. A fault of the mask is reported when it is finished."""
        locating, places = self.division.locating, list[tuple[float, str]]()

        def how(mask: RoadMask, references: Sequence[AnyReference], options: LocateOptions) -> Location:
            from roadgeo.matching.scene import read_query

            query = read_query(mask)
            left = max(options.search.time_limit_s - query.seconds.vectorize, 0.0)
            found = search_references(query, [part for one in references for part in one.parts], options, left)
            least = options.min_log10_odds - options.min_margin
            fits = [fit for one in found for fit in one.fits if fit.log10_odds >= least]
            places.extend((fit.log10_odds, self.names[_path(fit.index)]) for fit in fits)
            return decide(query, found, options)

        try:
            if locating.earlier(task, self.asked) is not None:
                return Vote()
            options = self._on(locating.search_options(task), share)
            search = replace(options.search, work_limit_s=min(options.search.work_limit_s, _FIRST_LOOK_S))
            options = replace(options, effort="quick", search=search) if first else options
            reading = locating.reading.of_query()
            reading = replace(reading, mirror="allow" if reading.mirror == "allow" else "never")
            answer = locate_query(task.mask, self._only(share), options, reading, how=how).location
        except IndexFormatError as error:
            return Vote(missing=str(error))
        except Exception:
            return Vote()
        return Vote(tuple(places), answer)

    def finish(self, task: Task, ballot: Ballot) -> Outcome:
        """Search the parts that have places together, and write the results; write a refusal as it is."""
        locating = self.division.locating
        if ballot.missing:
            return locating.failed(task, "NO_REFERENCE", ballot.missing)
        search = self._on(locating.options.search, ballot.parts)
        locating = replace(locating, options=replace(locating.options, search=search))
        asked = replace(self.asked, references=self._only(ballot.parts))
        refusal = None if ballot.refusal is None else self._of_all(ballot.refusal)
        return locating.do(task, asked, None if refusal is None else lambda *_: refusal)

    def _of_all(self, refusal: Location) -> Location:
        """Return a share's refusal as one of all maps."""
        names = dict.fromkeys(
            one.name
            for k, one in enumerate(self.asked.references)
            if any(part.startswith(f"{k}/") for part in self.division.sizes)
        )
        if len(names) == 1:
            return refusal
        searched = ", ".join(names)
        reason = refusal.reason.partition(" (looked on ")[0]
        return replace(refusal, reference=searched, reason=f"{reason} (looked on {searched})")

    def _on(self, options: LocateOptions, share: Sequence[str]) -> LocateOptions:
        """Return options that charge places for the whole map."""
        sizes = self.division.sizes
        return replace(options, elsewhere=sum(sizes.values()) - sum(sizes[name] for name in share))

    def _only(self, share: Sequence[str]) -> list[AnyReference]:
        """Return the references with the parts of a share."""
        kept: list[AnyReference] = []
        for k, one in enumerate(self.asked.references):
            names = [name.partition("/")[2] for name in share if name.startswith(f"{k}/")]
            if names:
                kept.append(one.only(names) if isinstance(one, ShardedReference) else one)
        return kept


def _path(part: Any) -> str:
    """Return the file of a part, or of its index."""
    path = getattr(part, "path", None)
    return str(Path(part.index.path if path is None else path))
