"""Metrics of rendered images: against the images of the scene, and against the true image without water."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..base.color_difference import delta_e_2000, lab
from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud
from ..rasterize.api import rasterize
from ..rendering.render import render
from ..scene.cameras import Camera
from ..scene.images import TrainingImage
from ..splats.development import NO_DEVELOPMENT, Development
from .ssim import ssim

FLOATER_GAP = 0.05
"""Distance of a floater in front of the surface, at least, in median ranges."""
RANGE_STEPS = 160
"""Steps of range, half a FLOATER_GAP each, that `floater_mass` sorts Gaussians into: up to 4 median ranges."""


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view over its valid pixels.

    Attributes:
        name: Name of the image.
        psnr: PSNR in dB.
        ssim: SSIM.
        mse: Mean square error of display values 0..1.
        pixels: Number of valid pixels.
    """

    name: str
    psnr: float
    ssim: float
    mse: float
    pixels: int


def psnr_from_mse(mse: float) -> float:
    """Return the peak signal-to-noise ratio in dB, at most 100, of a mean square error of values in 0..1."""
    return float(-10 * np.log10(max(mse, 1e-10)))


def score_views(
    cloud: GaussianCloud,
    images: Sequence[TrainingImage],
    sh_degree: int,
    backend: str = "auto",
    effects: SceneEffects | None = None,
) -> list[ViewScore]:
    """Render the view of each image at its size and score it, in 8 bits as both would be stored.

    Args:
        cloud: The Gaussians.
        images: Images to compare with.
        sh_degree: Degree of the spherical harmonics.
        backend: Name of the backend.
        effects: Effects to render with, none without.

    Returns:
        One score for each image.
    """
    return [score_image(image, in_8_bits(_color(cloud, image.camera, sh_degree, backend, effects))) for image in images]


@torch.no_grad()
def _color(
    cloud: GaussianCloud,
    camera: Camera,
    sh_degree: int,
    backend: str,
    effects: SceneEffects | None,
    amount: float = 1.0,
) -> Tensor:
    """As `render_color`, on the device of the cloud."""
    effects = effects or SceneEffects()
    color = render(cloud, camera, sh_degree, effects.medium, amount=amount, backend=backend, lamp=effects.lamp).color
    return effects.apply_to_image(color, camera.name, amount)


def render_color(
    cloud: GaussianCloud,
    camera: Camera,
    sh_degree: int,
    backend: str = "auto",
    effects: SceneEffects | None = None,
    amount: float = 1.0,
) -> Tensor:
    """Render one view with all its highlights; arguments as those of `render_image`.

    Returns:
        Image (H, W, 3) on the CPU, display values that may be above 1.
    """
    return _color(cloud, camera, sh_degree, backend, effects, amount).cpu()


def render_image(
    cloud: GaussianCloud,
    camera: Camera,
    sh_degree: int,
    backend: str = "auto",
    effects: SceneEffects | None = None,
    amount: float = 1.0,
    development: Development = NO_DEVELOPMENT,
) -> Tensor:
    """Render one view as it would be stored, in 8 bits.

    An image that was not trained on gets the gain interpolated from its neighbours, and no caustics.

    Args:
        cloud: The Gaussians.
        camera: The camera.
        sh_degree: Degree of the spherical harmonics.
        backend: Name of the backend.
        effects: Effects to render with, none without.
        amount: Strength of all effects: 0 leaves them away, 1 is as trained.
        development: Of the rendered image; none for scores.

    Returns:
        Image (H, W, 3) on the CPU, display values 0..1 in steps of 1/255.
    """
    color = render_color(cloud, camera, sh_degree, backend, effects, amount)
    developed = torch.from_numpy(development.apply(color.numpy())).to(color)
    return in_8_bits(developed)


def in_8_bits(color: Tensor) -> Tensor:
    """Return display values as they would be stored, 0..1 in steps of 1/255."""
    return (color.clamp(0, 1) * 255).round() / 255


def mask_invalid(image: TrainingImage, color: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Prepare a rendered image for a comparison over the valid pixels alone.

    Args:
        image: The image to compare with.
        color: Rendered image (H, W, 3), display values 0..1, on any device.

    Returns:
        The rendered image (H, W, 3) with the pixels of the other where these are not valid, the other (H, W, 3), and
        the valid pixels (H, W) bool.
    """
    target = torch.from_numpy(image.pixels).to(color.device).to(color.dtype) / 255
    valid = torch.from_numpy(image.valid).to(color.device)
    return torch.where(valid[..., None], color, target), target, valid


def score_image(image: TrainingImage, color: Tensor) -> ViewScore:
    """Score a rendered image.

    Args:
        image: The image to compare with.
        color: Rendered image (H, W, 3), display values 0..1, on any device.

    Returns:
        The scores, NaN without valid pixels.
    """
    compared, target, valid = mask_invalid(image, color)
    pixels = int(image.valid.sum())
    if not pixels:
        return ViewScore(image.camera.name, float("nan"), float("nan"), float("nan"), 0)
    mse = float((compared - target).square().sum(dtype=torch.float64)) / (3 * pixels)
    return ViewScore(image.camera.name, psnr_from_mse(mse), float(ssim(compared, target)), mse, pixels)


def median_image_psnr(training: Sequence[TrainingImage], test: Sequence[TrainingImage]) -> float:
    """Compute the median-image baseline: the test PSNR of the pixel-wise median of the training images.

    Args:
        training: Training images.
        test: Test images.

    Returns:
        Mean PSNR in dB; NaN without test images, or without a training image of the size of the first.
    """
    if not test:
        return float("nan")
    shape = test[0].pixels.shape
    same = [image.pixels for image in training if image.pixels.shape == shape]
    if not same:
        return float("nan")
    median = torch.from_numpy(np.median(np.stack(same), axis=0).astype(np.float32) / 255)
    matching = [image for image in test if image.pixels.shape == shape]
    return mean_score([score_image(image, median) for image in matching])[0]


def mean_score(scores: Sequence[ViewScore]) -> tuple[float, float]:
    """Return the mean PSNR in dB and the mean SSIM over views, NaN without any."""
    return mean([score.psnr for score in scores]), mean([score.ssim for score in scores])


def mean(values: Sequence[float]) -> float:
    """Return the mean of the values that are not NaN, NaN without any."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def joint_psnr(scores: Sequence[ViewScore]) -> float:
    """Compute the PSNR of the mean square error over the valid pixels of all views together.

    With equally many pixels in each view it is never above the mean PSNR: a view with large errors weighs more.

    Args:
        scores: Scores of the views.

    Returns:
        PSNR in dB, NaN without valid pixels.
    """
    seen = [score for score in scores if score.pixels]
    if not seen:
        return float("nan")
    return psnr_from_mse(float(np.average([score.mse for score in seen], weights=[score.pixels for score in seen])))


@torch.no_grad()
def floater_mass(cloud: GaussianCloud, cameras: Sequence[Camera], median_range: float, backend: str = "auto") -> float:
    """Compute the fraction of the blending weights that lies in front of the visible surface.

    A Gaussian adds the weight T alpha to a pixel (T is the transmittance before it). W(r) is the sum of the weights of
    the Gaussians nearer than r to the camera, where r is the range of their centres. The pixel's surface is at the
    range where W reaches 0.5; the weight of its floaters is W(surface - FLOATER_GAP * median_range), and 0 where W
    stays below 0.5.

    The surface differs from pixel to pixel and a render has one value a Gaussian, so W itself is rendered: one channel
    for each of RANGE_STEPS ranges, with 1 for the Gaussians nearer than it, and linear between two. The result is
    within 3 % of the sum over single Gaussians (demo scene). Surfaces farther than 4 median ranges count as at that.

    Args:
        cloud: The Gaussians.
        cameras: Cameras of the views.
        median_range: Median range of the scene, scene units.
        backend: Name of the backend.

    Returns:
        Weight of the floaters over the weight of all Gaussians, summed over pixels and views, 0..1; NaN when nothing
        is rendered.
    """
    step = FLOATER_GAP / 2
    edges = (torch.arange(1, RANGE_STEPS + 1) * step * median_range).to(cloud.means)
    edges[-1] = torch.inf
    front = total = 0.0
    for camera in cameras:
        centre, viewmat, intrinsics = (
            torch.from_numpy(array).to(cloud.means) for array in (camera.centre, camera.world_to_camera, camera.K)
        )
        ranges = (cloud.means - centre).norm(dim=-1, keepdim=True)
        within = [cloud.means.new_zeros(camera.height, camera.width)] * 4  # W at the last edges: the gap is two steps
        for some in edges.split(16):
            drawn = rasterize(
                cloud.means, cloud.quats, cloud.scales, cloud.opacities, (ranges < some).to(cloud.means), viewmat,
                intrinsics, camera.width, camera.height, torch.zeros_like(some), backend,
            )  # fmt: skip
            for nearer in drawn.channels.unbind(-1):
                within = [*within[1:], nearer]
                surface = (within[2] < 0.5) & (nearer >= 0.5)
                between = (0.5 - within[2]) / (nearer - within[2])
                front += float(torch.lerp(within[0], within[1], between)[surface].sum())
        total += float(within[-1].sum())
    return front / total if total else float("nan")


def restored_error(restored: np.ndarray, clean: np.ndarray, valid: np.ndarray) -> tuple[float, float]:
    """Compare an image without water with the true one.

    Args:
        restored: Rendered image without water (H, W, 3), sRGB 0..1.
        clean: True image without water (H, W, 3), sRGB 0..1.
        valid: Pixels to compare (H, W) bool.

    Returns:
        PSNR in dB and mean CIE delta E 2000, NaN without valid pixels.
    """
    if not valid.any():
        return float("nan"), float("nan")
    ours, true = restored[valid].astype(np.float64), clean[valid].astype(np.float64)
    return psnr_from_mse(float(((ours - true) ** 2).mean())), float(delta_e_2000(lab(ours), lab(true)).mean())
