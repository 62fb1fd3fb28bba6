"""Limits on GDAL for files of strangers: few drivers, no network, no files beside the one that was named.

GDAL chooses among some 150 drivers by a file's content, whatever its name. Several of them fetch a named file from
the network, and one (MRF) writes to a path in the file. Rasterio and pyogrio each bring a GDAL of their own.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

__all__ = [
    "CONSENT",
    "NETWORK",
    "OWN_SHIFT",
    "SEALED",
    "allowed_drivers",
    "are_skipped",
    "forget_missing_proj_data",
    "skip_drivers",
    "skipping",
]

#: Environment variable that names further drivers to allow, for example "VRT" or "VRT,netCDF".
CONSENT = "ROADGEO_GDAL_DRIVERS"

#: Drivers that write while they read, or reach for the network.
_SKIPPED = ("MRF", "WMS", "WCS", "WMTS", "HTTP", "STACIT", "STACTA", "GTI", "PLMOSAIC", "EEDAI", "DAAS", "Zarr")
#: By rasterio's GDAL, too; those that lack it would complain. `NETWORK` does not shut it.
_SKIPPED_BY_RASTERIO = (*_SKIPPED, "netCDF")

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


def skip_drivers() -> None:
    """Have GDAL leave out its dangerous drivers, in commands and inside the fence: call it before GDAL is loaded.

    Programs that merely use roadgeo keep their drivers; `storage.rasters` and `storage.vectors` guard each file.
    """
    os.environ["GDAL_SKIP"] = _skipped(_SKIPPED)


def skipping() -> dict[str, str]:
    """Return the setting by which rasterio's GDAL leaves out one more, where `skip_drivers` was called."""
    if os.environ.get("GDAL_SKIP", "") != _skipped(_SKIPPED):
        return {}
    return {"GDAL_SKIP": _skipped(_SKIPPED_BY_RASTERIO)}


def _skipped(drivers: Sequence[str]) -> str:
    """Return the value of GDAL_SKIP with further drivers, less those that the user allows."""
    given = os.environ.get("GDAL_SKIP", "")
    before = (name.strip() for name in (given.split(",") if "," in given else given.split()))
    kept = set(allowed_drivers())
    return ",".join(dict.fromkeys(name for name in (*before, *drivers) if name and name not in kept))


def are_skipped() -> bool:
    """Whether rasterio's GDAL lacks its dangerous drivers: it takes any for the files that a virtual raster names."""
    import rasterio

    with rasterio.Env(**skipping()) as env:
        return not env.drivers().keys() & {*_SKIPPED_BY_RASTERIO} - {*allowed_drivers()}


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
