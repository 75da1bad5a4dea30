"""Where a color chart is in the scene: from its patches in several photos, without knowing its size."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from ..scene.cameras import Camera
from .chart_kinds import PATCH
from .find_chart import ChartObservation

MOST_MISFIT = 0.5
"""Root mean square distance of the patches from those of one chart at rest, in patches."""
LEAST_MISFIT = 0.02
"""The same that is expected at least: patches are not found more exactly."""
MOST_SIZE_ERROR = 0.1
"""Standard deviation of the chart's size in fractions of it; beyond, the photos are from too near one another."""


@dataclass(frozen=True, eq=False)
class ChartRanges:
    """Distances of the patches from the cameras.

    Attributes:
        ranges: (V, N) scene units, None where they are not known.
        problem: A sentence that says why they are not known, else "".
    """

    ranges: np.ndarray | None
    problem: str = ""


def chart_ranges(cameras: Sequence[Camera], observations: Sequence[ChartObservation]) -> ChartRanges:
    """Find the range of each patch in each of V images.

    Place, direction and size of one flat chart are fitted to the patches that each image shows.

    Args:
        cameras: Cameras of the images.
        observations: The same chart in each.

    Returns:
        The ranges.
    """
    if len(cameras) < 2:
        return ChartRanges(None, "The chart is in one photo only, so its distance is not known.")
    kind = observations[0].kind
    flat = np.column_stack([kind.centres - kind.size / 2, np.zeros(len(kind.centres))]) / kind.size[0]
    seen = np.stack([observation.centres for observation in observations])
    used = np.stack([observation.used for observation in observations])
    patch = np.array([_patch_side(observation) for observation in observations])

    def misfits(pose: np.ndarray) -> np.ndarray:
        """Misfit of the patches in patches; pose: rotation vector, place, logarithm of the width."""
        places = _in_world(pose, flat)
        found = np.stack([_project(camera, places) for camera in cameras])
        return ((found - seen) / patch[:, None, None])[used].ravel()

    best = int((patch * used.mean(1)).argmax())
    starts = _starts(cameras[best], seen[best][used[best]], flat[used[best]])
    start = min(starts, key=lambda pose: float((misfits(pose) ** 2).sum()))
    fit = least_squares(misfits, start, loss="soft_l1", f_scale=0.2, x_scale="jac")
    misfit = float(np.sqrt((misfits(fit.x) ** 2).reshape(-1, 2).sum(1).mean()))
    if misfit > MOST_MISFIT:
        return ChartRanges(None, "The chart was moved between the photos, so its distance is not known.")
    normal = fit.jac.T @ fit.jac
    known = normal[6, 6] - normal[6, :6] @ np.linalg.pinv(normal[:6, :6]) @ normal[:6, 6]  # about the width alone
    if max(misfit, LEAST_MISFIT) > MOST_SIZE_ERROR * np.sqrt(max(known, 0)):
        return ChartRanges(
            None, "The photos of the chart were taken from nearly one place, so its distance is not known."
        )
    places = _in_world(fit.x, flat)
    return ChartRanges(np.stack([np.linalg.norm(places - camera.centre, axis=1) for camera in cameras]))


def _patch_side(observation: ChartObservation) -> float:
    """Return the side of a patch in pixels: the root of its mean area."""
    area = abs(cv2.contourArea(observation.corners.astype(np.float32)))
    return PATCH * float(np.sqrt(area / observation.kind.size.prod()))


def _in_world(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) of a chart one unit wide as places in the world."""
    return np.exp(pose[6]) * points @ cv2.Rodrigues(pose[:3])[0].T + pose[3:6]


def _project(camera: Camera, places: np.ndarray) -> np.ndarray:
    """Return places (N, 3) of the world as pixels (N, 2)."""
    seen = places @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    homogeneous = seen @ camera.K.T
    return homogeneous[:, :2] / np.maximum(homogeneous[:, 2:], 1e-9)


def _starts(camera: Camera, centres: np.ndarray, flat: np.ndarray) -> list[np.ndarray]:
    """Return initial values of the pose: one photo does not determine the width of the chart, so that many are tried.

    Each width is paired with the distance at which the chart looks as large as in the photo.
    """
    found, turns, shifts, _ = cv2.solvePnPGeneric(flat, centres, camera.K, np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    to_world = camera.world_to_camera[:3, :3].T
    poses = []
    for turn, shift in zip(turns[:found], shifts[:found], strict=True):
        rotation = cv2.Rodrigues(to_world @ cv2.Rodrigues(turn)[0])[0].ravel()
        for log_width in np.linspace(np.log(1e-3), np.log(1e3), 140):
            poses.append(
                np.concatenate([rotation, camera.centre + np.exp(log_width) * to_world @ shift.ravel(), [log_width]])
            )
    return poses
