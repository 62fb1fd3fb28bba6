"""The description of a model that is needed to run it, from its own metadata or the STAC item beside it.

Conventions: QGIS Deepness keeps JSON strings in an ONNX file's `metadata_props`
(https://qgis-plugin-deepness.readthedocs.io, "Adding metadata to ONNX model"); the STAC Machine Learning Model
extension describes a model in MODEL.json beside MODEL.onnx (https://github.com/stac-extensions/mlm).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from roadgeo._text import listed
from roadgeo.errors import ModelError
from roadgeo.sources.segmentation.onnx_file import OnnxModel, Port
from roadgeo.storage.memory import bounded

__all__ = ["TILE_STEP", "ModelCard", "channels_come_last", "read_card", "size_of"]

_ROAD, _NOT = {"road", "roads", "street", "streets", "highway", "highways"}, {"not", "no", "non", "without"}
#: Free input sizes are made multiples of this, as encoders with five reductions ask for.
TILE_STEP = 32
_DEFAULT_TILE, _MAX_TILE, _MOST_LISTED = 512, 4096, 100

#: Numbers that a model may take, and those that it may give as probabilities or logits; whole ones may be classes.
_TAKEN = ("float32", "float16", "float64", "uint8")
_GIVEN = ("float32", "float16", "float64")
_WHOLE = ("int64", "int32", "int16", "int8", "uint64", "uint32", "uint16", "uint8", "bool")


@dataclass(frozen=True)
class ModelCard:
    """How a model is run. Dimensions: C classes.

    Attributes
    ----------
    resolution_m : float or None
        Metres per pixel that it was made for.
    tile : (height, width)
        Size of its input, pixels.
    any_size : bool
        Whether tiles of other sizes do as well, their sides multiples of `TILE_STEP`.
    kind : str
        Type of the numbers that it takes, as NumPy calls it; "uint8": RGB as it is, neither shifted nor scaled.
    channels_last : bool
        Whether it takes (1, height, width, 3) instead of (1, 3, height, width).
    overlap : float
        Share of a tile that it has in common with the next.
    mean, std : (3,) tuple
        Subtracted from, and divided out of RGB values between 0 and 1.
    threshold : float
        Probabilities above it are road.
    output : str
        The output that shows roads.
    channels : tuple of int
        Channels that are road, whose probabilities are added; or classes that are road. Empty: all but 0.
    gives_classes : bool
        Whether the output is the class of each pixel (argmax).
    is_probability : bool or None
        Whether the output is a probability already; None: by its values.
    """

    resolution_m: float | None
    tile: tuple[int, int]
    any_size: bool
    kind: str
    channels_last: bool
    overlap: float
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    threshold: float
    output: str
    channels: tuple[int, ...]
    gives_classes: bool
    is_probability: bool | None


def read_card(model: OnnxModel, class_name: str | None = None) -> ModelCard:
    """Work out how a model is run.

    Parameters
    ----------
    class_name : str, optional
        The class that is road. Default: by the names of the classes.

    Raises
    ------
    ModelError
        It takes or gives something else than expected, its metadata contradict it, or no class is a road.
    """
    path = Path(model.path)
    try:
        metadata = {**_read_metadata(model.metadata), **_read_sidecar(path.with_suffix(".json"))}
        return _make_card(model, metadata, class_name)
    except (TypeError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise ModelError(f"{path}: its metadata are invalid ({error}); correct them") from error
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def _make_card(model: OnnxModel, metadata: dict[str, Any], class_name: str | None) -> ModelCard:
    kind = str(metadata.get("model_type", "Segmentor"))
    if kind.lower() != "segmentor":
        raise ModelError(f"is a model for {kind}; expected one for segmentation (Segmentor)")
    tile, any_size, channels_last = _tile_of(model, metadata)
    names = metadata.get("classes", {})
    output = _choose_output(model, class_name)
    gives_classes = output.kind in _WHOLE and _n_channels(output) in (None, 1)
    channels = _choose(output, gives_classes, names, class_name)
    resolution = metadata.get("resolution_m")
    if resolution is not None and not 0.01 <= resolution <= 100:
        raise ValueError(f"a resolution of {resolution:g} m per pixel")
    card = ModelCard(
        resolution_m=resolution,
        tile=tile,
        any_size=any_size,
        kind=model.inputs[0].kind,
        channels_last=channels_last,
        overlap=_within(metadata.get("overlap", 0.125), 0.0, 0.75, "overlap"),
        mean=_triple(metadata.get("mean", 0.0), "mean"),
        std=_triple(metadata.get("std", 1.0), "standard deviation"),
        threshold=_within(metadata.get("threshold", 0.5), 0.0, 1.0, "threshold"),
        output=output.name,
        channels=channels,
        gives_classes=gives_classes,
        is_probability=True if model.last.get(output.name) in ("Sigmoid", "HardSigmoid", "Softmax") else None,
    )
    if min(card.std) <= 0:
        raise ValueError(f"standard deviations {card.std}")
    if card.kind == "uint8" and (any(card.mean) or card.std != (1.0,) * 3):
        raise ValueError("it takes 8-bit values, and values of another mean and deviation")
    return replace(card, overlap=max(card.overlap, 0.05))


def _tile_of(model: OnnxModel, metadata: dict[str, Any]) -> tuple[tuple[int, int], bool, bool]:
    """Return (height, width) of the input, its own where fixed, else as given; if it is free; if channels are last."""
    if len(model.inputs) != 1:
        raise ModelError(f"takes {len(model.inputs)} inputs; expected one, a picture")
    port = model.inputs[0]
    last = len(port.shape) == 4 and port.shape[3] == 3 != port.shape[1]
    is_picture = len(port.shape) == 4 and port.shape[0] in (None, 1) and (last or port.shape[1] in (None, 3))
    if port.kind not in _TAKEN or not is_picture:
        sizes = ", ".join("any" if side is None else str(side) for side in port.shape)
        raise ModelError(
            f"takes {port.kind} of shape ({sizes}); expected {', '.join(_TAKEN)}; (1, 3, height, width) or "
            "(1, height, width, 3), RGB"
        )
    sides = port.shape[1:3] if last else port.shape[2:]
    wanted = int(metadata.get("tile", _DEFAULT_TILE))
    free = max(TILE_STEP, round(wanted / TILE_STEP) * TILE_STEP)
    tile = sides[0] or free, sides[1] or free
    if not all(TILE_STEP <= side <= _MAX_TILE for side in tile):
        raise ModelError(f"takes tiles of {tile[1]} x {tile[0]} pixels; expected {TILE_STEP} to {_MAX_TILE}")
    return tile, not any(sides), last


def _choose_output(model: OnnxModel, class_name: str | None) -> Port:
    """Choose among heads: the one of the class's name, the one named after roads, or the first that is an image."""
    images = [port for port in model.outputs if port.kind in _GIVEN + _WHOLE and len(port.shape) in (0, 3, 4)]
    if not images:
        raise ModelError("gives no image of numbers; expected (1, classes, height, width)")
    named = [port for port in images if port.name == class_name]
    return (named or [port for port in images if _is_road(port.name)] or images)[0]


def size_of(output: Port) -> tuple[int, int] | None:
    """Return (height, width) of an output; None where that is known only when it runs."""
    sides = output.shape[-3:]
    height, width = sides[:2] if len(output.shape) == 4 and channels_come_last(sides) else (None, None, *sides)[-2:]
    return None if height is None or width is None else (height, width)


def _n_channels(output: Port) -> int | None:
    """Return how many channels an output has, as far as is known before it runs."""
    if len(output.shape) != 4:
        return 1
    _, *sides = output.shape
    return sides[2] if channels_come_last(sides) else sides[0]


def channels_come_last(sides: Sequence[int | None]) -> bool:
    """Distinguish (height, width, channels) from (channels, height, width): there are fewer channels than pixels."""
    return sides[2] is not None and all(side is None or side > sides[2] for side in sides[:2])


def _choose(output: Port, gives_classes: bool, names: dict[int, str], class_name: str | None) -> tuple[int, ...]:
    """Return which channels, or which values of classes, are road; of classes without names none: all but 0 then."""
    n, unnamed = _n_channels(output), not names and class_name in (None, output.name)
    if class_name is None:
        wanted = [key for key, name in names.items() if _is_road(name)]
    else:
        wanted = [key for key, name in names.items() if class_name in (name, str(key))]
    if gives_classes:
        wanted = [int(class_name)] if not names and class_name and class_name.isdecimal() else wanted
        fits = bool(wanted) or unnamed
    elif n == 1:  # by convention the last of the classes, separated from the others by the threshold
        fits, wanted = unnamed or max(names, default=0) in wanted, [0]
    else:
        fits = bool(wanted) and (n is None or max(wanted) < n)
    if not fits:
        held = listed([f"{key} {name}" for key, name in sorted(names.items())], _MOST_LISTED) or "none"
        what = "names no class after roads" if class_name is None else f"has no class {class_name!r}"
        hint = "say which shows them" if class_name is None else "choose one of them"
        raise ModelError(f"{what} (its classes: {held}); {hint}: --class NAME")
    return tuple(wanted)


def _is_road(name: str) -> bool:
    words = set(re.findall(r"[a-z]+", name.lower()))
    return bool(words & _ROAD) and not words & _NOT


def _read_metadata(props: dict[str, str]) -> dict[str, Any]:
    """Read `metadata_props` as Deepness writes them."""
    read: dict[str, tuple[str, Callable[[Any], Any]]] = {
        "model_type": ("model_type", str),
        "class_names": ("classes", _classes),
        "resolution": ("resolution_m", lambda centimetres: float(centimetres) / 100.0),
        "tiles_size": ("tile", int),
        "standardization_mean": ("mean", lambda values: values),
        "standardization_std": ("std", lambda values: values),
        "tiles_overlap": ("overlap", lambda percent: float(percent) / 100.0),
        "seg_thresh": ("threshold", float),
    }
    return {name: make(json.loads(props[key])) for key, (name, make) in read.items() if key in props}


def _classes(names: Any) -> dict[int, str]:
    return {int(key): str(name) for key, name in (names.items() if isinstance(names, dict) else enumerate(names))}


def _read_sidecar(path: Path) -> dict[str, Any]:
    """Read the STAC item beside a model, if there is one and it describes a model."""
    if not path.is_file():
        return {}
    with bounded(path, ModelError):
        document = json.loads(path.read_text(encoding="utf-8"))
    properties = document.get("properties", {}) if isinstance(document, dict) else {}
    inputs, outputs = properties.get("mlm:input"), properties.get("mlm:output")
    if not inputs or not outputs:
        return {}
    metadata = _read_scaling(inputs[0])
    tasks = outputs[0].get("tasks") or properties.get("mlm:tasks") or []
    if tasks:
        metadata["model_type"] = next(("Segmentor" for task in tasks if "segmentation" in task), tasks[0])
    if classes := outputs[0].get("classification:classes"):
        metadata["classes"] = {int(each["value"]): str(each["name"]) for each in classes}
    if "gsd" in properties:
        metadata["resolution_m"] = float(properties["gsd"])
    shape = inputs[0].get("input", {}).get("shape", [])
    if len(shape) == 4 and min(shape[2:]) > 0:
        metadata["tile"] = int(shape[2])
    return metadata


def _read_scaling(described: dict[str, Any]) -> dict[str, Any]:
    """Turn MLM's scaling of 8-bit values, a chain of affine maps, into mean and deviation of values up to 1."""
    steps = described.get("value_scaling") or []
    steps = steps if isinstance(steps, list) else [steps]
    low, high = [], []  # images of 0 and 1 (that is, 255)
    for step in steps if len(steps) == 3 else steps[:1] * 3:
        shift, divisor = _affine(step)
        unit = 1.0 if abs(shift) <= 1.5 and divisor <= 1.5 else 255.0
        low.append(shift / unit)
        high.append(divisor / unit)
    return {"mean": low, "std": high} if low else {}


def _affine(step: dict[str, Any]) -> tuple[float, float]:
    """Return the subtrahend and the divisor of the scaling."""
    kind = step.get("type")
    if kind is None:
        return 0.0, 1.0
    if kind == "z-score":
        return float(step["mean"]), float(step["stddev"])
    if kind == "min-max":
        return float(step["minimum"]), float(step["maximum"]) - float(step["minimum"])
    if kind == "scale":
        return 0.0, float(step["value"])
    raise ModelError(f"asks for values scaled by {kind!r}; expected z-score, min-max or scale")


def _triple(value: Any, what: str) -> tuple[float, float, float]:
    """Return three finite numbers; one is repeated."""
    numbers = [float(number) for number in (value if isinstance(value, list | tuple) else [value])]
    numbers = numbers * 3 if len(numbers) == 1 else numbers
    if len(numbers) != 3 or not all(-1e4 < number < 1e4 for number in numbers):
        raise ValueError(f"{what} {value}")
    return numbers[0], numbers[1], numbers[2]


def _within(value: Any, low: float, high: float, what: str) -> float:
    number = float(value)
    if not low <= number <= high:
        raise ValueError(f"{what} {number:g}, expected {low:g} to {high:g}")
    return number
