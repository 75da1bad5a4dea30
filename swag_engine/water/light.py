"""Linear light and display values: which is used where, and the curve between them (sRGB, IEC 61966-2-1).

| what | works on | because |
|---|---|---|
| attenuation, backscatter, lamp, exposure, caustics, and the fit of all of them | linear light | physics |
| recipes that follow methods with water on pixel values (`Recipe.light` "srgb") | display values | they have it so |
| colours of Gaussians, blending, losses, PSNR, SSIM, LPIPS, depth and frame networks | display values | made for them |
| delta E | CIE L*a*b* of linear light | its definition |

An effect takes display values to light, does its work, and brings them back: everything else sees display values only.
"""

import torch
from torch import Tensor

from ..base.transfer import DISPLAY_TOE, LINEAR_TOE
from ..kernels.backends import kernels_for


def to_light(display: Tensor) -> Tensor:
    """Linear light of display values, any shape."""
    power = ((display.clamp(min=DISPLAY_TOE) + 0.055) / 1.055) ** 2.4
    return torch.where(display <= DISPLAY_TOE, display / 12.92, power)


def to_display(light: Tensor) -> Tensor:
    """Display values of linear light, any shape; the inverse of to_light."""
    power = 1.055 * light.clamp(min=LINEAR_TOE) ** (1 / 2.4) - 0.055
    return torch.where(light <= LINEAR_TOE, 12.92 * light, power)


def relit(display: Tensor, log_factor: Tensor, backend: str = "auto") -> Tensor:
    """to_display(to_light(display) exp(log_factor)) of shapes that broadcast; differentiable in both.

    Kernels do it where the factors (any shape that expands to that of `display`) scale colours (..., 3).
    """
    sizes = zip(reversed(log_factor.shape), reversed(display.shape), strict=False)
    expands = log_factor.dim() <= display.dim() and all(small in (1, size) for small, size in sizes)
    colors = display.shape[-1:] == (3,) and expands
    if colors and (kernels := kernels_for(backend, display, log_factor)):
        return kernels.relit(display, log_factor)
    return to_display(to_light(display) * log_factor.exp())
