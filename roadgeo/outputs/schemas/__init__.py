"""JSON Schemas (draft 2020-12) of everything that roadgeo writes or prints as JSON, for programs that read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

__all__ = ["NAMES", "read_schema"]

_FOLDER = Path(__file__).parent
_ENDING = ".schema.json"

#: Names of the schemas: "location", "explanation", "evaluation" and others.
NAMES = tuple(sorted(path.name.removesuffix(_ENDING) for path in _FOLDER.glob(f"*{_ENDING}")))


def read_schema(name: str) -> dict[str, Any]:
    """Read the schema of that name, one of `NAMES`.

    >>> import json, jsonschema
    >>> with open("drone_location.json") as file:
    ...     jsonschema.validate(json.load(file), roadgeo.read_schema("location"))
    """
    schema: dict[str, Any] = json.loads((_FOLDER / f"{name}{_ENDING}").read_text(encoding="utf-8"))
    return schema
