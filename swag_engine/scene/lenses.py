"""COLMAP's camera models, and the pinhole image that each is undistorted to.

All camera models that pycolmap knows are treated alike: each pixel of the pinhole image has a ray, and pycolmap
projects the ray with the lens.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..base.errors import InputError
from .colmap_library import pycolmap

_WIDEST_TANGENT = float(np.tan(np.radians(60)))
"""Tangent of the largest angle off the axis: beyond 60 degrees a pinhole image stretches the lens's to blur."""


MOST_FOCAL = 1e4
"""Largest focal length over the longer side of the image: a field of view of 0.006 degrees."""


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of a pinhole image, all in pixels; the centre of the top left pixel is (0.5, 0.5).

    Attributes:
        width: Width of the image.
        height: Height of the image.
        fx: Focal length in x.
        fy: Focal length in y.
        cx: Principal point in x.
        cy: Principal point in y.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class Lens:
    """A camera of a COLMAP model.

    Attributes:
        model: Name of the camera model.
        width: Width of its images, pixels.
        height: Height of its images, pixels.
        params: Parameters in COLMAP's order.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @cached_property
    def camera(self) -> pycolmap.Camera:
        """The same camera in pycolmap."""
        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    @property
    def fault(self) -> str | None:
        """What makes the numbers of the lens impossible, None where nothing does."""
        width, height = self.width, self.height
        if min(width, height) < 1:
            return f"its image size is {width} x {height} pixels"
        if not np.isfinite(self.params).all():
            return "a parameter is not a finite number"
        focal = [self.params[index] for index in self.camera.focal_length_idxs()]
        if focal and min(focal) <= 0:
            return f"its focal length is {min(focal):g} pixels"
        if focal and max(focal) > MOST_FOCAL * max(width, height):
            return f"its focal length is {max(focal):g} pixels, {MOST_FOCAL:.0f} times the image and more"
        point = [self.params[index] for index in self.camera.principal_point_idxs()]
        if any(not -size <= value <= 2 * size for value, size in zip(point, (width, height), strict=False)):
            return f"its principal point ({point[0]:g}, {point[1]:g}) is far outside its {width} x {height} pixels"
        return None

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion, so that its images are pinhole images."""
        return self.camera.is_undistorted() and self.camera.is_perspective_pinhole()  # a fisheye has no "distortion"

    @cached_property
    def pinhole(self) -> Pinhole:
        """The pinhole image of this lens.

        It has the focal length of the lens on its axis (so that the middle keeps its resolution), square pixels, and
        covers the largest upright rectangle that the lens fills without blank pixels, up to 60 degrees off the axis.
        A lens without distortion keeps its own intrinsics.

        Raises:
            InputError: When the parameters describe no lens.
        """
        camera = self.camera
        if camera.is_spherical() or not np.isfinite(self.params).all() or min(self.width, self.height) < 1:
            raise self._unusable()
        if self.is_pinhole:
            return Pinhole(
                self.width,
                self.height,
                camera.focal_length_x,
                camera.focal_length_y,
                camera.principal_point_x,
                camera.principal_point_y,
            )
        step = 1e-4
        near_axis = camera.img_from_cam(np.array([[-step, 0, 1], [step, 0, 1], [0, -step, 1], [0, step, 1]]))
        focal = (near_axis[1, 0] - near_axis[0, 0] + near_axis[3, 1] - near_axis[2, 1]) / (4 * step)
        left, top, right, bottom = self._inner_rectangle()
        width, height = (right - left) * focal, (bottom - top) * focal
        if not (np.isfinite(focal) and width >= 1 and height >= 1):
            raise self._unusable()
        return Pinhole(int(width), int(height), focal, focal, -left * focal, -top * focal)

    def _inner_rectangle(self) -> tuple[float, float, float, float]:
        """Return left, top, right and bottom of the pinhole image on the plane z = 1.

        On lines from the axis to points all along the border of the image, the last point that can be undistorted
        counts: strong distortion folds over, or reaches 90 degrees, before the border.
        """
        camera = self.camera
        steps = np.linspace(0, 1, 65)
        x, y = steps * self.width, steps * self.height
        zero, one = np.zeros_like(steps), np.ones_like(steps)
        border = np.stack(
            [
                np.stack([zero, y], -1),
                np.stack([x, zero], -1),
                np.stack([one * self.width, y], -1),
                np.stack([x, one * self.height], -1),
            ]
        )
        axis = camera.img_from_cam(np.array([[0.0, 0.0, 1.0]]))
        pixels = axis + np.linspace(0, 1, 65)[1:, None, None, None] * (border - axis)
        rays = camera.cam_ray_from_img(np.ascontiguousarray(pixels.reshape(-1, 2)))
        returned = camera.img_from_cam(rays).reshape(pixels.shape)
        rays = rays.reshape(*pixels.shape[:-1], 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            tangent = rays[..., :2] / rays[..., 2:]
            radius = np.linalg.norm(tangent, axis=-1)
            usable = (rays[..., 2] > 0.05) & (np.abs(returned - pixels).max(-1) < 0.5)
            usable &= np.diff(radius, axis=0, prepend=0) > 0
        outermost = np.logical_and.accumulate(usable, axis=0).sum(0) - 1
        if outermost.min() < 0:
            raise self._unusable()
        last = np.take_along_axis(tangent, outermost[None, ..., None], axis=0)[0]
        last = np.clip(last, -_WIDEST_TANGENT, _WIDEST_TANGENT)
        return last[0, :, 0].max(), last[1, :, 1].max(), last[2, :, 0].min(), last[3, :, 1].min()

    def _unusable(self) -> InputError:
        values = ", ".join(f"{value:g}" for value in self.params)
        return InputError(
            f"The camera {self.model} {self.width} x {self.height} ({values}) of the COLMAP model cannot be turned "
            "into a pinhole image: reconstruct the scene with a perspective or fisheye camera model."
        )


@lru_cache(maxsize=2)
def source_map(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Compute where each pixel of the pinhole image lies in the image of the lens.

    Args:
        lens: The lens.

    Returns:
        Positions (H, W, 2) float32 in COLMAP's pixels of the lens's image, -1 outside; and whether they are inside
        (H, W) bool.
    """
    pinhole = lens.pinhole
    x = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    y = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.fy
    rays = np.ones((pinhole.height, pinhole.width, 3))
    rays[..., 0], rays[..., 1] = x, y[:, None]
    source = lens.camera.img_from_cam(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2).astype(np.float32)
    with np.errstate(invalid="ignore"):
        valid = (source >= 0).all(-1) & (source[..., 0] <= lens.width) & (source[..., 1] <= lens.height)
    return np.where(valid[..., None], source, -1), valid
