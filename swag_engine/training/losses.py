"""Loss terms: differences from the training image, and priors on scenes under water (docs/method.md)."""

import torch
from torch import Tensor

from ..evaluation.ssim import check_images, l1_and_ssim

RELATIVE_FLOOR = 1e-3
"""Display value added to the brightness that relative residuals are divided by."""
COVERED = 0.5
"""Alpha from which a pixel shows a surface."""
LIKE_WATER = 0.05
"""Display value: open water differs from its model by less, because of noise, exposure and haze."""
UNLIKE_WATER = 0.15
"""Display value by which only surfaces differ from open water."""
CLOSED = 0.02
"""Part of what is behind a surface that may be seen: less is not worth opaque Gaussians that no photo needs."""
SURFACE_LIMITS = (LIKE_WATER, UNLIKE_WATER, CLOSED)
"""The three as the kernels take them."""


def photometric(
    image: Tensor,
    target: Tensor,
    valid: Tensor | None,
    l1: float = 0.8,
    ssim_weight: float = 0.2,
    l2: float = 0.0,
    relative: bool = False,
    backend: str = "auto",
) -> Tensor:
    """Compare a rendered image with a training image: l1 mean |e| + ssim_weight (1 - SSIM) + l2 mean e^2.

    Args:
        image: (H, W, 3) rendered display values.
        target: (H, W, 3) display values in 0..1; e = image - target.
        valid: (H, W) bool, None where all pixels count. Invalid pixels add nothing and get no gradient.
        l1: Weight of the mean absolute difference.
        ssim_weight: Weight of 1 - SSIM.
        l2: Weight of the mean squared difference.
        relative: Divide e by the image's own brightness, which carries no gradient of its own (WaterSplatting, arXiv
            2408.08206); SSIM stays as it is.
        backend: What computes.

    Returns:
        The loss, a scalar; differentiable in image.

    Raises:
        ValueError: If the images differ in shape.
    """
    if valid is not None:
        image = torch.where(valid[..., None], image, target)
    check_images(image, target)
    loss = image.new_zeros(())
    if ssim_weight:
        absolute, similarity = l1_and_ssim(image, target, backend)
        loss = loss + ssim_weight * (1 - similarity)
        if not relative:  # one pass gives both
            loss, l1 = loss + l1 * absolute, 0.0
    error = image - target
    if relative:
        error = error / (image.detach().clamp(min=0) + RELATIVE_FLOOR)
    if l1:
        loss = loss + l1 * error.abs().mean()
    return loss + l2 * error.square().mean() if l2 else loss


def grey_world(restored: Tensor, alpha: Tensor, target: str = "mean") -> Tensor:
    """Measure how far an image without water is from grey on average.

    Args:
        restored: (H, W, 3) image without water.
        alpha: (H, W); pixels with alpha > COVERED count.
        target: "mean" for mean_c (mu_c / mu - 1)^2, mu being the mean of the channels' means mu_c; "middle" for
            sum_c (mu_c - 1/2)^2 (SWAGSplatting).

    Returns:
        The loss, a scalar, 0 where nothing is covered; differentiable in restored.
    """
    covered = (alpha.detach() > COVERED).to(restored.dtype)
    means = (restored * covered[..., None]).sum((0, 1)) / covered.sum().clamp(min=1)
    if target == "middle":
        return (means - 0.5).square().sum() * covered.any()
    return (means / means.mean().clamp(min=1e-3) - 1).square().mean() * covered.any()


def uncovered_surface(alpha: Tensor, target: Tensor, behind: Tensor, valid: Tensor) -> Tensor:
    """Measure how much of the surfaces in a training image Gaussians leave open.

    Open water behind a surface that is not finished looks like its backscatter, so that the comparison of images alone
    leaves far surfaces half transparent. They are too dark then once the water is removed. A surface of which less than
    CLOSED is open adds nothing: Adam makes steps of the same size for the smallest gradients, which would make opaque
    what hardly any photo shows, as Gaussians in front of surfaces.

    Args:
        alpha: (H, W) of the rendered image.
        target: (H, W, 3) the training image, display values.
        behind: (H, W, 3) display color of open water.
        valid: (H, W) bool, pixels that count.

    Returns:
        Mean of what 1 - alpha exceeds CLOSED by, weighted by how sure it is that a pixel does not show open water: 0
        where it differs from that by less than LIKE_WATER in all channels, 1 from UNLIKE_WATER on. A scalar,
        differentiable in alpha.
    """
    apart = (target - behind.detach()).abs().amax(-1)
    surface = ((apart - LIKE_WATER) / (UNLIKE_WATER - LIKE_WATER)).clamp(0, 1) * valid
    return (surface * (1 - CLOSED - alpha).relu()).mean()


def uncovered_pixels(alpha: Tensor, surface: Tensor) -> Tensor:
    """Measure how much of the surfaces in a training image Gaussians leave open in front of a learned background color.

    The ground has that color more than anything else, so that the comparison of images alone leaves it half
    transparent.

    Args:
        alpha: (H, W) of the rendered image.
        surface: (H, W) bool, pixels that count and show no open water.

    Returns:
        Mean of what 1 - alpha exceeds CLOSED by, a scalar, differentiable in alpha.
    """
    return (surface * (1 - CLOSED - alpha).relu()).mean()


def smoothness(range_image: Tensor, alpha: Tensor, guide: Tensor, median_range: float) -> Tensor:
    """Penalise changes of range between neighbouring pixels: mean |change| / median_range exp(-5 |change of guide|).

    Args:
        range_image: (H, W) range in scene units.
        alpha: (H, W); pairs of pixels count where both have alpha > COVERED.
        guide: (H, W, 3) image in 0..1; where it has an edge, range may have one.
        median_range: Median range of the scene, scene units.

    Returns:
        The loss, a scalar; differentiable in range_image.
    """
    covered = alpha.detach() > COVERED
    total, count = range_image.new_zeros(()), covered.new_zeros((), dtype=torch.long)
    for axis in (0, 1):
        steps = range_image.diff(dim=axis).abs() / median_range
        edges = torch.exp(-5 * guide.diff(dim=axis).abs().mean(-1))
        both = covered.narrow(axis, 1, covered.shape[axis] - 1) & covered.narrow(axis, 0, covered.shape[axis] - 1)
        total = total + torch.where(both, steps * edges, torch.zeros_like(steps)).sum()
        count = count + both.sum()
    return total / count.clamp(min=1)


def attenuation_order(beta: Tensor, order: tuple[int, int, int], margin: float = 1e-3) -> Tensor:
    """Penalise attenuation coefficients that are not in the expected order of channels.

    Args:
        beta: (3,) coefficients.
        order: Channels, that of the largest coefficient first.
        margin: Difference that two neighbours in the order must have.

    Returns:
        The loss, a scalar, 0 where all are in order; differentiable in beta.
    """
    first, second, third = (beta[channel] for channel in order)
    return (margin - first + second).clamp(min=0) + (margin - second + third).clamp(min=0)
