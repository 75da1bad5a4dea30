"""Find floaters: splats in front of the surface that the photos show, and splats that few photos see.

The first is what the engine's evaluation measures (`floater_mass` of swag_engine/evaluation/metrics.py), computed here
for single splats, in coarse cells of the scene's cameras.
"""

import hashlib
from dataclasses import dataclass

import bpy
import numpy as np

from ..swag_engine.base.errors import InputError
from ..swag_engine.scene.cameras import Camera
from . import labels, scene_import, splat_selection
from .cameras import cameras_of
from .steps import Steps, run_to_end
from .visibility import View, blend

GAP = 0.05
"""Distance of a floater in front of the surface, at least, in median ranges, as FLOATER_GAP of the evaluation; and of
a splat behind the surface, up to which a photo sees it."""
MAX_PROJECTIONS = 40_000_000
"""Splats times cameras at most, which takes about ten seconds; with more, evenly spaced cameras are used."""
HIDDEN_TRANSMITTANCE = 0.05
"""A photo does not see what is behind splats that let through less of the light: behind the surface, which begins where
they let through half, there is much that it sees."""
RANGE_CAMERAS = 5
"""Cameras from which the median range is determined."""


@dataclass(frozen=True, eq=False)
class Observations:
    """What the cameras see of the splats of an object.

    Attributes:
        photos: (N,) number of cameras that see the splat.
        in_front: (N,) fraction 0..1 of what is seen of the splat that lies in front of the surface; 0 for splats that
            are not seen.
        cameras: Number of cameras that were used.
        all_cameras: Number of cameras of the scene.
    """

    photos: np.ndarray
    in_front: np.ndarray
    cameras: int
    all_cameras: int


MAX_KEPT = 4
"""Observations that are kept."""

_kept: dict[bytes, Observations] = {}
"""The last observations, by a digest of what they were computed from: the user tries several thresholds."""


def find(context: bpy.types.Context, obj: bpy.types.Object, in_front: float, photos: int) -> np.ndarray:
    """Mask (N,) bool of the floaters of a splat object; hidden and cropped splats are none and hide no others.

    Args:
        context: its scene's cameras see the splats: those of the photos, or all of the Blender scene without photos.
        obj: a splat object.
        in_front: splats of which at least this fraction lies in front of the surface, 0..1; above 1: none.
        photos: splats that fewer cameras than this see.

    Raises:
        InputError: there is no camera.
    """
    seen = observe(context, obj)
    return labels.drawn(obj) & ((seen.in_front >= in_front) & (seen.photos > 0) | (seen.photos < photos))


def observe(context: bpy.types.Context, obj: bpy.types.Object) -> Observations:
    """Compute which splats of an object the cameras see, and where. Raises InputError without cameras."""
    return run_to_end(observing(context, obj))


def observing(context: bpy.types.Context, obj: bpy.types.Object) -> Steps[Observations]:
    """Do as `observe` in steps of one camera each; what is known already takes no step."""
    root = scene_import.find_root(obj)
    cameras = cameras_of(context, [root] if root else [])
    if not cameras:
        raise InputError("The scene has no cameras: import the photos, or add cameras where they were taken.")
    positions, sizes = splat_selection.world_positions(obj), splat_selection.world_sizes(obj).mean(axis=1)
    opacities, drawn = splat_selection.opacities(obj), labels.drawn(obj)
    digest = hashlib.blake2b()
    for array in (positions, sizes, opacities, drawn, *(c.K for c in cameras), *(c.world_to_camera for c in cameras)):
        digest.update(array.tobytes())
    key = digest.digest()
    if key not in _kept:
        found = yield from _observing(cameras, positions, sizes, opacities, drawn)
        while len(_kept) >= MAX_KEPT:
            del _kept[next(iter(_kept))]
        _kept[key] = found
    return _kept[key]


def _observing(
    cameras: list[Camera], positions: np.ndarray, sizes: np.ndarray, opacities: np.ndarray, drawn: np.ndarray
) -> Steps[Observations]:
    count = len(positions)
    used = cameras[:: max(-(-len(cameras) * count // MAX_PROJECTIONS), 1)]
    reference = used[:: max(len(used) // RANGE_CAMERAS, 1)]
    gap = GAP * _median_range(reference, positions, sizes, opacities, drawn)
    photos, front, whole = np.zeros(count, np.int64), np.zeros(count), np.zeros(count)
    for index, camera in enumerate(used):
        yield index / len(used)
        blended = blend(View.of_camera(camera), positions, sizes, opacities, drawn)
        ranges = np.linalg.norm(positions - camera.centre, axis=1)
        surface = blended.surfaces(ranges)[blended.cell]
        weight = blended.alpha * blended.transmittance
        floats = np.isfinite(surface) & (ranges[blended.splat] < surface - gap)
        front += np.bincount(blended.splat, weight * floats, count)
        whole += np.bincount(blended.splat, weight, count)
        photos += blended.visible(ranges, gap, HIDDEN_TRANSMITTANCE)
    in_front = np.divide(front, whole, out=np.zeros(count), where=whole > 0)
    return Observations(photos, in_front, len(used), len(cameras))


def _median_range(
    cameras: list[Camera], positions: np.ndarray, sizes: np.ndarray, opacities: np.ndarray, drawn: np.ndarray
) -> float:
    """Median over the cells of the cameras of the range of their surface; 0 where there is none."""
    found = []
    for camera in cameras:
        blended = blend(View.of_camera(camera), positions, sizes, opacities, drawn)
        surface = blended.surfaces(np.linalg.norm(positions - camera.centre, axis=1))
        found.append(surface[np.isfinite(surface)])
    ranges = np.concatenate(found)
    return float(np.median(ranges)) if len(ranges) else 0.0


def describe(obj: bpy.types.Object, mask: np.ndarray, seen: Observations) -> str:
    """A sentence about the floaters of an object, given their mask (N,) bool."""
    of_all = f" of {seen.all_cameras}" if seen.cameras < seen.all_cameras else ""
    return (
        f"{int(mask.sum())} of {len(mask)} splats of {obj.name} ({mask.mean():.1%}) are floaters, "
        f"as {seen.cameras}{of_all} cameras see them."
    )
