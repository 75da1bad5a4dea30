"""Structural similarity of two images."""

from torch import Tensor

from ..kernels.backends import kernels_for


def ssim(image: Tensor, target: Tensor, backend: str = "auto") -> Tensor:
    """Compute the mean structural similarity (Wang et al., IEEE TIP 2004), differentiable in `image`.

    The window is a Gaussian of 11 x 11 pixels with sigma 1.5; zeros pad the border, so that every pixel counts.

    Args:
        image: Image (H, W, 3), display values 0..1.
        target: Image of the same shape.
        backend: Name of the backend.

    Returns:
        Scalar, 1 for equal images.

    Raises:
        ValueError: When the shapes differ or are not (H, W, 3).
    """
    return l1_and_ssim(image, target, backend)[1]


def check_images(image: Tensor, target: Tensor) -> None:
    """Check the shapes of two images.

    Args:
        image: Image (H, W, 3).
        target: Image (H, W, 3).

    Raises:
        ValueError: When the shapes differ or are not (H, W, 3).
    """
    if image.shape != target.shape or image.dim() != 3 or image.shape[2] != 3:
        raise ValueError(f"images must both be (H, W, 3), got {tuple(image.shape)} and {tuple(target.shape)}")


def l1_and_ssim(image: Tensor, target: Tensor, backend: str) -> tuple[Tensor, Tensor]:
    """Compute the mean absolute difference and the mean structural similarity in one pass.

    Args:
        image: Image (H, W, 3), display values 0..1.
        target: Image of the same shape.
        backend: Name of the backend.

    Returns:
        Two scalars, differentiable in `image`.

    Raises:
        ValueError: When the shapes differ or are not (H, W, 3).
    """
    check_images(image, target)
    return kernels_for(backend, image, target).l1_ssim(image, target)
