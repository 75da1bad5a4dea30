"""The pinhole camera that everything after undistortion sees."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with its pose.

    Axes are COLMAP's and OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5: the top left pixel's centre
    is (0.5, 0.5). fx, fy, cx, cy are in pixels of a width x height picture; `world_to_camera` is (4, 4) float64, rigid.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray

    @property
    def K(self) -> np.ndarray:  # noqa: N802
        """The intrinsic matrix, (3, 3) float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def centre(self) -> np.ndarray:
        """The projection centre in the world, (3,) float64, in SfM units."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def resized(self, width: int) -> "Camera":
        """The same camera at another width in pixels; the height is rounded, and x and y keep their own true ratio."""
        height = max(1, round(self.height * width / self.width))
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y)
