"""What stands beside the package agrees with it."""

from pathlib import Path

import roadgeo


def test_the_citation_is_of_this_version() -> None:
    citation = Path(__file__).parents[1] / "CITATION.cff"
    assert f"\nversion: {roadgeo.__version__}\n" in citation.read_text()
