"""Options as fields: what commands, dialogs and forms say of an option stands beside its type and its default.

A dataclass of options is a command's, or a part of one; `roadgeo.cli.options` makes commands of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, field, fields
from typing import Any

__all__ = ["IMAGE", "OTHERS", "RESULTS", "SEARCH", "WHERE", "among", "option", "part", "take"]

#: Headings under which options stand.
WHERE, IMAGE, SEARCH, RESULTS, OTHERS = "Where to look", "The image", "The search", "The results", "Others"


def option(names: str, form: str | None, group: str, text: str, **more: Any) -> Any:
    """Make a field that is an option.

    Parameters
    ----------
    names : str
        Its names on the command line, with spaces between: "-j --jobs".
    form : str or None
        What stands for its value; "" for a switch, None for the words or the type of its field.
    group : str
        The heading that it stands under.
    text : str
        Its help; what is behind the first sentence is shown by --help-all only.
    **more
        `default`: None, or of a switch False, unless given.
        `rare`: --help names it, and --help-all explains it.
        `limits`: least and greatest number, None for none; `above`: the least is not allowed itself.
        `read`: makes the value of a text; raises ValueError or a RoadgeoError, "got ..., expected ...".
        `is_path`: whether it names a file.
        `plugins`: the group of plugins that it names; `ending`: of files that it takes, too.
        Whatever click alone needs.
    """
    default = more.pop("default", False if form == "" else None)
    said = {"names": names, "form": form, "group": group, "help": text, **more}
    return field(default=default, metadata={"option": said})


def take(kind: type, name: str, **changes: Any) -> Any:
    """Make a field like that of another class; `changes` replace what is said of it there, or its default."""
    of = next(each for each in fields(kind) if each.name == name)
    return field(default=changes.pop("default", of.default), metadata={"option": of.metadata["option"] | changes})


def part(kind: type, *names: str, **changes: Any) -> Any:
    """Make a field that holds options of a class of their own, all of them or these; `changes` hold for each."""
    return field(default_factory=kind, metadata={"part": (kind, names, changes)})


def among(kind: type) -> Iterator[tuple[type, Field[Any], dict[str, Any]]]:
    """Yield the options of a class, those of its parts in their places: class, field, and what is said of it."""
    for each in fields(kind):
        if "part" in each.metadata:
            of, names, changes = each.metadata["part"]
            known = {field.name: (home, field, said | changes) for home, field, said in among(of)}
            yield from (known[name] for name in names or known)
        elif "option" in each.metadata:
            yield kind, each, each.metadata["option"]
