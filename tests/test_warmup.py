"""Start-up: what is compiled is loaded without numba, and what is not is compiled with a word to the user."""

import subprocess
import sys

from roadgeo.kernels.compilation import compiled, entries, modules_of_the_search
from roadgeo.warmup import warm_up

#: Every array on the way from roads and mask to a place must be what the kernels expect, or numba is asked for help.
LOCATE = """
import sys
import roadgeo
from roadgeo.demo import ROADS, demo_masks
reference = roadgeo.build_reference(ROADS, "porto")
assert roadgeo.locate(demo_masks()[0].path, reference).status == "located"
assert "numba" not in sys.modules
"""


def test_all_kernels_of_the_search_are_kept_as_machine_code() -> None:
    told = []
    warm_up(lambda text, share=None: told.append(share))
    assert compiled()
    assert told == [] or (told[0] == 0.0 and told[-1] == 1.0)
    kept = [one for module in modules_of_the_search() for one in entries(module)]
    assert len(kept) > 25


def test_a_warm_process_does_not_import_numba() -> None:
    warm_up()
    subprocess.run([sys.executable, "-c", LOCATE], check=True, timeout=300)
