"""Make the reference of the Python interface from its docstrings: python docs/build_api.py FOLDER (needs pdoc)."""

import sys
from pathlib import Path

import pdoc

#: Where what `roadgeo` offers is at home, and what plugins need.
MODULES = [
    "roadgeo.api",
    "roadgeo.workflows",
    "roadgeo.location",
    "roadgeo.reference.reference",
    "roadgeo.reference.library",
    "roadgeo.roads.kinds",
    "roadgeo.sources.roads",
    "roadgeo.matching.options",
    "roadgeo.geometry.mask",
    "roadgeo.geometry.camera",
    "roadgeo.geometry.homography",
    "roadgeo.outputs.registry",
    "roadgeo.plugins",
    "roadgeo.outputs.schemas",
    "roadgeo.errors",
]

if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "site")
    pdoc.render.configure(docformat="numpy", search=True)
    pdoc.pdoc(*MODULES, output_directory=folder)
    sys.stdout.write(f"{len(list(folder.rglob('*.html')))} pages in {folder}\n")
