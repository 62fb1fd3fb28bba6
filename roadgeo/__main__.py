"""`python -m roadgeo` is `roadgeo`."""

import sys

from roadgeo.cli import main

sys.exit(main())
