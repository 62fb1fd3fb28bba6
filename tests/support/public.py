"""The promise of stability: python tests/support/public.py writes into tests/data/public.json what is promised now.

Promised are the names that `roadgeo` offers, the parameters of its functions and methods, the fields of its values, and
the keys of every JSON document. Between major versions they may grow; nothing of them goes. Not promised are the fields
of options, which follow the search: the keywords of `locate` and `build_reference` say the same.
"""

import dataclasses
import inspect
import json
from pathlib import Path

import roadgeo
from roadgeo.outputs.schemas import NAMES, read_schema

PROMISED = Path(__file__).parents[1] / "data" / "public.json"


def parameters(function):
    """Names of its parameters; those without a default end in an exclamation mark."""
    own = [
        parameter
        for parameter in inspect.signature(function).parameters.values()
        if parameter.name not in {"self", "cls"}
    ]
    return [item.name + "!" * (item.default is item.empty and item.kind < item.VAR_POSITIONAL) for item in own]


def offered_by(value):
    """What a function takes, or what a class has."""
    if not inspect.isclass(value):
        return parameters(value) if callable(value) else []
    if issubclass(value, Exception) or value.__name__.endswith("Options"):
        return []
    own = {name: each for name, each in inspect.getmembers(value) if not name.startswith("_")}
    routines = {name: parameters(each) for name, each in own.items() if inspect.isroutine(each)}
    methods = [f"{name}({first})" for name, taken in routines.items() for first in ("", *taken)]
    fields = [field.name for field in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else []
    others = [name for name, each in own.items() if not inspect.isroutine(each) and name not in fields]
    return sorted({*fields, *others, *methods})


def keys(schema, at=""):
    """Paths of all keys that a JSON Schema describes, those that always stand there with an exclamation mark."""
    found = set()
    for name, child in schema.get("properties", {}).items():
        found |= {f"{at}/{name}{'!' * (name in schema.get('required', ()))}", *keys(child, f"{at}/{name}")}
    for word in ("items", "additionalProperties"):
        if isinstance(schema.get(word), dict):
            found |= keys(schema[word], f"{at}/*")
    for word in ("anyOf", "oneOf", "allOf", "prefixItems"):
        found |= {key for child in schema.get(word, ()) for key in keys(child, at)}
    for name, child in schema.get("$defs", {}).items():
        found |= keys(child, f"#{name}")
    return found


def offered():
    """What this version offers."""
    names = {name: offered_by(getattr(roadgeo, name)) for name in roadgeo.__all__ if name != "__version__"}
    return {"roadgeo": names, "schemas": {name: sorted(keys(read_schema(name))) for name in NAMES}}


if __name__ == "__main__":
    PROMISED.write_text(json.dumps(offered(), indent=1) + "\n", encoding="utf-8")
