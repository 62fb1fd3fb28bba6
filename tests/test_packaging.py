"""What stands beside the package agrees with it."""

import re
import tomllib
from pathlib import Path

import roadgeo

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

#: Packages that conda-forge calls otherwise.
ON_CONDA = {"opencv-python-headless": "py-opencv", "osmium": "pyosmium"}


def test_the_citation_is_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {roadgeo.__version__}\n" in citation
    assert f'\nurl: "{PROJECT["urls"]["Homepage"]}"\n' in citation
    assert f'\nrepository-code: "{PROJECT["urls"]["Repository"]}"\n' in citation


def test_the_conda_recipe_is_of_this_version_and_needs_the_same() -> None:
    recipe = (ROOT / "conda" / "recipe.yaml").read_text("utf-8")
    assert f'version: "{roadgeo.__version__}"' in recipe
    assert f"homepage: {PROJECT['urls']['Homepage']}" in recipe
    needed = recipe.split("  run:\n")[1].split("\n\n")[0]
    listed = re.findall(r"- ([\w-]+) (>=[\d.]+)", needed)
    asked = [re.fullmatch(r"([\w-]+)(>=[\d.]+)", one).groups() for one in PROJECT["dependencies"]]
    expected = [(ON_CONDA.get(name, name), version) for name, version in asked]
    assert listed == [("python", PROJECT["requires-python"]), *expected]


def test_placeholder_addresses_stand_in_one_place() -> None:
    """Whoever publishes roadgeo changes pyproject.toml; two files that cannot read it are held against it above."""
    held = {"pyproject.toml", "CITATION.cff", "recipe.yaml"}
    files = [path for path in ROOT.rglob("*") if path.suffix in {".py", ".md", ".toml", ".cff", ".yaml", ".txt"}]
    ours = [path for path in files if not {".venv", ".lowest", ".uv", "build", "tests"} & set(path.parts)]
    assert {path.name for path in ours if "roadgeo.example.org" in path.read_text("utf-8")} == held
