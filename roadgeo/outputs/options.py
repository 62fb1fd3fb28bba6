"""How pictures are drawn on the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from roadgeo._options import RESULTS, option
from roadgeo.storage.crs import name_crs

__all__ = ["ImageOptions"]


# fmt: off
@dataclass(frozen=True)
class ImageOptions:
    """How a picture is drawn on the map; each option is explained beside it."""

    crs: str | None = option("--crs", "CRS", RESULTS,
        "CRS of what is drawn: EPSG:3857. Default: the map's own, metric.", read=name_crs)
    resolution: float | None = option("--resolution", "SIZE", RESULTS,
        "Pixel size of what is drawn, in units of its CRS. Default: the picture's own.",
        limits=(0, None), above=True, rare=True)
    resampling: Literal["nearest", "bilinear", "cubic", "lanczos"] = option("--resampling", None, RESULTS,
        "How values between pixels are found; nearest for classes.", default="cubic", show_default=True, rare=True)
    compression: Literal["deflate", "zstd", "jpeg", "webp"] = option("--compression", None, RESULTS,
        "Compression of rasters. jpeg and webp, for photographs only, make them five times smaller, with some loss.",
        default="deflate", show_default=True, rare=True)
    max_pixels: int = option("--max-pixels", "N", RESULTS,
        "Draw coarser rather than more than this.", limits=(1, None), default=400_000_000, show_default=True, rare=True)
# fmt: on
