"""Loss that holds rendered ranges to a depth prior."""

import torch
from torch import Tensor


def depth_loss(range_image: Tensor, alpha: Tensor, q: Tensor, median_range: float, pearson: bool = False) -> Tensor:
    """How far the rendered range is from the prior, over the pixels with alpha > .5 (docs/method.md section 3).

    range_image D (H, W) is alpha-weighted and normalised, in scene units, as `Picture.range`; alpha (H, W); q (H, W) is
    the prior's inverse range, not finite where there is none. The loss is mean |1/D - q| r_bar, r_bar being
    median_range, or with `pearson` 1 - the correlation of 1/D and q. Differentiable in range_image, with finite
    gradients wherever D is 0; the loss is 0 where no pixel counts.
    """
    counted = (alpha > 0.5) & (range_image > 1e-6 * median_range) & q.isfinite()
    # The denominator is chosen before dividing: 0/0 behind a mask is NaN in the backward pass.
    chosen = torch.where(counted, range_image, torch.ones_like(range_image))
    inverse, target = (
        torch.where(counted, median_range * values, torch.zeros_like(values)) for values in (1 / chosen, q)
    )
    count = counted.sum().clamp(min=1)
    if not pearson:
        return (inverse - target).abs().sum() / count
    x, y = (
        torch.where(counted, values - values.sum() / count, torch.zeros_like(values)) for values in (inverse, target)
    )
    # A spread of a thousandth of the median range is as good as none, and must not blow the gradient up.
    spread = ((x.square().sum() / count + 1e-6) * (y.square().sum() / count + 1e-6)).sqrt()
    return torch.where(counted.any(), 1 - (x * y).sum() / count / spread, spread * 0)
