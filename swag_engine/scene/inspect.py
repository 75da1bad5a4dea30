"""Summary of a scene, as a document and as text."""

from collections import Counter
from typing import Any

import numpy as np

from .colmap import Scene
from .split import split_views


def inspect_scene(scene: Scene) -> dict[str, Any]:
    """Summarise a scene.

    Args:
        scene: The scene.

    Returns:
        A dict for JSON. `ranges` are those from camera centre to sparse point over all observations, in scene units:
        percentiles 5, 25, 50, 75, 95, and `ratio`, the 95th over the 5th. Sizes are in pixels; `undistorted` is that
        of the pinhole image.
    """
    points = scene.points
    ranges = np.concatenate(
        [np.linalg.norm(points.positions[view.point_indices] - view.camera.centre, axis=1) for view in scene.views]
    )
    percentiles = np.percentile(ranges, [5, 25, 50, 75, 95]) if len(ranges) else np.full(5, np.nan)
    lenses = Counter((view.lens.model, view.lens.width, view.lens.height, view.camera.width, view.camera.height)
                     for view in scene.views)  # fmt: skip
    registered = len(scene.views) + len(scene.missing)
    known_errors = points.errors[points.errors >= 0]
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
            {"model": model, "width": w, "height": h, "undistorted": [uw, uh], "views": count}
            for (model, w, h, uw, uh), count in lenses.most_common()
        ],
        "points": len(points.positions),
        "points_per_view": float(np.mean([len(view.point_indices) for view in scene.views])),
        "track_length": float(points.track_lengths.mean()),
        "reprojection_error": float(known_errors.mean()) if len(known_errors) else None,
        "ranges": {
            **{f"p{p}": _number(value) for p, value in zip((5, 25, 50, 75, 95), percentiles, strict=True)},
            "ratio": _number(percentiles[4] / percentiles[0]) if percentiles[0] > 0 else None,
        },
        "up": [float(value) for value in scene.up],
        "split": {"train": len(split.train), "validation": len(split.validation), "test": len(split.test)},
        "warnings": list(scene.warnings),
    }


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
        rows.append(("Camera", f"{camera['model']} {size[0]} x {size[1]}{note} ({camera['views']} views)"))
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
