"""Summary of a scene, as a document and as text."""

import math
from collections import defaultdict
from typing import Any

import numpy as np

from .cameras import Camera
from .colmap import Scene, View
from .split import split_views

_LARGE_ERROR = 2.0
"""Mean reprojection error in pixels above which poses are doubtful: COLMAP drops observations above 4, and the example
scenes have 0.3 to 0.7."""
_FEW_POINTS = 40
"""Points of an image below which its pose is doubtful: COLMAP accepts a pose from 30 on."""
_FIELDS_OF_VIEW = 15.0, 140.0
"""Horizontal fields of view in degrees, from that of a telephoto lens to that of the widest action cameras: outside of
them a focal length is probably wrong."""


def inspect_scene(scene: Scene) -> dict[str, Any]:
    """Summarise a scene.

    Args:
        scene: The scene.

    Returns:
        A dict for JSON. `ranges` are those from camera centre to sparse point over all observations, in scene units:
        percentiles 5, 25, 50, 75, 95, and `ratio`, the 95th over the 5th. Sizes are in pixels; `undistorted` is that
        of the pinhole image, `focal_length` in pixels and the horizontal `field_of_view` in degrees are medians of
        pinhole images. `warnings` are the scene's, and sentences about what is doubtful in the poses.
    """
    points = scene.points
    ranges = np.concatenate(
        [np.linalg.norm(points.positions[view.point_indices] - view.camera.centre, axis=1) for view in scene.views]
    )
    percentiles = np.percentile(ranges, [5, 25, 50, 75, 95]) if len(ranges) else np.full(5, np.nan)
    lenses: defaultdict[tuple[Any, ...], list[Camera]] = defaultdict(list)
    for view in scene.views:
        lens, camera = view.lens, view.camera
        lenses[lens.model, lens.width, lens.height, camera.width, camera.height].append(camera)
    registered = len(scene.views) + len(scene.missing)
    known_errors = points.errors[points.errors >= 0]
    error = float(known_errors.mean()) if len(known_errors) else None
    split = split_views(view.name for view in scene.views)
    return {
        "scene": str(scene.folder),
        "model": str(scene.model_folder),
        "image_folder": str(scene.image_folder),
        "images": scene.image_count,
        "registered": registered,
        "registered_share": min(1.0, registered / scene.image_count) if scene.image_count else 0.0,
        "views": len(scene.views),
        "missing": list(scene.missing),
        "cameras": [
            {
                "model": model,
                "width": width,
                "height": height,
                "undistorted": undistorted,
                "focal_length": float(np.median([camera.fx for camera in cameras])),
                "field_of_view": float(np.median([_field_of_view(camera) for camera in cameras])),
                "views": len(cameras),
            }
            for (model, width, height, *undistorted), cameras in sorted(lenses.items(), key=lambda item: -len(item[1]))
        ],
        "points": len(points.positions),
        "points_per_view": float(np.mean([len(view.point_indices) for view in scene.views])),
        "track_length": float(points.track_lengths.mean()),
        "reprojection_error": error,
        "ranges": {
            **{f"p{p}": _number(value) for p, value in zip((5, 25, 50, 75, 95), percentiles, strict=True)},
            "ratio": _number(percentiles[4] / percentiles[0]) if percentiles[0] > 0 else None,
        },
        "up": [float(value) for value in scene.up],
        "split": {"train": len(split.train), "validation": len(split.validation), "test": len(split.test)},
        "warnings": [*scene.warnings, *_doubts(scene.views, error)],
    }


def _doubts(views: tuple[View, ...], error: float | None) -> list[str]:
    """Return sentences about poses and lenses that are probably wrong."""
    doubts = []
    if error is not None and error > _LARGE_ERROR:
        doubts.append(
            f"The mean reprojection error is {error:.1f} px (threshold {_LARGE_ERROR:g} px): the poses are doubtful."
        )
    # A model may come without observations, from a simulator or a survey.
    weak = [view.name for view in views if 0 < len(view.point_indices) < _FEW_POINTS]
    if weak:
        doubts.append(
            f"Photos with fewer than {_FEW_POINTS} points, whose poses are doubtful: "
            f"{', '.join(weak[:3])}{' ...' if len(weak) > 3 else ''}."
        )
    least, most = _FIELDS_OF_VIEW
    fields = [_field_of_view(view.camera) for view in views]
    odd = [field for field in fields if not least <= field <= most]
    if odd:
        doubts.append(
            f"A horizontal field of view of {odd[0]:.0f}° is unlikely (usual: {least:.0f}° to {most:.0f}°): the focal "
            "length is doubtful, and photos from more directions would help."
        )
    return doubts


def _field_of_view(camera: Camera) -> float:
    """Return the horizontal field of view in degrees."""
    return math.degrees(2 * math.atan2(camera.width, 2 * camera.fx))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def describe(summary: dict[str, Any]) -> str:
    """Format a summary as text.

    Args:
        summary: What `inspect_scene` returned.

    Returns:
        The lines that `inspect SCENE` prints.
    """
    ranges = summary["ranges"]
    error = summary["reprojection_error"]
    split = summary["split"]
    rows = [
        ("Scene", summary["scene"]),
        ("Model", summary["model"]),
        ("Images", f"{summary['images']} in {summary['image_folder']}"),
        ("Registered", f"{summary['registered']} ({summary['registered_share']:.0%})"),
    ]
    for camera in summary["cameras"]:
        size, undistorted = [camera["width"], camera["height"]], camera["undistorted"]
        note = "" if size == undistorted else f", undistorted to {undistorted[0]} x {undistorted[1]}"
        optics = f"focal length {camera['focal_length']:.0f} px, field of view {camera['field_of_view']:.0f}°"
        rows.append(("Camera", f"{camera['model']} {size[0]} x {size[1]}{note}, {optics} ({camera['views']} views)"))
    rows.append(
        (
            "Points",
            f"{summary['points']}, {summary['points_per_view']:.0f} per view, each in {summary['track_length']:.1f}"
            " views" + (f", reprojection error {error:.2f} px" if error is not None else ""),
        )
    )
    if None not in (ranges["p5"], ranges["p50"], ranges["p95"]):
        rows.append(
            (
                "Ranges",
                f"{ranges['p5']:.3g} to {ranges['p95']:.3g}, median {ranges['p50']:.3g} (scene units, 5 to 95 % of "
                "observations)" + (f", ratio 1 : {ranges['ratio']:.2g}" if ranges["ratio"] else ""),
            )
        )
    rows.append(("Views", f"{split['train']} to train, {split['validation']} to validate, {split['test']} to test"))
    rows += [("Warning", warning) for warning in summary["warnings"]]
    return "\n".join(f"{label + ':':<12}{text}" for label, text in rows)
