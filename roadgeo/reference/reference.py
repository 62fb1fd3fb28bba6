"""A reference in one piece: how it is built, opened and built again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import IndexFormatError, RoadSourceError
from roadgeo.kernels.triple_codes import MAX_NEIGHBOURS
from roadgeo.location import Location
from roadgeo.matching.index import COARSENESS, IndexOptions, ReferenceIndex, build_index
from roadgeo.matching.parts import Part, Whole
from roadgeo.roads.intersections import IntersectionOptions
from roadgeo.roads.network import NetworkOptions, RoadNetwork
from roadgeo.roads.simplification import SimplifyOptions
from roadgeo.storage.memory import let_pages_go

if TYPE_CHECKING:
    import networkx as nx

__all__ = [
    "COARSE",
    "BuildOptions",
    "Reference",
    "open_whole",
    "rebuild_reference",
    "stored_options",
]


@dataclass(frozen=True)
class BuildOptions(NetworkOptions):
    """Options of all stages of building a reference; lengths in metres."""

    index: IndexOptions = field(default_factory=IndexOptions)


#: Options of a coarse map, for images whose pixels show main roads alone.
COARSE = BuildOptions(simplify=SimplifyOptions().times(COARSENESS))


@dataclass(frozen=True)
class Reference:
    """A searchable road map: its index, and the network it was built from where that is at hand.

    `digest` is its intersections' digest, where it was opened from a file.
    """

    index: ReferenceIndex
    network: RoadNetwork | None = None
    digest: str = ""

    def __repr__(self) -> str:
        """Describe the reference in one line."""
        lies = self.index.path or "not written"
        return f"<Reference {self.name!r}: {len(self.index):,} intersections, {self.index.meta['crs']}, {lies}>"

    @property
    def name(self) -> str:
        """Its name for the user."""
        return self.index.name

    @property
    def parts(self) -> tuple[Part, ...]:
        """The references to search: itself."""
        return (Whole(self.index),)

    def index_of(self, location: Location) -> ReferenceIndex:  # noqa: ARG002 (there is one piece)
        """Return the index that a location is drawn with."""
        return self.index

    def indexes_at(self, places: Sequence[tuple[float, float]]) -> list[ReferenceIndex]:  # noqa: ARG002
        """Return the indexes that show places."""
        return [self.index]

    def to_networkx(self) -> nx.MultiGraph:
        """Return its roads as a networkx graph, in its CRS, as osmnx has them: see `RoadGraph.to_networkx`.

        >>> graph = roadgeo.open_reference("porto.gpkg").to_networkx()
        >>> graph.number_of_edges(), graph.graph["crs"]
        (4576, 'EPSG:32629')

        Raises
        ------
        IndexFormatError
            It was opened from its index alone: its GeoPackage is gone.
        """
        from roadgeo.reference.network_file import read_network

        network = self.network or read_network(Path(self.index.path).with_suffix(".gpkg"))
        return network.graph.to_networkx(network.plane.to_crs, crs=network.plane.crs, name=self.name)

    def save(self, path: str | Path, say: Say = say_nothing) -> None:
        """Write `path`.gpkg and `path`.index (see `files.write_reference`)."""
        from roadgeo.reference.files import write_reference

        if self.network is None:
            raise RoadSourceError(f"{self.name}: opened from a file, there is nothing new to save")
        write_reference(path, self.network, (self.index.meta, self.index.arrays()), say)


def stored_options(network: RoadNetwork) -> BuildOptions:
    """Return the options that a network was built with; the defaults for those that are not stored.

    Raises
    ------
    IndexFormatError
        A stored value is impossible: the file was made elsewhere, or changed.
    """
    stored = network.meta.get("options", {})
    return BuildOptions(
        simplify=_read_options(SimplifyOptions, stored, "simplify"),
        intersections=_read_options(IntersectionOptions, stored, "intersections"),
        index=_read_options(IndexOptions, stored, "index"),
    )


#: Least and most of options that could break or flood a kernel; the others are at least 0.
_RANGES = {"n_neighbours": (2, MAX_NEIGHBOURS), "codes_per_vertex": (1, 8), "min_bucket_m": (1.0, 1e5)}

_Options = TypeVar("_Options", SimplifyOptions, IntersectionOptions, IndexOptions)


def _read_options(kind: type[_Options], stored: Any, stage: str) -> _Options:
    """Read the options of one stage out of JSON values, which may hold anything."""
    fields_stored = stored.get(stage, {}) if isinstance(stored, dict) else None
    values: dict[str, Any] = {}
    for option in fields(kind):
        value: Any = fields_stored.get(option.name, option.default) if isinstance(fields_stored, dict) else None
        low, high = _RANGES.get(option.name, (0, 1000))
        if type(value) not in {int, type(option.default)} or not low <= value <= high:
            what = f"the stored option {stage}.{option.name} is {value!r}, expected {low:g} to {high:g}"
            raise IndexFormatError(f"{what}; make the reference again with `roadgeo index`")
        values[option.name] = value
    return kind(**values)


def open_whole(path: str | Path, say: Say = say_nothing) -> Reference:
    """Open a reference of one piece (see `opening.open_reference`)."""
    from roadgeo.reference.files import open_reference as open_parts
    from roadgeo.reference.files import reference_digest, reference_paths

    meta, arrays = open_parts(path, _index_builder(path, say))
    index = ReferenceIndex.from_parts(meta, arrays, str(reference_paths(path).geopackage))
    let_pages_go(arrays.values())
    return Reference(index, digest=reference_digest(path))


def rebuild_reference(path: str | Path, say: Say = say_nothing) -> Reference:
    """Build a reference's index again from its GeoPackage alone, after an edit of that, or in place of a damaged one.

    Raises
    ------
    IndexFormatError
        There is no such GeoPackage, or it is damaged.
    OutputError
        The index cannot be written.
    """
    from roadgeo.reference.files import rebuild_index

    rebuild_index(path, _index_builder(path, say))
    return open_whole(path)


def _index_builder(path: str | Path, say: Say) -> Callable[[RoadNetwork], tuple[dict[str, Any], dict[str, AnyArray]]]:
    """Return the function that builds the index of a network with the options that are stored in it."""

    def build(network: RoadNetwork) -> tuple[dict[str, Any], dict[str, AnyArray]]:
        what = f"building the index of {Path(path).stem} again"
        index = build_index(network, stored_options(network).index, lambda _, share=None: say(what, share))
        return dict(index.meta), index.arrays()

    return build
