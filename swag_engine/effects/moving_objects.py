"""Moving objects: what moves between images is masked out of them, found by what training leaves unexplained.

Where everything static has been learned, a fish leaves a patch of large residual in one image. What is hard to learn
leaves residuals wherever it is seen. Noise and edges leave single pixels and lines, which opening removes.
"""

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.scene_evidence import SceneEvidence
from ..gaussians.cloud import GaussianCloud
from ..gaussians.contributions import contribution_sums
from ..rasterize.api import rasterize
from ..scene.cameras import Camera
from .effect import Effect

LEAST_RESIDUAL = 0.08
"""Display value that a residual must exceed."""
LEAST_EXCESS = 4.0
"""Factor by which it must exceed the image's median residual."""
LEAST_ALONE = 5.0
"""Factor by which it must exceed the residual of the same place in the other images."""
KNOWN = 0.5
"""Pixels of a Gaussian in other images that weigh as much as the image itself."""
REDUCED = 2
"""Factor by which residuals are reduced for comparing images: they are averaged over more pixels anyway."""
GRAIN = 0.01
"""Fraction of the width below which nothing counts as an object."""
LEAST_AREA = 0.01
"""Fraction of an image that masks must cover for it to count."""
LEAST_IMAGES = 0.10
"""Fraction of the images that must count."""


def residual(image: np.ndarray, picture: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Compare an image with the rendered static scene.

    The brightness of the whole image is not compared: exposure is not an object.

    Args:
        image: (H, W, 3) display values 0..1.
        picture: (H, W, 3) rendered display values 0..1.
        valid: (H, W) bool.

    Returns:
        (H, W) float32 mean absolute difference, averaged over the size of the smallest objects, 0 where not valid.
    """
    difference = (image - picture).astype(np.float32)
    if not valid.any():
        return np.zeros(valid.shape, np.float32)
    difference -= np.median(difference[valid], axis=0)
    each = np.where(valid, np.abs(difference).mean(2), 0).astype(np.float32)
    grain = _grain(valid.shape[1])
    return cv2.blur(each, (grain, grain))


def moving_mask(residual: np.ndarray, elsewhere: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Find the pixels of an image that show what is in this image alone.

    Args:
        residual: (H, W) residual of the image.
        elsewhere: (H, W) residual of the same places in the other images.
        valid: (H, W) bool; invalid pixels are never in the mask.

    Returns:
        (H, W) bool.
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
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    residuals: Sequence[np.ndarray],
    wanted: Sequence[int],
    backend: str = "auto",
) -> Iterator[np.ndarray]:
    """Render, for some cameras, the residuals that all other images have at the places that the camera sees.

    The residual of a Gaussian in images is the mean over their pixels, weighted with what it adds to them. Where the
    others show little of it, its residual in the image itself counts: what is seen once cannot be distinguished from
    what moves.

    Args:
        cloud: The Gaussians.
        cameras: Cameras of the images.
        residuals: (H, W) residual of each image.
        wanted: Numbers of the cameras to render for.
        backend: What renders.

    Yields:
        (H, W) float32 for each of these cameras.
    """
    small = [camera.resized(max(1, camera.width // REDUCED)) for camera in cameras]

    def sums(index: int) -> Tensor:
        camera = small[index]
        values = cv2.resize(residuals[index], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        pictures = torch.from_numpy(np.stack([values, np.ones_like(values)], -1)).to(cloud.means)
        return contribution_sums(cloud, camera, pictures, backend)

    known = KNOWN / REDUCED**2
    total = cloud.means.new_zeros(len(cloud), 2)
    for index in range(len(cameras)):
        total += sums(index)
    for index in wanted:
        camera, own = small[index], sums(index)
        left, weight = (total - own).clamp(min=0).unbind(1)
        mean = own[:, 0] / own[:, 1].clamp(min=1e-6)
        expected = (left + known * mean) / (weight + known)
        viewmat, K = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
        drawn = rasterize(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, expected[:, None], viewmat, K,
            camera.width, camera.height, cloud.means.new_zeros(1), backend,
        )  # fmt: skip
        size = residuals[index].shape[::-1]
        yield cv2.resize(drawn.channels[..., 0].cpu().numpy(), size, interpolation=cv2.INTER_LINEAR)


def _grain(width: int) -> int:
    """Pixels, odd, below which nothing counts as an object in an image of this width."""
    return max(3, round(GRAIN * width) | 1)


def fraction_with_objects(masks: list[np.ndarray]) -> float:
    """Return the fraction of images whose mask covers more than LEAST_AREA; the effect counts from LEAST_IMAGES."""
    return float(np.mean([mask.mean() > LEAST_AREA for mask in masks])) if masks else 0.0


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from masks that the user gave; without them only training can show moving objects."""
    views = {view.name: view for view in evidence.scene.views}
    masked = sum(views[name].path in evidence.scene.masks.of for name in evidence.names)
    figures = {"masked_images": masked}
    if masked:
        return Decision("on", figures, f"Masks were given for {masked} photos; what they cover is ignored.")
    return Decision("unknown", figures, "Determined during training: moving objects remain unexplained by it.")


EFFECT = Effect("Moving objects", "training images", decide, on_when_unknown=True)
