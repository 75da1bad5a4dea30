"""Lenses whose distortion no camera model of COLMAP has exactly; their photos are resampled."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..scene.lenses import Lens

_NEWTON_STEPS = 20
"""Steps of Newton's method from a pixel to its ray; distortion of photo lenses needs about five."""


@dataclass(frozen=True)
class PolynomialLens(Lens):
    """A lens with polynomial distortion of four radial terms, skew, and tangential terms that grow with the radius.

    Attributes:
        model: How the angle from the axis becomes the radius that is distorted: "perspective" (tangent), "equidistant"
            (the angle) or "equisolid" (twice the sine of half the angle).
        params: fx, fy, cx, cy, skew, k1, k2, k3, k4, p1, p2, p3, p4: pixels for the first five; x gets
            (2 p1 x y + p2 (r^2 + 2 x^2)) (1 + p3 r^2 + p4 r^4).
    """

    @cached_property
    def camera(self) -> Any:
        """What `Lens` asks of pycolmap's camera."""
        return _Projection(self)


class _Projection:
    """The methods of `pycolmap.Camera` that `Lens` uses."""

    def __init__(self, lens: PolynomialLens) -> None:
        self.lens = lens

    def is_undistorted(self) -> bool:
        return False

    def is_perspective_pinhole(self) -> bool:
        return False

    def focal_length_idxs(self) -> tuple[int, int]:
        return 0, 1

    def principal_point_idxs(self) -> tuple[int, int]:
        return 2, 3

    def is_spherical(self) -> bool:
        return False

    def img_from_cam(self, points: np.ndarray) -> np.ndarray:
        """Project points (N, 3) in front of the camera to pixels (N, 2)."""
        return self._pixels(points[:, :2] / points[:, 2:])

    def cam_ray_from_img(self, pixels: np.ndarray) -> np.ndarray:
        """Return the unit rays (N, 3) of pixels (N, 2), not a number where there is none."""
        fx, fy, cx, cy = self.lens.params[:4]
        plane = (pixels - [cx, cy]) / [fx, fy]
        step = 1e-6
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                here = self._pixels(plane)
                along_x = (self._pixels(plane + [step, 0]) - here) / step
                along_y = (self._pixels(plane + [0, step]) - here) / step
                off = pixels - here
                determinant = along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]
                plane = plane + np.stack(
                    [
                        (off[:, 0] * along_y[:, 1] - off[:, 1] * along_y[:, 0]) / determinant,
                        (off[:, 1] * along_x[:, 0] - off[:, 0] * along_x[:, 1]) / determinant,
                    ],
                    -1,
                )
            rays = np.concatenate([plane, np.ones((len(plane), 1))], -1)
            return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def _pixels(self, plane: np.ndarray) -> np.ndarray:
        """Project points (N, 2) of the plane z = 1."""
        fx, fy, cx, cy, skew, k1, k2, k3, k4, p1, p2, p3, p4 = self.lens.params
        if self.lens.model != "perspective":
            tangent = np.linalg.norm(plane, axis=-1, keepdims=True)
            angle = np.arctan(tangent)
            radius = angle if self.lens.model == "equidistant" else 2 * np.sin(angle / 2)
            plane = plane * np.where(tangent > 1e-12, radius / np.maximum(tangent, 1e-12), 1.0)
        x, y = plane[:, 0], plane[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        tangential = 1 + r2 * (p3 + r2 * p4)
        distorted_x = x * radial + (2 * p1 * x * y + p2 * (r2 + 2 * x * x)) * tangential
        distorted_y = y * radial + (2 * p2 * x * y + p1 * (r2 + 2 * y * y)) * tangential
        return np.stack([fx * distorted_x + skew * distorted_y + cx, fy * distorted_y + cy], -1)


def rescaled(lens: Lens, width: int, height: int) -> Lens:
    """Return the lens of the same photos at another size in pixels."""
    if (width, height) == (lens.width, lens.height):
        return lens
    if isinstance(lens, PolynomialLens):
        x, y = width / lens.width, height / lens.height
        fx, fy, cx, cy, skew, *distortion = lens.params
        return PolynomialLens(lens.model, width, height, (fx * x, fy * y, cx * x, cy * y, skew * x, *distortion))
    camera = replace(lens).camera  # its own: rescale changes it
    camera.rescale(width, height)
    return Lens(lens.model, width, height, tuple(float(value) for value in camera.params))
