"""Road sources, segmenters and outputs that installed packages offer as entry points; roadgeo's own are found so too.

A source takes a location and `say`, which it may call while it waits, and returns `roadgeo.sources.roads.Roads`.
A segmenter takes the path of a photograph and returns a `roadgeo.RoadMask`, or an array that
`roadgeo.sources.masks.read_mask` takes. An output is a `roadgeo.outputs.registry.Output`. `examples/plugin` has one of
each.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib import metadata
from importlib.metadata import Distribution, EntryPoint, EntryPoints
from typing import Any

from roadgeo.errors import PluginError, RoadgeoError

__all__ = [
    "GROUPS",
    "OUTPUTS",
    "SEGMENTERS",
    "SOURCES",
    "call_plugin",
    "find_plugins",
    "load_plugin",
]

GROUPS = SOURCES, SEGMENTERS, OUTPUTS = "roadgeo.sources", "roadgeo.segmenters", "roadgeo.outputs"


def find_plugins(group: str) -> dict[str, EntryPoint]:
    """Find the plugins of a group, by name; nothing is imported. Where names clash, our own comes first."""
    offered = sorted(entry_points(group=group), key=lambda entry: (package_of(entry) != "roadgeo", package_of(entry)))
    return {item.name: item for item in reversed(offered)}


def entry_points(group: str) -> EntryPoints:
    """Return all entry points of a group, which are read once in a process: 20 ms where 150 packages are installed."""
    return _entry_points(group, tuple(sys.path))


@lru_cache(maxsize=16)
def _entry_points(group: str, _: tuple[str, ...]) -> EntryPoints:
    return metadata.entry_points(group=group)


def package_of(plugin: EntryPoint) -> str:
    """Name the package that offers a plugin."""
    return _name(plugin.dist) if plugin.dist else ""


@lru_cache(maxsize=64)
def _name(package: Distribution) -> str:
    """Name a package: read once for all that it offers, for its whole description is parsed for it."""
    return package.name


def load_plugin(group: str, name: str) -> Any:
    """Import what a name stands for.

    Raises
    ------
    PluginError
        No plugin has that name, or it cannot be imported.
    """
    plugins = find_plugins(group)
    if name not in plugins:
        raise PluginError(
            f"no {name!r} among the {group}, expected one of {', '.join(sorted(plugins))}; is it installed?"
        )
    try:
        return plugins[name].load()
    except Exception as error:
        raise PluginError(f"{_describe(plugins[name])} cannot be loaded: {type(error).__name__}: {error}") from error


def call_plugin(group: str, name: str, *arguments: Any, **options: Any) -> Any:
    """Call what a name stands for.

    Raises
    ------
    PluginError
        As for `load_plugin`, or it fails with an error of its own.
    """
    plugin = load_plugin(group, name)
    try:
        return plugin(*arguments, **options)
    except RoadgeoError:
        raise
    except Exception as error:
        said = _describe(find_plugins(group)[name])
        raise PluginError(f"{said} failed: {type(error).__name__}: {error}; inform its makers") from error


def _describe(plugin: EntryPoint) -> str:
    return f"{plugin.name!r} of {plugin.group} from {package_of(plugin) or 'an unknown package'}"
