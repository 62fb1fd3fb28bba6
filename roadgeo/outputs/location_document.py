"""A location read back from its JSON, number by number: the answer to another question may rest on it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import CrsError, MaskError, NotLocatedError, Reason
from roadgeo.geometry.frame import Frame, polygon_area
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import ERROR_RATES, SCHEMA, Content, Kind, Location
from roadgeo.storage.crs import name_crs

__all__ = ["read_answer", "read_location"]

_MAX_BYTES = 64 << 20
#: How far the corners by the homography may lie from the footprint, in lengths of its side; and pixel sizes, metres.
_TOLERANCE, _GSD_M = 1e-5, (1e-4, 1e4)
_STATUSES = ("located", "ambiguous", "not_located", "chosen")


def read_location(path: str | os.PathLike[str]) -> Location:
    """Read the place in a `*_location.json`; the matches behind it are not stored.

    Raises
    ------
    MaskError
        It is no such file.
    NotLocatedError
        The mask has no place.
    """
    location = read_answer(path)
    if not location.on_map:
        raise NotLocatedError(f"{os.fspath(path)}: {location.query} has no sure place: {location.reason}")
    return location


def read_answer(path: str | os.PathLike[str]) -> Location:
    """Read all places in a `*_location.json`, refused ones too, as far as it holds the values that put an image there.

    Raises
    ------
    MaskError
        It is no such file.
    """
    try:
        return _from_document(_read_document(Path(path)))
    except (CrsError, OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise MaskError(
            f"{os.fspath(path)}: no location ({error}); give the *_location.json that `roadgeo locate` wrote"
        ) from error


def _read_document(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError("too large")
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise ValueError(f"not of schema {SCHEMA}")
    return document


def _from_document(document: dict[str, Any]) -> Location:
    """Take the places out of a document, checking every number."""
    status = document["status"]
    if status not in _STATUSES:
        raise ValueError(f"its status is {status!r}")
    sides = document.get("size")
    size = None if sides is None else (int(sides[0]), int(sides[1]))
    if size is not None and not (0 < size[0] < 10**6 and 0 < size[1] < 10**6):
        raise ValueError(f"a frame of {size[0]} x {size[1]} pixels")
    places: list[Placement] = []
    if status != "not_located":
        places.append(_place(document, size, document["footprint"]))
    others = [other for other in document.get("alternatives") or () if other.get("homography") is not None]
    places += [_place(other, size) for other in others]
    return Location(
        str(document["query"]),
        status,
        str(document["reason"]),
        str(document.get("reference") or ""),
        str(document.get("attribution") or ""),
        tuple(places),
        Reason(document.get("reason_code") or Reason.NOTHING_STANDS_OUT),
        None if size is None else Content(size, kind=_kind(document)),
        options=document.get("options"),
        reference_digest=str(document.get("reference_digest") or ""),
    )


def _kind(document: dict[str, Any]) -> Kind:
    """Return the evidence for its places; only a rate of errors depends on it."""
    kind = (document.get("error_rate") or {}).get("kind")
    return kind if kind in ERROR_RATES else "mask"


def _place(entry: dict[str, Any], size: tuple[int, int] | None, footprint: Any = None) -> Placement:
    """Take a place out of a document, or out of its list of other places."""
    if size is None:
        raise ValueError("the frame has no size")
    homography, crs = _array(entry["homography"], (3, 3)), name_crs(str(entry["crs"]))
    corners = Homography(homography).facing(Frame(*size).center)(Frame(*size).corners)
    _require_one_place(corners, corners if footprint is None else _array(footprint, (4, 2)), size)
    origin = np.round(corners.mean(axis=0), -3)
    covariance, score, focal = (entry.get(name) for name in ("corner_covariance_m2", "log10_odds", "focal_px"))
    camera = entry.get("camera")
    if focal is None and camera is not None and camera["source"] == "camera":
        focal = camera["focal_px"]
    return Placement(
        size,
        LocalPlane(crs, (float(origin[0]), float(origin[1]))),
        shift(*-origin) @ homography,
        float("nan") if score is None else float(_array(score, ())),
        str(entry.get("reference") or ""),
        str(entry.get("attribution") or ""),
        None if covariance is None else _array(covariance, (8, 8)),
        float(_array(entry.get("lens_k1") or 0.0, ())),
        "similarity" if entry.get("fitted") == "similarity" else "homography",
        None if focal is None else float(_array(focal, ())),
        is_pinhole="camera" not in entry or camera is not None,
        ground_m=_ground(camera),
    )


def _ground(camera: dict[str, Any] | None) -> tuple[float, float] | None:
    if camera is None or camera.get("ground_m") is None:
        return None
    return float(camera["ground_m"]), float(camera["ground_spread_m"])


def _require_one_place(corners: FloatArray, footprint: FloatArray, size: tuple[int, int]) -> None:
    """Raise where a homography does not take the frame to its footprint, or pixels have no size of this Earth."""
    with np.errstate(all="ignore"):
        side = float(np.sqrt(polygon_area(footprint)))
        apart = float(np.abs(corners - footprint).max())
    if not apart <= _TOLERANCE * side:
        raise ValueError("the homography does not lead to the footprint")
    if not _GSD_M[0] <= side / np.sqrt(size[0] * size[1]) <= _GSD_M[1]:
        raise ValueError(f"a frame of {side:g} m")


def _array(values: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(values, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected {' x '.join(map(str, shape)) or 'finite'} numbers")
    return array
