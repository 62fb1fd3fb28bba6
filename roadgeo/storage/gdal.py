"""Limits on GDAL for files of strangers: few drivers, no network, no files beside the one that was named.

GDAL chooses among some 150 drivers by a file's content, whatever its name. Several of them fetch a named file from
the network, and one (MRF) writes to a path in the file. Rasterio and pyogrio each bring a GDAL of their own.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = [
    "CONSENT",
    "NETWORK",
    "OWN_SHIFT",
    "SEALED",
    "allowed_drivers",
    "forget_missing_proj_data",
]

#: Environment variable that names further drivers to allow, for example "VRT" or "VRT,netCDF".
CONSENT = "ROADGEO_GDAL_DRIVERS"

#: Settings that keep GDAL off the network: no remote file has the only name allowed, and nothing answers at port 0.
NETWORK = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_HTTP_PROXY": "127.0.0.1:0",
    "GDAL_HTTPS_PROXY": "127.0.0.1:0",
}

#: A datum shift that a file states is its own: GDAL leaves it out where the datum has a number of EPSG's.
OWN_SHIFT = {"OSR_STRIP_TOWGS84": "NO"}

#: Settings under which rasters are opened: no siblings (.ovr, .msk, .aux.xml, world files) and no network.
SEALED = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", **OWN_SHIFT, **NETWORK}


def forget_missing_proj_data() -> None:
    """Unset the folder of PROJ's data (another installation's, long gone) if it does not exist.

    The libraries bring their own, which they would not look for. Call it before they are loaded.
    """
    for name in ("PROJ_DATA", "PROJ_LIB"):
        folders = os.environ.get(name, "").split(os.pathsep)
        if not any((Path(folder) / "proj.db").is_file() for folder in folders if folder):
            os.environ.pop(name, None)


def allowed_drivers() -> list[str]:
    """Return the further drivers that the user allows."""
    return [name.strip() for name in os.environ.get(CONSENT, "").split(",") if name.strip()]
