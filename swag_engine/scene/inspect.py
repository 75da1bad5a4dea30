"""Summary of a scene, as a document and as text."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from .cameras import Camera
from .colmap import Scene, read_model
from .colmap_library import pycolmap
from .georeference import describe_scale
from .model_quality import ModelQuality, assess_model
from .split import split_views
from .unregistered import Unregistered, explain_unregistered, unregistered_sentences


def inspect_scene(scene: Scene) -> dict[str, Any]:
    """Summarise a scene.

    Args:
        scene: The scene.

    Returns:
        A dict for JSON. `ranges` are those from camera centre to sparse point over all observations, in scene units:
        percentiles 5, 25, 50, 75, 95, and `ratio`, the 95th over the 5th. Sizes are in pixels; `undistorted` is that
        of the pinhole image, `focal_length` in pixels and the horizontal `field_of_view` in degrees are medians of
        pinhole images. `triangulation_angle` is the median over the points, in degrees. `focal_error` is the relative
        standard error of the focal length, the largest of several lenses. `drift` compares the first and the last
        visit of a place (see `Drift`). These are None where they cannot be determined. `unregistered` are images
        without a pose, each with the probable reason. `masks` counts the views with a mask, `unused_masks` files.
        `warnings` are the scene's, and sentences about masks and what is doubtful in the poses. `scale` is the document
        of scale.json, None without.
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
    quality = assess_scene(scene)
    unregistered = explain_unregistered(scene)
    focal_errors = [error for error in quality.focal_errors.values() if error is not None]
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
        "triangulation_angle": quality.triangulation_angle,
        "focal_error": max(focal_errors, default=None),
        "drift": asdict(quality.drift) if quality.drift else None,
        "unregistered": [asdict(image) for image in unregistered],
        "ranges": {
            **{f"p{p}": _number(value) for p, value in zip((5, 25, 50, 75, 95), percentiles, strict=True)},
            "ratio": _number(percentiles[4] / percentiles[0]) if percentiles[0] > 0 else None,
        },
        "up": [float(value) for value in scene.up],
        "origin": scene.origin.tolist(),
        "scale": scene.georeference.to_json() if scene.georeference else None,
        "split": {"train": len(split.train), "validation": len(split.validation), "test": len(split.test)},
        "masks": sum(view.path in scene.masks.of for view in scene.views),
        "unused_masks": len(scene.masks.unused),
        "warnings": what_is_doubtful(scene, quality, unregistered),
    }


def assess_scene(scene: Scene) -> ModelQuality:
    """Assess the model of a scene, with the focal lengths that the EXIF data of its images say.

    Raises:
        InputError: When the model cannot be read any more.
    """
    model = read_model(scene)
    paths = {view.name: view.path for view in scene.views}
    samples: dict[int, Path] = {}
    for image in model.images.values():
        if image.name in paths:
            samples.setdefault(image.camera_id, paths[image.name])
    priors = {}
    for camera_id, path in samples.items():
        try:
            named = pycolmap.infer_camera_from_image(str(path))
        except (RuntimeError, ValueError):  # who needs the pixels of an unreadable image says so
            continue
        if named.has_prior_focal_length:
            camera = model.camera(camera_id)  # the image may have been made smaller or larger since
            smaller = max(camera.width, camera.height) / max(named.width, named.height)
            priors[camera_id] = named.mean_focal_length() * smaller
    return assess_model(model, scene.image_count, priors)


def what_is_doubtful(scene: Scene, quality: ModelQuality, unregistered: Sequence[Unregistered]) -> list[str]:
    """Return the sentences about a scene that a user should read."""
    doubts = [doubt.sentence for doubt in quality.doubts if doubt.kind != "registered"]  # the scene says it
    return [*scene.warnings, *scene.masks.warnings(), *doubts, *unregistered_sentences(unregistered)]


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
    angle, focal_error, drift = summary["triangulation_angle"], summary["focal_error"], summary["drift"]
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
    if focal_error is not None:
        rows.append(("Focal error", f"{focal_error:.2%} (standard error of the focal length)"))
    rows.append(
        (
            "Points",
            f"{summary['points']}, {summary['points_per_view']:.0f} per view, each in {summary['track_length']:.1f}"
            " views"
            + (f", triangulation angle {angle:.1f}°" if angle is not None else "")
            + (f", reprojection error {error:.2f} px" if error is not None else ""),
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
    if any(summary["origin"]):
        origin = " ".join(f"{value:.15g}" for value in summary["origin"])
        rows.append(("Origin", f"{origin}: coordinates are far from zero and are computed from there"))
    if summary["scale"]:
        rows.append(("Scale", describe_scale(summary["scale"])))
    if drift is not None:
        rows.append(("Drift", f"{drift['fraction']:.2%} of the path, from {drift['first']} to {drift['last']}"))
    rows.append(("Views", f"{split['train']} to train, {split['validation']} to validate, {split['test']} to test"))
    if summary["masks"] or summary["unused_masks"]:
        rows.append(("Masks", f"for {summary['masks']} of {summary['views']} photos"))
    rows += [("Warning", warning) for warning in summary["warnings"]]
    return "\n".join(f"{label + ':':<13}{text}" for label, text in rows)
