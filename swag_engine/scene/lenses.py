"""Lenses as COLMAP describes them, and the pinhole picture that each is undistorted to.

One way serves every camera model that pycolmap knows: a pixel of the pinhole picture looks along a ray, and pycolmap
says where the lens images that ray.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..base.errors import InputError
from .colmap_library import pycolmap

# A pinhole picture stretches without bound towards 90 degrees off the axis; beyond 60 it holds little but blur.
_WIDEST_TANGENT = float(np.tan(np.radians(60)))


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics in pixels of a width x height picture; pixel centres at +0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera: model name, size of its picture in pixels, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @cached_property
    def camera(self) -> pycolmap.Camera:
        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines are straight already, so that nothing needs undistorting."""
        return self.camera.is_undistorted() and self.camera.is_perspective_pinhole()  # a fisheye has no "distortion"

    @cached_property
    def pinhole(self) -> Pinhole:
        """The pinhole picture of this lens.

        It has the focal length of the lens on its axis (so the middle keeps its resolution), square pixels, and covers
        the largest upright rectangle that the lens fills without blank pixels, up to 60 degrees off the axis. A lens
        that is a pinhole already is returned as it is. Raises InputError when the parameters describe no lens.
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
        """Left, top, right, bottom of the pinhole picture on the plane z = 1.

        From the axis outwards to points all along the picture's border, the last point that can be undistorted counts:
        strong distortion folds over, or reaches 90 degrees, before the border.
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
            "into a pinhole picture: reconstruct the scene with a perspective or fisheye camera model."
        )


@lru_cache(maxsize=2)
def source_map(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of the pinhole picture lies in the lens's own picture.

    Returns (H, W, 2) float32 in COLMAP pixels of the source, and (H, W) bool: False where that is outside.
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
