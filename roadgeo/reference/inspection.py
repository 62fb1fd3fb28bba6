"""Description and verification of a reference, in one piece or in shards."""

from __future__ import annotations

import os
from typing import Any

from roadgeo.reference import files
from roadgeo.reference.shards import check_shards, describe_shards, manifest_path, shards_digest

__all__ = ["check_reference", "describe_reference", "reference_digest"]


def describe_reference(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Describe a reference in plain values (see `files.describe_reference`, `shards.describe_shards`)."""
    manifest = _manifest(path)
    return describe_shards(manifest) if manifest else files.describe_reference(path)


def check_reference(path: str | os.PathLike[str]) -> list[str]:
    """Verify a reference thoroughly; return the problems (see `files.check_reference`)."""
    manifest = _manifest(path)
    return check_shards(manifest) if manifest else files.check_reference(path)


def reference_digest(path: str | os.PathLike[str]) -> str:
    """Return the digest of the intersections of a reference (see `files.reference_digest`)."""
    manifest = _manifest(path)
    return shards_digest(manifest) if manifest else files.reference_digest(path)


def _manifest(path: str | os.PathLike[str]) -> Any:
    """Return the manifest of a reference in shards, None for one of one piece."""
    paths = files.reference_paths(path)
    return None if paths.geopackage.is_file() or paths.index.is_file() else manifest_path(path)
