"""Import order is the architecture: a module imports only from storeys below its own (or its own, listed)."""

import ast
import re
from pathlib import Path

import roadgeo

ROOT = Path(roadgeo.__file__).parent

#: What each storey holds: what stands at the top of the package, and folders within folders that have a storey of their
#: own. One imports from storeys below, and its own.
STOREYS_TEXT = """
    words         _arrays _options _progress _text _version errors plugins
    files         storage
    kernels       kernels
    planes        geometry
    roads         roads
    entrances     sources location
    photographs   sources.segmentation
    matching      matching
    references    reference
    schemas       outputs.schemas
    exits         outputs
    workflows     workflows
    running       running
    flights       flights serving
    evaluation    evaluation
    demonstration evaluation.demo
    faces         api cli qgis __main__ __init__
"""
STOREYS = {name: storey for storey, line in enumerate(STOREYS_TEXT.split("\n")) for name in line.split()[1:]}


#: Modules beside the kernels that compile and load them.
PROGRAMS = {"compilation", "machine_code", "warmup"}


def modules() -> list[Path]:
    return sorted(p for p in ROOT.rglob("*.py") if "plugin" not in p.parts)


def storey(module: str) -> int | None:
    """The storey of a module below `roadgeo`; None for what stands on none, as names of the package itself."""
    folder, _, rest = module.partition(".")
    return STOREYS.get(f"{folder}.{rest.split('.')[0]}", STOREYS.get(folder))


def imported(path: Path) -> set[str]:
    """Modules below `roadgeo` that a module imports, or imports from, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "roadgeo":
            module = node.module.partition(".")[2]
            names |= {f"{module}.{alias.name}".strip(".") for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[2] for alias in node.names if alias.name.startswith("roadgeo.")}
    return names


def packages(path: Path) -> set[str]:
    """Packages that a module imports, or imports from, anywhere in it."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.split(".")[0] for name in names}


def test_imports_go_down_only() -> None:
    own = {path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."): path for path in modules()}
    assert not [name for name in own if storey(name) is None], "these stand on no storey"
    climbs = [
        f"{name} (storey {storey(name)}) imports {other}"
        for name, path in own.items()
        if name not in {"__main__", "__init__"}  # they lead to everything
        for other in imported(path)
        if (storey(other) or 0) > (storey(name) or 0)
    ]
    assert not climbs


def test_the_top_of_the_package_can_be_seen_at_a_glance() -> None:
    folders = {path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file()}
    files = {path.stem for path in ROOT.glob("*.py")} - {"__init__", "__main__"}
    assert len(folders) <= 14
    assert len(files) <= 10


def test_kernels_import_numpy_only() -> None:
    kernels = [path for path in (ROOT / "kernels").glob("*.py") if path.stem not in PROGRAMS]
    allowed = {"numpy", "math", "typing", "dataclasses", "__future__", "roadgeo"}
    assert not [(path.name, name) for path in kernels for name in packages(path) - allowed]
    assert not [(path.name, name) for path in kernels for name in imported(path) if not name.startswith("kernels")]


def test_commands_print_in_one_place() -> None:
    """There, what names may hold besides text is shown, not obeyed by the terminal."""
    printing = [path.name for path in (ROOT / "cli").glob("*.py") if "click.echo(" in path.read_text()]
    assert printing == ["printing.py"]


def test_logs_are_made_in_one_place() -> None:
    """Their lines show what names may hold besides text; kernels tell of themselves only."""
    assert [path.name for path in modules() if "getLogger(__name__)" in path.read_text()] == ["compilation.py"]


def test_points_are_divided_by_w_in_one_place() -> None:
    """`geometry.homography` maps points; kernels, which know no classes, map their own; so does the plugin."""
    dividing = re.compile(r"\[[^\]]*:2\]\s*/\s*\w+\[[^\]]*\b2:?\]")
    found = [path.name for path in modules() if dividing.search(path.read_text())]
    assert found == ["homography.py"]
