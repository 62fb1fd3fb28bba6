"""A result as an IIIF Georeference Annotation (Georeference Extension 1.0), for Allmaps and library viewers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from roadgeo.outputs.subject import Subject

__all__ = ["write_iiif"]

_CONTEXTS = [
    "http://iiif.io/api/extension/georef/1/context.json",
    "http://iiif.io/api/presentation/3/context.json",
]


def write_iiif(path: Path, subject: Subject) -> None:
    """Write control points all over the picture, in its pixels and in longitude and latitude.

    The extension knows no homography, so viewers are asked for a thin plate spline through the points. The picture is
    called by its file name: put the address of its image service in that place, twice.
    """
    from roadgeo.geometry.projection import to_lonlat

    # A feature for each control point: a pixel of the picture, and where it lies.
    width, height = subject.size
    points = np.array(subject.control_points())
    lonlat = to_lonlat(subject.place.crs, points[:, 2:])
    features = [
        {
            "type": "Feature",
            "properties": {"resourceCoords": [column, row]},
            "geometry": {"type": "Point", "coordinates": [lon, lat]},
        }
        for (column, row), (lon, lat) in zip(points[:, :2].tolist(), lonlat.tolist(), strict=True)
    ]
    # The annotation that ties them to the picture, all of which is shown.
    outline = f"0,0 {width},0 {width},{height} 0,{height}"
    name = subject.picture.name
    annotation = {
        "@context": _CONTEXTS,
        "id": f"{name}#georeference",
        "type": "Annotation",
        "motivation": "georeferencing",
        "target": {
            "type": "SpecificResource",
            "source": {"id": name, "type": "Image", "width": width, "height": height},
            "selector": {
                "type": "SvgSelector",
                "value": f'<svg width="{width}" height="{height}"><polygon points="{outline}" /></svg>',
            },
        },
        "body": {
            "type": "FeatureCollection",
            "transformation": {"type": "thinPlateSpline"},
            "features": features,
        },
    }
    path.write_text(json.dumps(annotation, indent=2) + "\n", encoding="utf-8")
