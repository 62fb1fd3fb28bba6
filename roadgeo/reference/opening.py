"""References of any kind: opened by their path or name, and the questions to several together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

from roadgeo._progress import Say, say_nothing
from roadgeo.reference.library import resolve_reference, resolve_references
from roadgeo.reference.reference import Reference, open_whole
from roadgeo.reference.shards import ShardedReference, manifest_path, open_shards

__all__ = ["AnyReference", "digest_of", "open_reference", "open_references", "say_swapped", "swapped_near"]

#: The middle of a frame that shows the edge of a map lies no farther off it than this.
_BEYOND_M = 3000.0

#: One piece, or shards.
AnyReference: TypeAlias = Reference | ShardedReference


def digest_of(references: Sequence[AnyReference], name: str) -> str:
    """Return the digest of the reference of that name; of all where none has it, for they were searched in vain."""
    here = [reference for reference in references if reference.name == name][:1] or references
    return ", ".join(reference.digest for reference in here if reference.digest)


def swapped_near(
    near: tuple[float, float, float], references: Sequence[AnyReference]
) -> tuple[float, float, float] | None:
    """Return a circle (longitude, latitude, metres) the other way round, where only then it touches one of the maps.

    A frame whose middle lies off a map may still show its edge.
    """
    lon, lat, radius = near
    if abs(lon) > 90.0 or _touches((lon, lat, radius + _BEYOND_M), references):
        return None
    return (lat, lon, radius) if _touches((lat, lon, radius), references) else None


def say_swapped(near: tuple[float, float, float] | None, references: Sequence[AnyReference]) -> str:
    """Say which circle was meant by one that lies on none of the maps but the other way round; "" of others."""
    if near is None or (meant := swapped_near(near, references)) is None:
        return ""
    given, other = (",".join(f"{number:.9g}" for number in circle) for circle in (near, meant))
    return f"near={given} lies on none of the maps; longitude comes first: did you mean near={other}?"


def _touches(near: tuple[float, float, float], references: Sequence[AnyReference]) -> bool:
    return any(part.may_hold(near) for one in references for part in one.parts)


def open_reference(path: str | Path, say: Say = say_nothing) -> AnyReference:
    """Open a reference: REF.gpkg with its REF.index, REF.shards, also at a URL, or one of the library by its name.

    A missing index, or one of an earlier format, is built from the GeoPackage. For shards only the manifest is read;
    each is opened when it is first searched.

    >>> roadgeo.open_reference("porto.gpkg").name
    'porto'

    Raises
    ------
    IndexFormatError
        If there is no such reference, or it is damaged, hostile, stale or of another version.
    """
    resolved = resolve_reference(path)
    manifest = manifest_path(resolved) if resolved.is_dir() else None
    return open_whole(resolved, say) if manifest is None else open_shards(manifest)


def open_references(names: Iterable[str], say: Say = say_nothing) -> list[AnyReference]:
    """Open references by path or name; none named: all of the library. `say` is called if an index has to be built.

    Raises
    ------
    IndexFormatError
        A reference is missing or unusable, or the library is empty.
    """
    return [open_reference(path, say) for path in resolve_references(names)]
