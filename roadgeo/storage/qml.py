"""How QGIS draws our layers: small QML documents, so that a file opens styled without QGIS having made it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

__all__ = [
    "draw_arrow",
    "draw_fill",
    "draw_line",
    "draw_marker",
    "draw_palette",
    "name_features",
    "seen_from",
    "widen_by",
]


def draw_line(color: str, width_mm: float) -> str:
    """Style a line layer. Colours are "r,g,b" or "r,g,b,a"."""
    line = {"line_color": color, "line_style": "solid", "line_width": width_mm, "line_width_unit": "MM"}
    return _vector("line", _layer("SimpleLine", {**line, "capstyle": "round", "joinstyle": "round"}))


def draw_arrow(color: str, width_mm: float) -> str:
    """Style a line layer with an arrow from the first vertex to the last."""
    head = '<symbol type="fill" name="@0@0" alpha="1">' + _layer("SimpleFill", {"color": color}) + "</symbol>"
    options = {"arrow_width": width_mm, "arrow_start_width": width_mm, "is_curved": 0}
    sizes = {"head_length": 1.4, "head_thickness": 0.9, "head_type": 0, "arrow_type": 0}
    arrow = _layer("ArrowLine", {**options, **sizes}).replace("</layer>", f"{head}</layer>")
    return _vector("line", arrow)


def draw_fill(color: str, outline: str, outline_width_mm: float) -> str:
    """Style a polygon layer: a fill (its alpha may be 0) and an outline."""
    options = {"color": color, "style": "solid", **_outline(outline, outline_width_mm), "joinstyle": "round"}
    return _vector("fill", _layer("SimpleFill", options))


def draw_marker(color: str, size_mm: float) -> str:
    """Style a point layer with circles, white around."""
    options = {"name": "circle", "color": color, "size": size_mm, "size_unit": "MM", **_outline("255,255,255", 0.2)}
    return _vector("marker", _layer("SimpleMarker", options))


def _outline(color: str, width_mm: float) -> dict[str, object]:
    return {"outline_color": color, "outline_style": "solid", "outline_width": width_mm, "outline_width_unit": "MM"}


def draw_palette(entries: Mapping[int, tuple[str, int, str]]) -> str:
    """Style a single-band raster: value to ("#rrggbb", alpha 0..255, label)."""
    rows = "".join(
        f'<paletteEntry value="{value}" color="{color}" alpha="{alpha}" label="{label}"/>'
        for value, (color, alpha, label) in entries.items()
    )
    return _document(
        '<pipe><rasterrenderer type="paletted" band="1" opacity="1" alphaBand="-1" nodataColor="">'
        f"<rasterTransparency/><colorPalette>{rows}</colorPalette></rasterrenderer></pipe>"
    )


def widen_by(style: str, column: str, widths_mm: Mapping[float, Sequence[str]], other_mm: float) -> str:
    """Let the width of a line follow a column: a width for the values of each group, another for all else."""
    cases = " ".join(
        f"WHEN &quot;{column}&quot; IN ({', '.join(f'&#39;{value}&#39;' for value in values)}) THEN {width}"
        for width, values in widths_mm.items()
    )
    expression = f"CASE {cases} ELSE {other_mm} END"
    rule = (
        '<data_defined_properties><Option type="Map"><Option type="QString" name="name" value=""/>'
        '<Option type="Map" name="properties"><Option type="Map" name="outlineWidth">'
        '<Option type="bool" name="active" value="true"/>'
        f'<Option type="QString" name="expression" value="{expression}"/><Option type="int" name="type" value="3"/>'
        '</Option></Option><Option type="QString" name="type" value="collection"/></Option></data_defined_properties>'
    )
    return style.replace("</layer>", f"{rule}</layer>")


def name_features(style: str, column: str, color: str, from_scale: int) -> str:
    """Write a column along the lines of a layer, at scales of 1 : `from_scale` and larger."""
    labels = (
        '<labeling type="simple"><settings calloutType="simple">'
        f'<text-style fieldName="{column}" fontFamily="Sans" fontSize="8" fontSizeUnit="Point" textColor="{color},255"'
        ' textOpacity="1" isExpression="0" namedStyle="Regular"><text-buffer bufferDraw="1" bufferSize="0.7"'
        ' bufferSizeUnits="MM" bufferColor="255,255,255,255" bufferOpacity="0.8"/></text-style>'
        '<placement placement="3" placementFlags="9" dist="0.3" distUnits="MM" repeatDistance="80"'
        ' repeatDistanceUnits="MM" maxCurvedCharAngleIn="25" maxCurvedCharAngleOut="-25"/>'
        f'<rendering scaleVisibility="1" scaleMin="0" scaleMax="{from_scale}" mergeLines="1" drawLabels="1"/>'
        "</settings></labeling>"
    )
    return style.replace("Symbology", "Symbology|Labeling").replace("</qgis>", f"{labels}</qgis>")


def seen_from(style: str, scale: int) -> str:
    """Show a layer at scales of 1 : `scale` and larger only."""
    shown = f'hasScaleBasedVisibilityFlag="1" minScale="{scale}" maxScale="0"'
    return style.replace("Symbology", "Symbology|Rendering").replace("<qgis ", f"<qgis {shown} ")


def _layer(kind: str, options: Mapping[str, object]) -> str:
    rows = "".join(f'<Option type="QString" name="{name}" value="{value}"/>' for name, value in options.items())
    return f'<layer class="{kind}" enabled="1" locked="0" pass="0"><Option type="Map">{rows}</Option></layer>'


def _vector(kind: str, layers: str) -> str:
    return _document(
        '<renderer-v2 type="singleSymbol" enableorderby="0" forceraster="0" symbollevels="0"><symbols>'
        f'<symbol type="{kind}" name="0" alpha="1" clip_to_extent="1" force_rhr="0">{layers}</symbol>'
        "</symbols><rotation/><sizescale/></renderer-v2>"
    )


def _document(body: str) -> str:
    return f'<!DOCTYPE qgis><qgis version="3.22" styleCategories="Symbology">{body}</qgis>'
