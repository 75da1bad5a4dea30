"""Structural similarity of two images."""

from functools import lru_cache

import torch
from torch import Tensor

from ..kernels.backends import kernels_for

WINDOW, SIGMA = 11, 1.5


C1, C2 = 0.01**2, 0.03**2


def ssim(image: Tensor, target: Tensor, backend: str = "auto") -> Tensor:
    """Mean structural similarity (Wang et al. 2004) of `image` and `target` (H, W, 3) in 0..1; differentiable in image.

    11 x 11 Gaussian window of sigma 1.5, zero padding, so that every pixel counts.
    """
    return l1_and_ssim(image, target, backend)[1]


def check_images(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.dim() != 3 or image.shape[2] != 3:
        raise ValueError(f"images must both be (H, W, 3), got {tuple(image.shape)} and {tuple(target.shape)}")


def l1_and_ssim(image: Tensor, target: Tensor, backend: str) -> tuple[Tensor, Tensor]:
    check_images(image, target)
    if kernels := kernels_for(backend, image, target):
        return kernels.l1_ssim(image, target)
    return (image - target).abs().mean(), _ssim_map(image, target).mean()


def _ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """SSIM of every pixel and channel (H, W, 3). The blur is two band matrix products: far faster than conv2d."""
    down, across = (_blur_matrix(size, image.dtype, image.device) for size in image.shape[:2])

    def blur(x: Tensor) -> Tensor:
        return torch.einsum("ij,jkc,kl->ilc", down, x, across)

    mean_a, mean_b = blur(image), blur(target)
    product = mean_a * mean_b
    squares = mean_a * mean_a + mean_b * mean_b
    covariance = blur(image * target) - product
    variances = blur(image * image + target * target) - squares
    return (2 * product + C1) * (2 * covariance + C2) / ((squares + C1) * (variances + C2))


@lru_cache(maxsize=16)
def _blur_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(size, size) symmetric band matrix that convolves with the window, zeros beyond the ends."""
    offset = torch.arange(size)[:, None] - torch.arange(size)
    weights = torch.exp(-0.5 * (torch.arange(WINDOW) - WINDOW // 2).double().square() / SIGMA**2)
    band = torch.exp(-0.5 * offset.double().square() / SIGMA**2) / weights.sum()
    return torch.where(offset.abs() <= WINDOW // 2, band, 0).to(device, dtype)
