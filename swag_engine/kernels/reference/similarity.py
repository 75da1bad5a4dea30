"""Structural similarity of two images (Wang et al. 2004)."""

from functools import lru_cache

import torch
from torch import Tensor

WINDOW = 11
"""Width of the Gaussian window, pixels."""
SIGMA = 1.5
"""Standard deviation of the window, pixels."""
C1 = 0.01**2
"""Keeps the ratio of means finite; for values in 0..1."""
C2 = 0.03**2
"""Keeps the ratio of variances finite; for values in 0..1."""


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Compute the structural similarity of every pixel and channel.

    Args:
        image: (H, W, 3) display values.
        target: (H, W, 3) display values.

    Returns:
        (H, W, 3) similarity.
    """
    # Two products with band matrices are far faster than conv2d.
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
