"""How near a rendered picture is to its photograph."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..rasterize.render import render
from ..scene.images import TrainingImage
from ..training.losses import ssim


@dataclass(frozen=True)
class ViewScore:
    """PSNR in dB and SSIM of one view, over its valid pixels."""

    name: str
    psnr: float
    ssim: float


def psnr(image: Tensor, target: Tensor, valid: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of (H, W, 3) in 0..1, from the mean square over valid pixels and channels."""
    error = float(((image - target)[valid] ** 2).mean())
    return float(-10 * np.log10(max(error, 1e-10)))


def score_views(cloud: GaussianCloud, images: Sequence[TrainingImage], sh_degree: int, backend: str) -> list[ViewScore]:
    """Render every image's view and compare, at the size of the images, in 8 bits as both would be stored."""
    scores = []
    with torch.no_grad():
        for image in images:
            color = render(cloud, image.camera, sh_degree, backend=backend).color
            scores.append(score_picture(image, (color.clamp(0, 1) * 255).round() / 255))
    return scores


def score_picture(image: TrainingImage, color: Tensor) -> ViewScore:
    """PSNR and SSIM of one picture (H, W, 3) in 0..1 against its photograph."""
    target = torch.from_numpy(image.pixels).to(color.dtype) / 255
    valid = torch.from_numpy(image.valid)
    if not valid.any():
        return ViewScore(image.camera.name, float("nan"), float("nan"))
    compared = torch.where(valid[..., None], color, target)
    return ViewScore(image.camera.name, psnr(color, target, valid), float(ssim(compared, target)))


def median_control(training: Sequence[TrainingImage], test: Sequence[TrainingImage]) -> float:
    """Mean test PSNR in dB of the pixel-wise median of the training images: what knows nothing of geometry reaches.

    Not a number where there are no test images, or no training image of the size of the first.
    """
    if not test:
        return float("nan")
    shape = test[0].pixels.shape
    same = [image.pixels for image in training if image.pixels.shape == shape]
    if not same:
        return float("nan")
    median = torch.from_numpy(np.median(np.stack(same), axis=0).astype(np.float32) / 255)
    matching = [image for image in test if image.pixels.shape == shape]
    return mean_score([score_picture(image, median) for image in matching])[0]


def mean_score(scores: Sequence[ViewScore]) -> tuple[float, float]:
    """Mean PSNR and mean SSIM over views; not a number without any."""
    if not scores:
        return float("nan"), float("nan")
    return float(np.nanmean([s.psnr for s in scores])), float(np.nanmean([s.ssim for s in scores]))
