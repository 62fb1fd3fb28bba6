"""`roadgeo reference`: descriptions of references, and a tidy library."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import click

from roadgeo._options import OTHERS, option, take
from roadgeo._text import visible
from roadgeo.cli import ERROR, Group
from roadgeo.cli.command_line import made_by
from roadgeo.cli.options import Once, Shared, argument, command
from roadgeo.cli.printing import complain, echo, is_set

__all__ = ["check_command", "info_command", "list_command", "list_plugins", "reference_command", "remove_command"]


#: Schema of the output of `info --json` and `list --json`.
SCHEMA = "roadgeo.reference-info/1"


@click.group("reference", cls=Group, short_help="List, describe, test and remove references.")
def reference_command() -> None:
    """List, describe, test and remove references: the maps that `roadgeo index` builds and `roadgeo locate` searches.

    \b
    Examples:
      roadgeo reference list
      roadgeo reference info boston-ma
      roadgeo reference check maps/*.gpkg
      roadgeo reference remove boston-ma
    """


@dataclass(frozen=True, kw_only=True)
class Info:
    """The parameters of `roadgeo reference info`."""

    reference: str = argument("REF")
    as_json: bool = take(Shared, "as_json", help="Print everything that is known as one JSON object.", group=OTHERS)


@command("info", Info, group=reference_command, short_help="Describe a reference.")
def info_command(asked: Info) -> None:
    """Describe a reference: a file (REF.gpkg or REF.index) or a name in the library.

    Reads a few kilobytes, whatever the size of the reference, and runs nothing that a file may carry.

    \b
    Examples:
      roadgeo reference info boston-ma
      roadgeo reference info maps/porto.gpkg --json
    """
    from roadgeo.reference.inspection import describe_reference
    from roadgeo.reference.library import resolve_reference

    described = describe_reference(resolve_reference(asked.reference))
    if is_set("as_json"):
        echo(json.dumps({"schema": SCHEMA, **made_by(), **described}, indent=2))
        return
    width = max(len(label) for label, _ in _lines(described))
    for label, value in _lines(described):
        echo(f"{label:<{width}}  {visible(value)}")


def list_plugins() -> None:
    """Print the plugins that are installed: group, name, package, object."""
    from roadgeo.plugins import GROUPS, find_plugins

    installed = [plugin for group in GROUPS for _, plugin in sorted(find_plugins(group).items())]
    lines = [
        (plugin.group, plugin.name, f"{plugin.dist.name} {plugin.dist.version}" if plugin.dist else "", plugin.value)
        for plugin in installed
    ]
    widths = [max((len(line[i]) for line in lines), default=0) for i in range(3)]
    for line in lines:
        echo("  ".join([*(text.ljust(width) for text, width in zip(line, widths, strict=False)), line[3]]))


@dataclass(frozen=True, kw_only=True)
class Check:
    """The parameters of `roadgeo reference check`."""

    references: tuple[str, ...] = argument("REF...", many=True)


@command("check", Check, group=reference_command, short_help="Test whether the files of references are sound.")
def check_command(asked: Check) -> int:
    """Verify references thoroughly: all digests, all ranges, and that index and GeoPackage agree.

    `roadgeo locate` checks enough to be safe each time it opens a reference; this checks all, and takes longer.
    Status 1 if anything is wrong.

    \b
    Examples:
      roadgeo reference check boston-ma
      roadgeo reference check maps/*.gpkg
    """
    from roadgeo.errors import RoadgeoError
    from roadgeo.reference.inspection import check_reference
    from roadgeo.reference.library import resolve_reference

    status = 0
    for reference in asked.references:
        try:
            problems = check_reference(resolve_reference(reference))
        except RoadgeoError as error:
            problems = [str(error)]
        for problem in problems:
            complain(str(problem))
        if problems:
            status = ERROR
        else:
            echo(visible(f"{reference}: sound"))
    return status


@dataclass(frozen=True, kw_only=True)
class List:
    """The parameters of `roadgeo reference list`."""

    as_json: bool = take(Shared, "as_json", help="Print one JSON object per reference and line.", group=OTHERS)


@command("list", List, group=reference_command, short_help="List the references in the library.")
def list_command(_: List) -> int:
    """List the references in the library, which `roadgeo locate` searches without --reference.

    The library is a folder of the user's data; the environment variable ROADGEO_LIBRARY names another.

    \b
    Examples:
      roadgeo reference list
      roadgeo reference list --json
    """
    from roadgeo.errors import RoadgeoError
    from roadgeo.reference.inspection import describe_reference
    from roadgeo.reference.library import library_dir, list_references

    paths = list_references()
    if not paths:
        echo(f"The library in {library_dir()} is empty; `roadgeo index` adds to it.", err=True)
    width = max((len(path.stem) for path in paths), default=0)
    status = 0
    for path in paths:
        try:
            described = describe_reference(path)
        except RoadgeoError as error:
            complain(str(error))
            status = ERROR
            continue
        whole = {"schema": SCHEMA, **made_by(), **described}
        echo(json.dumps(whole) if is_set("as_json") else visible(f"{path.stem:<{width}}  {_summary(described)}"))
    return status


@dataclass(frozen=True, kw_only=True)
class Remove:
    """The parameters of `roadgeo reference remove`."""

    names: tuple[str, ...] = argument("NAME...", many=True, type=None)
    yes: bool = option("-y --yes", "", OTHERS, "Do not ask.")


@command("remove", Remove, Once, group=reference_command, short_help="Remove references from the library.")
def remove_command(asked: Remove) -> None:
    """Delete references from the library, both files of each.

    \b
    Examples:
      roadgeo reference remove boston-ma
      roadgeo reference remove boston-ma porto --yes
    """
    from roadgeo.reference.library import library_dir, remove_reference, shelved_files

    for name in asked.names:
        shelved_files(name)  # a reference that is not there is not asked about
    if not asked.yes:
        click.confirm(f"Delete {', '.join(asked.names)} from {library_dir()}?", abort=True, err=True)
    for name in asked.names:
        for path in remove_reference(name):
            echo(f"removed {path}")


def _lines(described: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and value of the main properties."""
    meta, counts = described.get("meta", {}), described.get("counts", {})
    size, crs = sum(described["files"].values()), str(described.get("crs"))
    lines = [
        ("name", str(described["name"])),
        ("files", ", ".join(described["files"])),
        ("size", f"{size / 1e6:.1f} MB"),
        ("state", _STATES[described["freshness"]]),
        ("CRS", crs.split('"')[1] if '"' in crs else crs),  # of a plane of our own the name, first in its WKT2
        ("intersections", f"{counts.get('intersections', 0):,}"),
        *([("roads", _road_text(described))] if "roads" in counts else []),
    ]
    if shards := described.get("shards"):
        lines.append(("shards", _shards_text(shards)))
    if described.get("area_km2"):
        lines.append(("area", f"{described['area_km2']:,.0f} km²"))
        lines.append(("density", f"{described['intersections_per_km2']:.0f} intersections per km²"))
    if described.get("memory_bytes"):
        lines.append(("memory", f"{described['memory_bytes'] / 1e6:.1f} MB, mapped"))
    texts = {key: value for key, value in meta.items() if isinstance(value, str) and key != "name"}
    if "roads" in texts:
        texts["roads"] = _kinds_text(texts["roads"], meta.get("sources") or [])
    return lines + [("kinds" if key == "roads" else key, value) for key, value in texts.items()]


def _kinds_text(kinds: str, sources: Any) -> str:
    """Return which kinds were taken, and of which sources all lines, because they have no kinds of roads."""
    stating = [source for source in sources if isinstance(source, dict) and "kinds_known" in source]
    unknown = [visible(str(source.get("name"))) for source in stating if source["kinds_known"] is False]
    if not unknown:
        return kinds
    names = ", ".join(unknown)
    return (
        f"not known, all lines of {names} were taken"
        if len(unknown) == len(stating)
        else f"{kinds}; of {names} all lines"
    )


_STATES = {
    "fresh": "ready",
    "stale": "stale: the GeoPackage was edited; `roadgeo index --rebuild` builds the index again",
    "no index": "no index: it is built when the reference is first used",
    "old format": "index of an earlier roadgeo: it is built again when the reference is next used",
    "no GeoPackage": "ready; the GeoPackage is missing",
    "shards missing": "shards are missing; `roadgeo index --shards` builds them again",
}


def _road_text(described: dict[str, Any]) -> str:
    count = f"{described.get('counts', {}).get('roads', 0):,}"
    return f"{count}, {described['road_km']:,.0f} km" if "road_km" in described else count


def _shards_text(shards: dict[str, Any]) -> str:
    largest = f"the largest of {shards['largest']:,} intersections"
    coarse = f", and a coarse map of {shards['coarse']:,}" if shards["coarse"] else ""
    return f"{shards['count']:,}, {largest}, with margins of {shards['margin_m'] / 1e3:g} km{coarse}"


def _summary(described: dict[str, Any]) -> str:
    counts = described.get("counts", {})
    parts = [f"{counts.get('intersections', 0):>9,} intersections"]
    if described.get("area_km2"):
        parts.append(f"{described['area_km2']:>9,.0f} km²")
    parts.append(f"{sum(described['files'].values()) / 1e6:>8.1f} MB")
    state = described["freshness"]
    return "  ".join(parts) + ("" if state == "fresh" else f"  {state}")
