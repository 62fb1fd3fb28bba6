"""How QGIS draws our layers: small QML documents, so that a file opens styled without QGIS having made it."""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["draw_arrow", "draw_fill", "draw_line", "draw_marker", "draw_palette"]


def draw_line(color: str, width_mm: float, casing: str = "", casing_width_mm: float = 0.0) -> str:
    """Style a line layer; with a `casing`, over a wider line of that colour. Colours are "r,g,b" or "r,g,b,a"."""
    layers = _layer("SimpleLine", _line_options(casing, casing_width_mm)) if casing else ""
    return _vector("line", layers + _layer("SimpleLine", _line_options(color, width_mm)))


def draw_arrow(color: str, width_mm: float) -> str:
    """Style a line layer with an arrow from the first vertex to the last."""
    head = '<symbol type="fill" name="@0@0" alpha="1">' + _layer("SimpleFill", {"color": color}) + "</symbol>"
    options = {"arrow_width": f"{width_mm}", "arrow_start_width": f"{width_mm}", "is_curved": "0"}
    sizes = {"head_length": "1.4", "head_thickness": "0.9", "head_type": "0", "arrow_type": "0"}
    arrow = _layer("ArrowLine", {**options, **sizes}).replace("</layer>", f"{head}</layer>")
    return _vector("line", arrow)


def draw_fill(color: str, outline: str, outline_width_mm: float) -> str:
    """Style a polygon layer: a fill (its alpha may be 0) and an outline."""
    options = {
        "color": color,
        "style": "solid",
        "outline_color": outline,
        "outline_style": "solid",
        "outline_width": f"{outline_width_mm}",
        "outline_width_unit": "MM",
        "joinstyle": "round",
    }
    return _vector("fill", _layer("SimpleFill", options))


def draw_marker(color: str, size_mm: float, outline: str = "255,255,255", outline_width_mm: float = 0.2) -> str:
    """Style a point layer with circles."""
    options = {
        "name": "circle",
        "color": color,
        "size": f"{size_mm}",
        "size_unit": "MM",
        "outline_color": outline,
        "outline_style": "solid",
        "outline_width": f"{outline_width_mm}",
        "outline_width_unit": "MM",
    }
    return _vector("marker", _layer("SimpleMarker", options))


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


def _line_options(color: str, width_mm: float) -> dict[str, str]:
    return {
        "line_color": color,
        "line_style": "solid",
        "line_width": f"{width_mm}",
        "line_width_unit": "MM",
        "capstyle": "round",
        "joinstyle": "round",
    }


def _layer(kind: str, options: Mapping[str, str]) -> str:
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
