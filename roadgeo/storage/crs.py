"""Names of coordinate reference systems (CRS), as all libraries read them."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

from roadgeo.errors import CrsError

if TYPE_CHECKING:
    from pyproj import CRS

__all__ = ["NoCrsError", "crs_name", "known_crs", "name_crs"]


class NoCrsError(CrsError):
    """The given text is no CRS, or none of places on Earth."""


def known_crs(crs: Any) -> CRS:
    """Return a CRS as pyproj knows it, of whatever pyproj takes for one.

    Raises
    ------
    pyproj.exceptions.CRSError
        It is no CRS.
    """
    import pyproj

    return _known(crs) if isinstance(crs, str) else pyproj.CRS.from_user_input(crs)


def name_crs(crs: Any) -> str:
    """Return a CRS as all libraries read it, "EPSG:n" or else WKT2, of whatever pyproj takes for one.

    That is a code (3857, "EPSG:3857", "ESRI:102003"), a name ("OSGB36 / British National Grid"), WKT, PROJJSON ...

    Raises
    ------
    NoCrsError
        It is no CRS, or not one of places on a map.
    """
    from pyproj.exceptions import CRSError

    text = f"{str(crs)[:60]!r}"
    expected = "expected for example EPSG:3857, 3857, a name such as 'WGS 84 / UTM zone 29N', or WKT"
    try:
        resolved = known_crs(crs)
    except CRSError as error:
        raise NoCrsError(f"{text} is no CRS that PROJ knows; {expected}") from error
    resolved = resolved.to_2d() if len(resolved.axis_info) == 3 else resolved
    if not (resolved.is_geographic or resolved.is_projected):
        raise NoCrsError(f"{text} is no CRS of a map, but a {resolved.type_name}; {expected}")
    code = _code(resolved)
    return f"EPSG:{code}" if code else resolved.to_wkt("WKT2_2019")


def crs_name(crs: Any) -> str | None:
    """Return a CRS as `name_crs` does; None without one, or where it is bound to no place on Earth."""
    try:
        return None if crs is None else name_crs(crs)
    except NoCrsError:
        return None


@lru_cache(maxsize=64)  # where PROJ has none it compares its whole list, for up to 50 ms
def _code(crs: CRS) -> int | None:
    return crs.to_epsg(min_confidence=100)


@lru_cache(maxsize=64)
def _known(crs: str) -> CRS:
    import pyproj

    return pyproj.CRS.from_user_input(crs)
