"""Import order is the architecture: a module imports only from storeys below its own (or its own, listed)."""

import ast
from pathlib import Path

import pytest

import roadgeo

ROOT = Path(roadgeo.__file__).parent

#: What each storey holds: folders and modules at the top of the package. One imports from storeys below, and its own.
STOREYS_TEXT = """
    words       _version _arrays _progress _text errors plugins schemas
    files       storage
    kernels     kernels
    warmup      warmup
    planes      geometry
    roads       roads
    entrances   sources location segmentation
    matching    matching
    references  reference
    exits       outputs
    workflows   workflows
    running     running
    flights     flights serving
    evaluation  evaluation
    faces       api cli qgis demo __main__ __init__
"""
STOREYS = {name: storey for storey, line in enumerate(STOREYS_TEXT.split("\n")) for name in line.split()[1:]}


def modules() -> list[Path]:
    return sorted(p for p in ROOT.rglob("*.py") if "plugin" not in p.parts)


def storey(path: Path) -> int:
    return STOREYS[path.relative_to(ROOT).with_suffix("").parts[0]]


def imported(path: Path) -> set[str]:
    """First names below `roadgeo` that a module imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "roadgeo":
            parts = node.module.split(".")
            names |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("roadgeo.")}
    return names


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_down_only(path: Path) -> None:
    own = path.relative_to(ROOT).with_suffix("").parts[0]
    for name in imported(path) - {own}:
        if name in STOREYS and not (own == "__main__" or own == "__init__"):
            assert STOREYS[name] <= storey(path), f"{path.name} (storey {storey(path)}) imports {name}"


@pytest.mark.parametrize(
    "path",
    [p for p in modules() if p.parent.name == "kernels" and p.stem not in {"compilation", "machine_code"}],
    ids=lambda p: p.name,
)
def test_kernels_import_numpy_only(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        for name in names:
            allowed = {"numpy", "math", "typing", "dataclasses", "__future__"}
            assert name.split(".")[0] in allowed or name.startswith("roadgeo.kernels")


def test_commands_print_in_one_place() -> None:
    """There, what names may hold besides text is shown, not obeyed by the terminal."""
    printing = [path.name for path in (ROOT / "cli").glob("*.py") if "click.echo(" in path.read_text()]
    assert printing == ["printing.py"]
