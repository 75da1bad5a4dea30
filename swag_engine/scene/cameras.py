"""Cameras of undistorted images."""

from dataclasses import dataclass, replace

import numpy as np

from ..base.camera_kind import CameraKind

CAMERA_PAGE = "cameras.html"
"""File name of the page about its cameras in the folder of a scene."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole or orthographic camera with its pose.

    Axes are those of COLMAP and OpenCV: x right, y down, z forward. The centre of the top left pixel is (0.5, 0.5).

    Attributes:
        name: Name of the image.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        fx: Focal length in x, pixels; of an orthographic camera pixels per scene unit.
        fy: Focal length in y, likewise.
        cx: Principal point in x, pixels.
        cy: Principal point in y, pixels.
        world_to_camera: Rigid transform (4, 4) float64, scene units.
        kind: Perspective (pinhole) or orthographic.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray
    kind: CameraKind = "perspective"

    @property
    def K(self) -> np.ndarray:  # noqa: N802
        """The intrinsic matrix, (3, 3) float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def centre(self) -> np.ndarray:
        """The projection centre in the world, (3,) float64, scene units."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def resized(self, width: int) -> "Camera":
        """Return the camera of the image scaled to another width.

        Args:
            width: The new width, pixels. The height is rounded; focal lengths scale exactly, x and y apart.
        """
        height = max(1, round(self.height * width / self.width))
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y)

    def view_planes(self, beside: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """Return the planes that bound the view: through the camera, left, right, top and bottom.

        Args:
            beside: Pixels beside the image, in x and in y, that count as part of it.

        Returns:
            (5, 4) float64; `planes @ (p, 1)` are the distances of a point p from them in scene units, positive inside.
        """
        x, y, z = self.world_to_camera[:3]
        depth = np.array([0.0, 0.0, 0.0, 1.0]) if self.kind == "orthographic" else z
        planes = [z]
        for axis, focal, centre, size, margin in (
            (x, self.fx, self.cx, self.width, beside[0]),
            (y, self.fy, self.cy, self.height, beside[1]),
        ):
            position = focal * axis + centre * depth
            planes += [position + margin * depth, (size + margin) * depth - position]
        found = np.stack(planes)
        return found / np.linalg.norm(found[:, :3], axis=1, keepdims=True)
