"""Motion of the image along a video, and whether the camera travels or only turns."""

from typing import Any

import cv2
import numpy as np

_UNKNOWN = 0.05
"""Motion that is assumed where nothing can be tracked, as after a cut, as a fraction of the image width."""
_FEWEST_CORNERS = 20
"""Corners that say how the image moves, at least; open water has fewer."""
_LEAST_MOTION = 0.001
"""Motion that is more than noise of the tracking, as a fraction of the image width."""
_SEGMENT = 0.1
"""Motion after which new corners are tracked, as a fraction of the image width."""
_LEFT_CORNERS = 0.6
"""Fraction of the corners below which new ones are tracked: those that leave the image first are the fastest."""
_HOMOGRAPHY_ERROR = 0.08
"""Distance, as a fraction of the motion, to which a homography explains where a corner has moved: the tracking drifts
when the image grows or shrinks."""
_HOMOGRAPHY_SHARE = 0.55
"""Fraction of the corners that a homography explains when there is no depth in their motion."""
_ROTATION_SPREAD = 0.35
"""Ratio of the largest to the smallest singular value, less 1 and divided by the motion, below which a homography is
that of a rotation: rotations and zooms have at most 0.3 with a usual lens, travel along a wall at least 0.5."""
_FOCAL_LENGTHS = np.geomspace(0.4, 2, 15)
"""Focal lengths that are tried, in image widths: fields of view of 103 to 28 degrees."""
_ZOOMS = np.geomspace(0.6, 1.65, 51)
"""Ratios of the focal lengths of two frames that are tried."""


class ImageMotion:
    """Motion of the image along a video, from corners that are tracked over segments of it.

    Motion is that since the beginning of a segment, as the sum of the small motions between frames, and of the swell
    that moves a diver to and fro, would grow while the camera rests.

    Attributes:
        motion: Motion in each frame since the frame before, as a fraction of the image width.
        turning: Whether the camera only turns or zooms, for each frame of the segments that have ended.
    """

    def __init__(self) -> None:
        """Begin before the first frame."""
        self.motion: list[float] = []
        self.turning: list[bool] = []
        self._before: np.ndarray | None = None
        self._size = (0, 0)
        self._first: Any = np.zeros((0, 2), np.float32)
        self._now: Any = self._first
        self._corners, self._farthest = 0, 0.0

    def follow(self, picture: np.ndarray) -> None:
        """Add a frame, an equalised grey picture (H, W)."""
        motion = _UNKNOWN if self.motion else 0.0
        self._size = (picture.shape[1], picture.shape[0])
        if self._before is not None and self._track(self._before, picture):
            farthest = float(np.median(np.linalg.norm(self._now - self._first, axis=1))) / self._size[0]
            motion = max(0.0, farthest - self._farthest) if farthest > _LEAST_MOTION else 0.0
            self._farthest += motion
        else:
            self.interrupt()
        self.motion.append(motion)
        if self._before is None or self._farthest > _SEGMENT or len(self._now) < _LEFT_CORNERS * self._corners:
            self.interrupt()
            corners = cv2.goodFeaturesToTrack(picture, 300, 0.01, 8)
            self._first = self._now = np.zeros((0, 2), np.float32) if corners is None else corners[:, 0]
            self._corners, self._farthest = len(self._first), 0.0
        self._before = picture

    def interrupt(self) -> None:
        """End the segment."""
        turning = (
            self._before is not None
            and self._farthest >= _SEGMENT / 2
            and _only_turns(self._first, self._now, self._size)
        )
        self.turning += [turning] * (len(self.motion) - len(self.turning))
        self._before = None

    def _track(self, before: np.ndarray, picture: np.ndarray) -> bool:
        """Track the corners from one frame to the next; return whether enough of them were found."""
        if self._corners < _FEWEST_CORNERS:
            return False
        moved, found, _ = cv2.calcOpticalFlowPyrLK(before, picture, self._now, np.empty_like(self._now))
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(picture, before, moved, np.empty_like(moved))
        returned = np.linalg.norm(back - self._now, axis=1) < 1
        sure = (found.ravel() > 0) & (found_back.ravel() > 0) & returned
        if sure.sum() < max(_FEWEST_CORNERS, 0.3 * self._corners):
            return False
        self._first, self._now = self._first[sure], moved[sure]
        return True


def _only_turns(first: np.ndarray, second: np.ndarray, size: tuple[int, int]) -> bool:
    """Return whether the motion of points is that of a camera that turns and zooms in one place.

    Then a homography explains it, and K2^-1 H K1 is a rotation up to scale for some focal lengths. Travel along a wall
    is explained by a homography, too, but not by a rotation.

    Args:
        first: Pixels of the points (N, 2) in one image.
        second: Pixels (N, 2) in another one.
        size: Width and height of the images.
    """
    motion = float(np.median(np.linalg.norm(second - first, axis=1)))
    tolerance = max(1.0, _HOMOGRAPHY_ERROR * motion)
    homography, _ = cv2.findHomography(first, second, cv2.RANSAC, tolerance)
    if homography is None:
        return False
    error = np.linalg.norm(cv2.perspectiveTransform(first[:, None], homography)[:, 0] - second, axis=1)
    if np.mean(error < tolerance) < _HOMOGRAPHY_SHARE:
        return False
    width, height = size
    to_pixels = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])
    focal, zoom = (grid.ravel()[:, None] for grid in np.meshgrid(_FOCAL_LENGTHS, _ZOOMS))
    one = np.ones_like(focal)
    rotations = np.linalg.inv(to_pixels) @ homography @ to_pixels * np.hstack([focal, focal, one])[:, None, :]
    rotations /= np.hstack([focal * zoom, focal * zoom, one])[:, :, None]
    values = np.linalg.svd(rotations, compute_uv=False)
    return float((values[:, 0] / values[:, 2]).min()) - 1 < _ROTATION_SPREAD * motion / width
