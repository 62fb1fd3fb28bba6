"""Take the pictures of docs/qgis.md: the test that uses every dialog keeps them, and here they are made small.

python docs/draw_qgis.py
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

NAMES = ("menu", "setup", "build", "locate", "window", "places", "mend", "place")
DOCS = Path(__file__).parent


def main() -> None:
    """Run the test, and write its pictures with few colours."""
    with tempfile.TemporaryDirectory() as folder:
        environ = {**os.environ, "ROADGEO_SCREENS": folder, "ROADGEO_REQUIRE_QGIS": "1"}
        test = str(DOCS.parent / "tests" / "qgis" / "test_window.py")
        subprocess.run([sys.executable, "-m", "pytest", "-q", test], env=environ, check=True)  # noqa: S603 (ours)
        for name in NAMES:
            picture = Image.open(Path(folder, f"{name}.png")).convert("RGB")
            picture.quantize(128).save(DOCS / "qgis" / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
