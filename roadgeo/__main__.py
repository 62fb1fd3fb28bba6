"""`python -m roadgeo` is `roadgeo`."""

import sys

from roadgeo.cli import main

if __name__ == "__main__":
    sys.exit(main())
