"""The site: `sphinx-build -W -c docs . site` in the root of the checkout, whose pages it takes as they stand.

The sources are the root, not docs/, so that links between README.md, docs/ and examples/ hold on the site as they do in
a checkout. The order of pages stands here, not in the pages: tutorial, how-to, reference, explanation.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import roadgeo

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

project, release, author = "roadgeo", roadgeo.__version__, PROJECT["authors"][0]["name"]
copyright = author  # noqa: A001 (Sphinx's name)
root_doc = "README"
include_patterns = [
    "*.md",
    "docs/**.md",
    "examples/**/README.md",
    "examples/*.ipynb",
    "roadgeo/sources/segmentation/model/roads.md",
]

exclude_patterns = [".*", "build", "site", "tests", "wheel"]  # folders that need not be walked

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # a test runs the notebooks
default_role = "literal"
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give types with shapes and units
napoleon_google_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"roadgeo {release}"
html_static_path: list[str] = []
html_show_sourcelink = False
html_show_sphinx = False
html_additional_pages = {"index": "redirect.html"}
templates_path = ["templates"]

#: Titles of the sidebar, and the pages below each.
ORDER = {
    "Tutorial": ["docs/tutorial", "examples/georeference", "examples/flight", "examples/locate"],
    "How to": [
        "docs/install",
        "docs/masks",
        "docs/photographs",
        "docs/references",
        "docs/scale",
        "docs/qgis",
        "docs/faq",
    ],
    "Reference": ["docs/commands/README", "docs/api", "docs/glossary", "docs/faults", "SECURITY", "CHANGELOG"],
    "Explanation": ["docs/how-it-works", "docs/how-well", "docs/paper", "docs/architecture", "CONTRIBUTING"],
}
COMMANDS = "index locate verify track apply serve vectorize library evaluate qgis demo completion"
#: Pages that belong to another: its own list of links names them.
BELOW = {
    "docs/commands/README": [f"docs/commands/{page}" for page in COMMANDS.split()],
    "docs/photographs": ["roadgeo/sources/segmentation/model/roads", "examples/segmenter/README"],
    "docs/how-well": ["examples/*/README"],
}


def list_pages(caption: str, pages: list[str]) -> str:
    """Return a table of contents that only the sidebar shows."""
    titled = f":caption: {caption}\n" if caption else ""
    return f"\n```{{toctree}}\n:hidden:\n:glob:\n{titled}\n" + "\n".join(f"/{page}" for page in pages) + "\n```\n"


def complete(_: Sphinx, name: str, source: list[str]) -> None:
    """Add the pages below a page, and lead what is no page to the repository."""
    text = source[0]
    if name == root_doc:
        text += "".join(list_pages(*each) for each in ORDER.items())
    if name in BELOW:
        text += list_pages("", BELOW[name])
    folder = (ROOT / name).parent

    def lead(link: re.Match[str]) -> str:
        target = (folder / link[1]).resolve()
        if not target.is_dir():
            return link[0]
        if (target / "README.md").exists():
            return f"]({link[1].rstrip('/')}/README.md)"
        return f"]({PROJECT['urls']['Repository']}/{target.relative_to(ROOT).as_posix()})"

    source[0] = re.sub(r"\]\(((?!https?:)[^)\s#]+)\)", lead, text)


def setup(app: Sphinx) -> None:
    """Register `complete`."""
    app.connect("source-read", complete)
