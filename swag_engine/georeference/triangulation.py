"""Places in the scene from where they are seen in photos with known cameras."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..scene.colmap import View
from ..scene.colmap_library import pycolmap

LEAST_ANGLE = math.radians(1.5)
"""Smallest angle between two rays that place a point along them."""
MOST_ERROR = 0.004
"""Largest reprojection error as a fraction of the image's width, 4 px of 1000: above it an observation is wrong."""
LEAST_ERROR = 0.2
"""Standard deviation in pixels that an observation has at least: corners are not found more exactly under water."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Where a point is seen.

    Attributes:
        view: The view.
        pixel: Position (2,) in COLMAP's pixels of the image of the view's lens.
    """

    view: View
    pixel: np.ndarray


@dataclass(frozen=True, eq=False)
class PlacedPoint:
    """A triangulated point.

    Attributes:
        position: Position (3,), scene units.
        covariance: Its covariance (3, 3), from the observations alone.
        error: Root mean square reprojection error, pixels.
        views: Number of views that agree.
    """

    position: np.ndarray
    covariance: np.ndarray
    error: float
    views: int


def triangulate(observations: Sequence[Observation]) -> PlacedPoint | None:
    """Triangulate a point robustly, and refine it so that squared reprojection errors are least.

    Args:
        observations: Where it is seen, in full images of any lens.

    Returns:
        The point; None where fewer than two views agree, or their rays are almost parallel.
    """
    if len(observations) < 2:
        return None
    lenses = [observation.view.lens for observation in observations]
    pixels = np.stack([observation.pixel for observation in observations])
    poses = np.stack([observation.view.camera.world_to_camera for observation in observations])
    options = pycolmap.EstimateTriangulationOptions()
    options.min_tri_angle = LEAST_ANGLE
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = MOST_ERROR * max(lens.width for lens in lenses)
    options.ransac.random_seed = 0
    found = pycolmap.estimate_triangulation(
        pixels, [pycolmap.Rigid3d(pose[:3]) for pose in poses], [lens.camera for lens in lenses], options
    )
    if not found:
        return None
    agree = np.flatnonzero(found["inliers"])
    if len(agree) < 2:
        return None

    def residuals(point: np.ndarray) -> np.ndarray:
        """Return reprojection errors (2 V,)."""
        in_camera = poses[agree, :3, :3] @ point + poses[agree, :3, 3]
        seen = [lenses[i].camera.img_from_cam(xyz[None])[0] for i, xyz in zip(agree, in_camera, strict=True)]
        return (np.stack(seen) - pixels[agree]).ravel()

    point = np.array(found["xyz"], np.float64)
    step = 1e-6 * float(np.linalg.norm(point - observations[int(agree[0])].view.camera.centre))
    for _ in range(5):  # Gauss-Newton
        at = residuals(point)
        slopes = np.stack([(residuals(point + step * axis) - at) / step for axis in np.eye(3)], axis=1)
        if not np.isfinite(slopes).all():
            return None
        point = point - np.linalg.lstsq(slopes, at, rcond=None)[0]
    at = residuals(point)
    if not np.isfinite(at).all():
        return None
    error = math.sqrt(float((at**2).reshape(-1, 2).sum(1).mean()))
    sigma = max(error / math.sqrt(2), LEAST_ERROR)
    return PlacedPoint(point, sigma**2 * np.linalg.pinv(slopes.T @ slopes), error, len(agree))
