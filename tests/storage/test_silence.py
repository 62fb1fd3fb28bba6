"""What C libraries print on standard error is not seen."""

import os
import subprocess
import sys

import pytest

from roadgeo.storage.silence import silenced

CODE = """
import os
from roadgeo.storage.silence import silenced
{first}
with silenced():
    os.write(2, b"unseen")
os.write(2, b"seen")
"""


def run(first: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([sys.executable, "-c", CODE.format(first=first)], capture_output=True)


def test_nothing_is_heard_until_it_ends() -> None:
    assert run("").stderr == b"seen"


def test_it_ends_where_decoding_fails() -> None:
    before = os.fstat(2)
    with pytest.raises(ZeroDivisionError), silenced():
        assert os.path.samestat(os.fstat(2), before) / 0
    assert os.path.samestat(os.fstat(2), before)


def test_a_program_without_standard_error_goes_on() -> None:
    done = run("os.close(2)\nos.write = lambda *_: None")
    assert done.returncode == 0
    assert done.stderr == b""
