"""Structural similarity of two images."""

from torch import Tensor

from ..kernels.backends import kernels_for


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
    return kernels_for(backend, image, target).l1_ssim(image, target)
