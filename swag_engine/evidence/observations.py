"""Observations: the linear light in which each image shows the sparse points."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from ..base.transfer import linear_of_bytes
from ..scene.colmap import Points
from ..scene.images import TrainingImage

FIT_WIDTH = 640
"""Width that images should have at least, pixels."""
FAR_WINDOW = 0.75
"""Half the width of the patch that a color is averaged over in the farthest view of a point, pixels."""
MAX_WINDOW = 40
"""Half the width of a patch at most, pixels."""
DARK_WINDOW = 9
"""Side of the square that the darkest light around a point is taken from, pixels."""
LEAST_OBSERVATIONS = 200
"""Observations from which effects of range are examined."""
LEAST_RANGE_RATIO = 1.15
"""Farthest over nearest range of a point that one point in twenty must have."""
LEAST_CHANGE = 0.10
"""Fraction of its light that a channel must lose over the scene's range."""
LEAST_BACKGROUND_LIGHT = 0.02
"""Linear light that the water must add at the far end of the scene."""


@dataclass(frozen=True)
class Observations:
    """M observations of points.

    Attributes:
        track: (M,) index of the point.
        ranges: (M,) scene units.
        light: (M, 3) linear.
        image: (M,) index of the image.
        place: (M, 2) place in it, from its centre to the right and down; the corners are at distance 1.
        darkest: (M, 3) least light in a square of DARK_WINDOW pixels around the point.
    """

    track: np.ndarray
    ranges: np.ndarray
    light: np.ndarray
    image: np.ndarray
    place: np.ndarray
    darkest: np.ndarray

    @property
    def radius(self) -> np.ndarray:
        """(M,) distance from the image centre, 1 at the corners."""
        return np.linalg.norm(self.place, axis=1)

    def __len__(self) -> int:
        return len(self.track)

    def take(self, chosen: np.ndarray) -> "Observations":
        """Return the observations of an index or a mask (M,)."""
        return Observations(
            *(values[chosen] for values in (self.track, self.ranges, self.light, self.image, self.place, self.darkest))
        )


def observe(images: Sequence[TrainingImage], point_indices: Sequence[np.ndarray], points: Points) -> Observations:
    """Read the linear light of points where images see them.

    A color is the mean over a patch whose width is proportional to 1 / range, so that all views average the same part
    of the world: a fixed window would blur far texture and leave near texture, which looks like water. Points that
    fewer than two images see, and patches that reach beyond the image or over invalid pixels, are dropped.

    Args:
        images: The images.
        point_indices: (P,) for each image: which points it sees.
        points: The sparse points.

    Returns:
        The observations.
    """
    located = [_project(image, indices, points) for image, indices in zip(images, point_indices, strict=True)]
    farthest = np.zeros(len(points.positions))
    for indices, _, ranges in located:
        np.maximum.at(farthest, indices, ranges)
    parts = []
    for number, (image, (indices, pixels, ranges)) in enumerate(zip(images, located, strict=True)):
        half = np.minimum(FAR_WINDOW * farthest[indices] / ranges, MAX_WINDOW)
        colors, darkest, whole = _patches(image, pixels, half)
        size = np.array(image.valid.shape[::-1])
        place = (pixels - size / 2) / (np.linalg.norm(size) / 2)
        values = (indices, ranges, colors, np.full(len(indices), number), place, darkest)
        parts.append([value[whole] for value in values])
    together = Observations(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    seen = np.bincount(together.track, minlength=len(points.positions))
    return together.take(seen[together.track] > 1)


def _project(image: TrainingImage, indices: np.ndarray, points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the points in front of the camera: index (P,), pixel (P, 2), Euclidean range (P,)."""
    camera = image.camera
    places = points.positions[indices] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    front = places[:, 2] > 0
    indices, places = indices[front], places[front]
    homogeneous = places @ camera.K.T
    return indices, homogeneous[:, :2] / homogeneous[:, 2:], np.linalg.norm(places, axis=1)


def _patches(image: TrainingImage, pixels: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean linear light (P, 3) of squares of half width `half` (P,) around pixels (P, 2).

    Also the darkest light (P, 3) around them, and which squares (P,) lie in valid pixels alone. Pixels that a square
    covers in part count by that part: squares of whole pixels miss the point by up to half of one, which is most of
    the error of far colors.
    """
    height, width = image.valid.shape
    to_light = linear_of_bytes()
    planes = np.concatenate([to_light[image.pixels], image.valid[..., None]], axis=2)
    sums = cv2.integral(planes)
    low, high = pixels - half[:, None], pixels + half[:, None]
    whole = (low >= 0).all(1) & (high <= (width, height)).all(1)
    (x0, y0), (x1, y1) = np.where(whole, low.T, 0), np.where(whole, high.T, 1)

    def up_to(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([map_coordinates(plane, (y, x), order=1) for plane in sums.transpose(2, 0, 1)], 1)

    area = ((x1 - x0) * (y1 - y0))[:, None]
    means = (up_to(x1, y1) - up_to(x0, y1) - up_to(x1, y0) + up_to(x0, y0)) / area
    least = to_light[cv2.erode(image.pixels, np.ones((DARK_WINDOW, DARK_WINDOW), np.uint8))]
    column, row = (np.clip(pixels.astype(int), 0, [width - 1, height - 1])).T
    return means[:, :3], least[row, column], whole & (means[:, 3] > 0.999)


def track_ratio(observations: Observations) -> np.ndarray:
    """Return farthest over nearest range of each point that is observed."""
    _, track = np.unique(observations.track, return_inverse=True)
    nearest, farthest = np.full(track.max() + 1, np.inf), np.zeros(track.max() + 1)
    np.minimum.at(nearest, track, observations.ranges)
    np.maximum.at(farthest, track, observations.ranges)
    return farthest / nearest
