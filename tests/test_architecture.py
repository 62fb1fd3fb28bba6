"""Import order is the architecture: a module imports only from storeys below its own (or its own, listed)."""

import ast
from pathlib import Path

import pytest

import roadgeo

ROOT = Path(roadgeo.__file__).parent

STOREYS = {
    "errors": 0, "wording": 0, "typing": 0, "_version": 0,
    "kernels": 1,
    "grid": 2, "road_kinds": 2, "graph": 2, "homography": 2, "robust": 2,
    "projection": 3, "simplification": 3, "vectorization": 3, "voids": 3, "intersections": 3, "network": 3, "updating": 3, "warping": 3, "view": 3, "landscape": 3,
    "tuples": 4, "index": 4,
    "estimator": 5, "verification": 5, "refinement": 5, "location": 5, "pairs": 5, "triples": 5, "camera": 5, "scene": 5,
    "io_roads": 6, "io_lines": 6, "io_overpass": 6, "io_raster": 6, "io_exif": 6, "io_vectorized": 6, "io_index": 6, "io_atomic": 6, "io_network": 6, "io_reference": 6, "io_outputs": 6, "io_products": 6, "io_summary": 6, "outputs": 5, "io_image": 6, "files": 6, "geopackage": 6, "rtree": 6, "truth": 6, "styles": 6, "library": 6,
    "workflows": 7,
    "cli": 8, "report": 8, "plot": 8, "qgis": 8, "demo": 8, "drawing": 8, "trials": 8, "localizability": 8, "evaluation_report": 8, "simulation": 8, "evaluation": 8, "__main__": 8,
    "__init__": 9,
}  # fmt: skip


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


@pytest.mark.parametrize("path", [p for p in modules() if "kernels" in p.parts], ids=lambda p: p.name)
def test_kernels_import_numpy_and_numba_only(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        for name in names:
            assert name.split(".")[0] in {"numpy", "numba", "math", "typing", "__future__"} or name.startswith("roadgeo.kernels")
