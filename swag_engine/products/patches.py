"""Patches of a label map as polygons: GeoJSON and COCO."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .geotiff import NO_LABEL
from .packages import require_packages

DEGREES = "EPSG:4326"
"""Coordinate reference system of GeoJSON (RFC 7946)."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Connected pixels of one label.

    Attributes:
        label: Number of the label.
        outline: shapely polygon in pixels of the map: columns to the right, rows down.
        pixels: Number of pixels.
    """

    label: int
    outline: Any
    pixels: int


def find_patches(labels: Path, least: int) -> list[Patch]:
    """Find the patches of a label map; pixels that touch at a corner belong together.

    GDAL reads two rows of pixels at a time: memory grows with the outlines alone.

    Args:
        labels: The file of the label map.
        least: Smallest number of pixels of a patch.
    """
    rasterio = require_packages()
    from rasterio.features import shapes
    from shapely import transform
    from shapely.affinity import affine_transform
    from shapely.geometry import shape

    patches = []
    with rasterio.open(labels) as dataset:
        # GDAL gives coordinates of the map.
        to_pixels = ~dataset.transform
        matrix = [to_pixels.a, to_pixels.b, to_pixels.d, to_pixels.e, to_pixels.c, to_pixels.f]
        for outline, label in shapes(rasterio.band(dataset, 1), connectivity=8):
            if label in (0, NO_LABEL):
                continue
            polygon = transform(affine_transform(shape(outline), matrix), np.round)
            if polygon.area >= least:
                patches.append(Patch(int(label), polygon, round(polygon.area)))
    return patches


def to_geojson(patches: list[Patch], transform: Any, crs: Any, pixel: float, names: dict[int, str]) -> dict[str, Any]:
    """Describe patches as a GeoJSON document: in degrees where the map has a known system, else in its own lengths.

    Args:
        patches: The patches.
        transform: From pixels to coordinates.
        crs: Coordinate reference system of the map; None or a local one where it is not known.
        pixel: Edge of a pixel.
        names: Names of the labels.
    """
    from shapely import transform as project
    from shapely.affinity import affine_transform
    from shapely.geometry import mapping

    matrix = [transform.a, transform.b, transform.d, transform.e, transform.c, transform.f]
    to_degrees = None
    if crs is not None and crs.is_projected:
        import pyproj

        to_degrees = pyproj.Transformer.from_crs(crs.to_wkt(), DEGREES, always_xy=True).transform
    features = []
    for number, patch in enumerate(patches, start=1):
        outline = affine_transform(patch.outline, matrix)
        properties = {
            "patch": number, "label": patch.label, "name": names[patch.label], "planar_area": patch.pixels * pixel**2,
        }  # fmt: skip
        if to_degrees:
            outline = project(outline, to_degrees, interleaved=False)
        geometry = mapping(outline)
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    return {"type": "FeatureCollection", "features": features}


def to_coco(patches: list[Patch], image: str, width: int, height: int, names: dict[int, str]) -> dict[str, Any]:
    """Describe patches as a COCO document; patches with holes are cut into polygons without.

    Args:
        patches: The patches.
        image: File name of the label map.
        width: Its columns.
        height: Its rows.
        names: Names of the labels.
    """
    annotations = []
    for number, patch in enumerate(patches, start=1):
        left, top, right, bottom = patch.outline.bounds
        parts = _without_holes(patch.outline)
        annotations.append(
            {
                "id": number,
                "image_id": 1,
                "category_id": patch.label,
                "iscrowd": 0,
                "area": patch.pixels,
                "bbox": [left, top, right - left, bottom - top],
                "segmentation": [[value for point in part.exterior.coords[:-1] for value in point] for part in parts],
            }  # fmt: skip
        )
    return {
        "images": [{"id": 1, "file_name": image, "width": width, "height": height}],
        "categories": [{"id": label, "name": name} for label, name in names.items() if label],
        "annotations": annotations,
    }


def _without_holes(polygon: Any) -> list[Any]:
    """Cut a polygon through its holes until no part has one."""
    from shapely.geometry import box

    if not polygon.interiors:
        return [polygon]
    left, top, right, bottom = polygon.bounds
    middle = round(polygon.interiors[0].centroid.x)
    parts = []
    for half in (box(left, top, middle, bottom), box(middle, top, right, bottom)):
        cut = polygon.intersection(half)
        pieces = getattr(cut, "geoms", [cut])
        parts += [part for piece in pieces if piece.geom_type == "Polygon" for part in _without_holes(piece)]
    return parts
