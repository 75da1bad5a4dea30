"""Measure scale, axes and coordinates of a scene, and write them to its scale.json."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.text import first_names
from ..scene.colmap import Scene, load_scene
from ..scene.georeference import Axes, Georeference, Placement, describe_scale, write_georeference
from .lengths import scale_of_lengths
from .positions import KnownPosition, gps_positions, point_positions, read_depths
from .similarity import (
    DOUBTFUL_ROTATION,
    UP_ERROR,
    Similarity,
    axis_error,
    fit_similarity,
    leave_one_out,
    robust_inliers,
    rotation_to_z_up,
)
from .targets import Progress, find_targets, parse_distances, target_lengths

GROUPS = 20
"""Most groups of positions that are left out in turn. Neighbours are in one group, as their GPS errors are alike."""
MOST_SCALE_ERROR = 0.2
"""Relative error of the scale above which it is refused."""
LEAST_DEPTH_ERROR = 0.02
"""Standard deviation in metres that depths have at least: waves and the sensor."""
LARGE_COORDINATE = 1e4
"""Metres: above it float32 loses millimetres, and an offset is subtracted."""
CRS = re.compile(r"[A-Za-z][A-Za-z0-9]*:[A-Za-z0-9.+:-]+")
"""Names of coordinate reference systems, such as EPSG:32633 or EPSG:32633+5773."""


@dataclass(frozen=True)
class Measurements:
    """What is known of a scene in metres.

    Attributes:
        targets: Family of coded targets in the photos (georeference/families.py), None without.
        size: Edge length of the targets with their black border, metres; None where it is not known.
        distances: Distances between the middles of two targets, such as "3,7=0.5".
        points: Table of reference points.
        gps: Whether to use the GPS tags of the photos.
        depths: Table of the depths of photos.
        crs: Coordinate reference system of the reference points.

    Raises:
        InputError: If they cannot be used together, or none is given.
    """

    targets: str | None = None
    size: float | None = None
    distances: tuple[str, ...] = ()
    points: Path | None = None
    gps: bool = False
    depths: Path | None = None
    crs: str | None = None

    def __post_init__(self) -> None:
        if self.size is not None and not 0 < self.size < 1e3:
            raise InputError(f"The size of the targets is {self.size:g} m: give the length of an edge in metres.")
        if not self.targets and (self.size is not None or self.distances):
            raise InputError("A size and distances are those of targets: give their family with --targets, too.")
        if self.targets and not (self.size or self.distances or self.points):
            raise InputError(
                "The targets need a known length: give their edge with --size, a distance with --distance 3,7=0.5, or "
                "their coordinates with --points."
            )
        if self.points and self.gps:
            raise InputError("Give reference points or GPS, not both: each places the scene by itself.")
        if self.crs and not self.points:
            raise InputError("The coordinate reference system is that of reference points: give them with --points.")
        if self.crs and not CRS.fullmatch(self.crs):
            raise InputError(f"The coordinate reference system {self.crs!r} is no name such as EPSG:32633.")
        if not (self.targets or self.points or self.gps or self.depths):
            raise InputError("Give targets, reference points, GPS or depths to measure the scale from.")


def scale_scene(folder: Path, known: Measurements, progress: Progress | None = None) -> dict[str, Any]:
    """Measure a scene and write its scale.json.

    Args:
        folder: Folder of the scene.
        known: What is known of it.
        progress: Called with the stage and its fraction; what it raises ends the measurement.

    Returns:
        The document of scale.json with `scene` and `path`.

    Raises:
        InputError: If the scene or the measurements cannot be used; the file is then as it was.
    """
    scene = load_scene(folder, read_scale=False)
    measured = measure(scene, known, progress)
    path = write_georeference(scene.folder, measured.for_model(scene.origin))
    return {"scene": str(scene.folder), "path": str(path)} | measured.to_json()


def describe(document: dict[str, Any]) -> str:
    """Return the lines that the command `scale` prints.

    Args:
        document: What `scale_scene` returned.
    """
    residuals = sorted(document["residuals"].items(), key=lambda item: -abs(item[1]))
    lines = [f"Scale: {describe_scale(document)}"]
    lines += [f"  {name}: off by {1000 * value:+.3g} mm" for name, value in residuals[:10]]
    if len(residuals) > 10:
        lines.append(f"  and {len(residuals) - 10} more, in {document['path']}")
    return "\n".join([*lines, *document["notes"], document["path"]])


def measure(scene: Scene, known: Measurements, progress: Progress | None = None) -> Georeference:
    """Measure scale, axes and coordinates of a scene.

    The scale is that of targets with a known size or distance, else of reference points or GPS, else of depths. Axes
    and coordinates are those of reference points or GPS, else z is up by the depths, else by estimate.

    Args:
        scene: The scene.
        known: What is known of it.
        progress: Called with the stage and its fraction.

    Returns:
        The similarity.

    Raises:
        InputError: If the measurements cannot be used, or do not determine the scale.
    """
    notes: list[str] = []
    residuals: dict[str, float] = {}
    distances = parse_distances(known.distances)
    targets, found_notes = find_targets(scene, known.targets, progress) if known.targets else ({}, [])
    notes += found_notes
    scale: tuple[float, float] | None = None
    if known.size or distances:
        metres, error, residuals, length_notes = scale_of_lengths(target_lengths(targets, known.size, distances))
        scale, notes = (metres, error), notes + length_notes
    depths = read_depths(known.depths, scene) if known.depths else {}
    if known.points or known.gps:
        if known.points:
            positions, crs, point_notes = point_positions(known.points, scene, targets, known.crs)
            notes += point_notes
        else:
            positions, crs, gps_notes = gps_positions(scene, depths)
            notes += gps_notes
        return _from_positions(scene, positions, crs, scale, known, residuals, notes)
    if depths:
        return _from_depths(scene, depths, scale, residuals, notes)
    assert scale
    return Georeference(
        scale[0], scale[1], "targets", "estimated", rotation_to_z_up(scene.up), np.zeros(3),
        residuals=residuals, notes=tuple(notes),
    )  # fmt: skip


def _from_positions(
    scene: Scene,
    positions: Sequence[KnownPosition],
    crs: str | None,
    scale: tuple[float, float] | None,
    known: Measurements,
    residuals: Mapping[str, float],
    notes: list[str],
) -> Georeference:
    """Fit the similarity that takes known positions to their coordinates; `scale` and its error where measured."""
    source = np.stack([position.source for position in positions])
    target = np.stack([position.target for position in positions])
    offset = np.where(np.abs(target).max(0) > LARGE_COORDINATE, np.round(target.mean(0)), 0.0)
    local = target - offset
    what = "reference points" if known.points else "GPS positions"
    if np.linalg.norm(np.ptp(source, axis=0)) < 1e-9 or np.linalg.norm(np.ptp(local, axis=0)) < 1e-6:
        raise InputError(f"All {what} are at one place: they give no scale.")
    kept = robust_inliers(source, local)
    if not kept.all():
        wrong = [position.name for position, keep in zip(positions, kept, strict=True) if not keep]
        notes.append(
            f"{len(wrong)} of {len(positions)} {what} contradict the others and were left out: {first_names(wrong)}."
        )
    groups = np.array_split(np.flatnonzero(kept), min(int(kept.sum()), GROUPS))
    fixed = scale[0] if scale else 0.0

    def fit(parts: Sequence[np.ndarray], up: tuple[np.ndarray, float] | None = None) -> Similarity:
        chosen = np.concatenate(parts)
        return fit_similarity(source[chosen], local[chosen], up, fixed)

    result = fit(groups)
    distances = np.linalg.norm(result(source) - local, axis=1)
    freedom = 3 * kept.sum() - 7
    extent = float(np.linalg.norm(np.ptp(local[kept], axis=0)))
    # Two points fit exactly, whatever their errors are.
    sigma = math.sqrt((distances[kept] ** 2).sum() / freedom) if freedom > 0 else 0.01 * extent
    axes: Axes = "full"
    doubt = axis_error(local[kept], sigma)
    if doubt > DOUBTFUL_ROTATION:
        axes = "estimated"
        doubt_text = f"to {math.degrees(doubt):.0f}°" if doubt < math.pi / 2 else "not at all"
        notes.append(
            f"The {what} determine the axes {doubt_text} (threshold {math.degrees(DOUBTFUL_ROTATION):.0f}°), as they "
            "lie nearly on a straight line or close together for their errors: the up direction was estimated from "
            "cameras and points."
        )
        up = (scene.up, sigma**2 / (result.scale * UP_ERROR**2))
        result = fit(groups, up)
        distances = np.linalg.norm(result(source) - local, axis=1)
        if _heading_error(local[kept], sigma) > DOUBTFUL_ROTATION:
            notes.append(f"The {what} do not determine the heading: x and y are not those of their coordinates.")
    error: float | None
    if scale:
        metres, error = scale
        own = fit_similarity(source[kept], local[kept]).scale
        if abs(own / metres - 1) > max(0.03, 3 * scale[1]) and len(positions) > 2:
            notes.append(f"The {what} say {own:.4g} m per unit, the targets {metres:.4g} m: the targets were followed.")
    else:
        metres = result.scale
        if len(groups) > 2:
            error = leave_one_out(groups, lambda parts: fit(parts).scale)
        else:
            error = None
            notes.append("Two reference points give no error of the scale: a third one would.")
        if error is not None and error > MOST_SCALE_ERROR:
            raise InputError(
                f"The {what} do not give the scale: its error would be {error:.0%} (at most {MOST_SCALE_ERROR:.0%}), "
                "as they are too close together for their errors."
            )
    residuals = {**residuals, **{p.name: float(d) for p, d in zip(positions, distances, strict=True)}}
    has_place = crs is not None or bool(offset.any())
    x, y, z = offset.tolist()
    method = "targets" if scale else "points" if known.points else "gps"
    return Georeference(
        metres, error, method, axes, result.rotation, result.translation,
        Placement(crs, (x, y, z)) if has_place else None, residuals, tuple(notes),
    )  # fmt: skip


def _heading_error(local: np.ndarray, sigma: float) -> float:
    """Return the standard error in radians of the rotation about z."""
    horizontal = local[:, :2] - local[:, :2].mean(0)
    return sigma / max(float(np.linalg.norm(horizontal)), 1e-300)


def _from_depths(
    scene: Scene,
    depths: Mapping[str, float],
    scale: tuple[float, float] | None,
    residuals: Mapping[str, float],
    notes: list[str],
) -> Georeference:
    """Fit scale and up direction so that heights of the cameras are minus their depths."""
    views = [view for view in scene.views if view.name in depths]
    heights = -np.array([depths[view.name] for view in views])
    centres = np.stack([view.camera.centre for view in views])
    if len(views) < 4:
        raise InputError(f"{len(views)} photos with a camera have a depth, and at least four are needed.")
    middle = centres.mean(0)
    full = np.column_stack([centres - middle, np.ones(len(views))])
    along = np.column_stack([(centres - middle) @ scene.up, np.ones(len(views))])
    kept = np.ones(len(views), bool)
    for _ in range(3):
        solution = np.linalg.lstsq(full[kept], heights[kept], rcond=None)[0]
        off = np.abs(full @ solution - heights)
        kept = off <= max(5 * float(np.median(off[kept])), 3 * LEAST_DEPTH_ERROR)
    sigma = max(math.sqrt((off[kept] ** 2).sum() / max(kept.sum() - 4, 1)), LEAST_DEPTH_ERROR)
    gradient = solution[:3]
    metres = float(np.linalg.norm(gradient))
    up = gradient / max(metres, 1e-300)
    # Standard error of the gradient across itself, as an angle; what the positions do not show has none.
    information = full[kept, :3].T @ full[kept, :3] / sigma**2
    across = np.linalg.svd(up[None])[2][1:]
    tilt = (
        1 / math.sqrt(max(float(np.linalg.eigvalsh(across @ information @ across.T)[0]), 1e-300)) / max(metres, 1e-300)
    )
    groups = np.array_split(np.flatnonzero(kept), min(int(kept.sum()), GROUPS))
    axes: Axes = "up"
    if tilt > DOUBTFUL_ROTATION:
        axes, up = "estimated", scene.up
        notes.append(
            f"The depths do not determine the up direction to {math.degrees(DOUBTFUL_ROTATION):.0f}°: it was estimated "
            "from cameras and points. Photos from different depths and sides would help."
        )

    def slope(parts: Sequence[np.ndarray]) -> float:
        """Return metres per unit from the cameras of some groups."""
        chosen = np.concatenate(parts)
        if axes == "up":
            return float(np.linalg.norm(np.linalg.lstsq(full[chosen], heights[chosen], rcond=None)[0][:3]))
        return float(np.linalg.lstsq(along[chosen], heights[chosen], rcond=None)[0][0])

    if not scale:
        metres = slope(groups)
        spread = float(np.linalg.norm((centres[kept] - middle) @ up)) * max(metres, 1e-300)
        error = max(leave_one_out(groups, slope) or 0.0, sigma / max(spread, 1e-300))
        if not metres > 0 or error > MOST_SCALE_ERROR:
            raise InputError(
                f"The depths do not give the scale, as they vary by {np.ptp(heights):.2g} m only: its error would be "
                f"{min(error, 9.99):.0%} (at most {MOST_SCALE_ERROR:.0%}). Measure it from targets, or take photos "
                "from more different depths."
            )
        scale = (metres, error)
    rotation = rotation_to_z_up(up)
    turned = scale[0] * centres @ rotation.T
    translation = np.array([*-turned[:, :2].mean(0), np.median(heights[kept] - turned[kept, 2])])
    off = turned[:, 2] + translation[2] - heights
    wrong = [view.name for view, keep in zip(views, kept, strict=True) if not keep]
    if wrong:
        notes.append(
            f"{len(wrong)} of {len(views)} depths contradict the others and were left out: {first_names(wrong)}."
        )
    named = {view.name: float(value) for view, value in zip(views, off, strict=True)}
    method = "targets" if residuals else "depths"
    return Georeference(
        *scale, method, axes, rotation, translation, residuals={**residuals, **named}, notes=tuple(notes)
    )
