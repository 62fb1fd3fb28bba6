"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The development data, for tests marked `realdata`; they skip where it is absent."""
    folder = os.environ.get("ROADGEO_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("ROADGEO_DATA is not set: no development data here")
    return Path(folder)
