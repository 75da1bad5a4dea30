"""What moved between photographs, by what training leaves unexplained.

Where everything that stands still has been learned, a fish leaves a patch of large residual in one photograph. What is
hard to learn leaves residuals wherever it is seen. Noise and edges leave single pixels and lines, which opening takes
away.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..gaussians.contributions import contribution_sums
from ..rasterize.api import rasterize
from ..scene.cameras import Camera

LEAST_RESIDUAL, LEAST_EXCESS = 0.08, 4.0
"""Display value that a residual must exceed, and how many times the photograph's usual residual."""
LEAST_ALONE = 5.0
"""How many times the residual of the same place in the other photographs."""
KNOWN = 0.5
"""Pixels of a Gaussian in other photographs that weigh as much as the photograph itself."""
GRAIN = 0.01
"""Share of the width below which nothing counts as an object."""
LEAST_AREA, LEAST_IMAGES = 0.01, 0.10
"""Share of a photograph that must be covered, and share of the photographs in which it is."""


def residual(photograph: np.ndarray, picture: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Differences (H, W) float32 of a photograph from the picture of all that stands still, over the grain of objects.

    photograph and picture (H, W, 3) display values 0..1, valid (H, W) bool; 0 where that is false. The brightness of
    the whole is not compared, for exposure is no object.
    """
    difference = (photograph - picture).astype(np.float32)
    if not valid.any():
        return np.zeros(valid.shape, np.float32)
    difference -= np.median(difference[valid], axis=0)
    each = np.where(valid, np.abs(difference).mean(2), 0).astype(np.float32)
    grain = _grain(valid.shape[1])
    return cv2.blur(each, (grain, grain))


def moving_mask(residual: np.ndarray, elsewhere: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool of a photograph that show what is in it alone.

    residual: the photograph's; elsewhere: what the other photographs leave unexplained of the same places, both
    (H, W); valid (H, W) bool, invalid pixels are never in the mask.
    """
    if not valid.any():
        return np.zeros(valid.shape, bool)
    usual = float(np.median(residual[valid]))
    large = residual > np.maximum(max(LEAST_RESIDUAL, LEAST_EXCESS * usual), LEAST_ALONE * elsewhere)
    grain = _grain(valid.shape[1])
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (grain, grain))
    closed = cv2.morphologyEx(large.astype(np.uint8), cv2.MORPH_CLOSE, disc)
    whole = cv2.morphologyEx(closed, cv2.MORPH_OPEN, disc, iterations=2)
    return (cv2.dilate(whole, disc) > 0) & valid


@torch.no_grad()
def residuals_elsewhere(
    cloud: GaussianCloud, cameras: Sequence[Camera], residuals: Sequence[np.ndarray], backend: str = "auto"
) -> Iterator[np.ndarray]:
    """For each camera, what the residuals (H, W) of all others say of the places that it sees: (H, W) float32.

    A Gaussian's residual in photographs is the mean over their pixels, weighted with what it adds to them. Where others
    show little of it, its residual in the photograph itself counts: what is seen once cannot be told from what moves.
    """

    def sums(camera: Camera, values: np.ndarray) -> Tensor:
        pictures = torch.from_numpy(np.stack([values, np.ones_like(values)], -1)).to(cloud.means)
        return contribution_sums(cloud, camera, pictures, backend)

    total = cloud.means.new_zeros(len(cloud), 2)
    for camera, values in zip(cameras, residuals, strict=True):
        total += sums(camera, values)
    for camera, values in zip(cameras, residuals, strict=True):
        own = sums(camera, values)
        left, weight = (total - own).clamp(min=0).unbind(1)
        mean = own[:, 0] / own[:, 1].clamp(min=1e-6)
        expected = (left + KNOWN * mean) / (weight + KNOWN)
        viewmat, K = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
        drawn = rasterize(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, expected[:, None], viewmat, K,
            camera.width, camera.height, cloud.means.new_zeros(1), backend,
        )  # fmt: skip
        yield drawn.channels[..., 0].cpu().numpy()


def _grain(width: int) -> int:
    """Pixels, odd, below which nothing counts as an object in a photograph of this width."""
    return max(3, round(GRAIN * width) | 1)


def share_with_objects(masks: list[np.ndarray]) -> float:
    """Share of the photographs whose mask covers LEAST_AREA of them; LEAST_IMAGES of them make the effect count."""
    return float(np.mean([mask.mean() > LEAST_AREA for mask in masks])) if masks else 0.0
