"""What a picture costs: its distance from the photograph, and what is known about any place under water."""

import torch
from torch import Tensor

from ..evaluation.ssim import check_images, l1_and_ssim

RELATIVE_FLOOR = 1e-3


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
    """l1 mean |e| + ssim_weight (1 - SSIM) + l2 mean e^2 of e = image - target (H, W, 3); differentiable in image.

    relative: e is divided by the image's own brightness (WaterSplatting, arXiv 2408.08206), which carries no gradient
    of its own; SSIM stays as it is. valid: (H, W) bool or None. Invalid pixels take the target's value first: they
    add nothing and get no gradient.
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
    """How far a picture without water, (H, W, 3), is from grey on average where alpha (H, W) > .5; differentiable.

    "mean": mean_c (mu_c / mu - 1)^2 with mu the mean of the channels' means mu_c; "middle": sum_c (mu_c - 1/2)^2
    (SWAGSplatting). 0 where nothing is covered.
    """
    covered = (alpha.detach() > 0.5).to(restored.dtype)
    means = (restored * covered[..., None]).sum((0, 1)) / covered.sum().clamp(min=1)
    if target == "middle":
        return (means - 0.5).square().sum() * covered.any()
    return (means / means.mean().clamp(min=1e-3) - 1).square().mean() * covered.any()


def smoothness(range_image: Tensor, alpha: Tensor, guide: Tensor, median_range: float) -> Tensor:
    """mean |change of range from pixel to pixel| / median_range x exp(-5 |change of the guide|); differentiable.

    range_image (H, W) in scene units and alpha (H, W) as of a Picture; guide (H, W, 3) in 0..1: where it has an edge,
    range may have one. Pairs of pixels count where both have alpha > .5.
    """
    covered = alpha.detach() > 0.5
    total, count = range_image.new_zeros(()), covered.new_zeros((), dtype=torch.long)
    for axis in (0, 1):
        steps = range_image.diff(dim=axis).abs() / median_range
        edges = torch.exp(-5 * guide.diff(dim=axis).abs().mean(-1))
        both = covered.narrow(axis, 1, covered.shape[axis] - 1) & covered.narrow(axis, 0, covered.shape[axis] - 1)
        total = total + torch.where(both, steps * edges, torch.zeros_like(steps)).sum()
        count = count + both.sum()
    return total / count.clamp(min=1)


def attenuation_order(beta: Tensor, order: tuple[int, int, int], margin: float = 1e-3) -> Tensor:
    """Hinge on coefficients (3,) that should fall in this order of channels; 0 where each leads the next by margin."""
    first, second, third = (beta[channel] for channel in order)
    return (margin - first + second).clamp(min=0) + (margin - second + third).clamp(min=0)
