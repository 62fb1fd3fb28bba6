"""A short run of `support/endurance.py`: what must not grow does not. At full length see docs/faults.md."""

import pytest
from support import endurance


@pytest.mark.slow
def test_neither_memory_nor_files_nor_time_grow() -> None:
    told = endurance.main(150)
    assert set(told["became"]) == {"located", "not_located", "damaged"}
    assert told["open_files"][-1] == told["open_files"][1]
    assert told["resident_mb"][-1] <= 1.05 * told["resident_mb"][1]
    assert min(told["median_ms"][-5:]) <= 1.5 * max(told["median_ms"][:5])
