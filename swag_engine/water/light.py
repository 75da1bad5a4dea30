"""Linear light and display values: which is used where, and the curve between them (sRGB, IEC 61966-2-1).

| what | works on | because |
|---|---|---|
| attenuation, backscatter, lamp, exposure, caustics, and the fit of all of them | linear light | physics |
| recipes that follow methods with water on pixel values (`Recipe.light` "srgb") | display values | they have it so |
| colours of Gaussians, blending, losses, PSNR, SSIM, LPIPS, depth and frame networks | display values | made for them |
| delta E | CIE L*a*b* of linear light | its definition |

An effect takes display values to light, does its work, and brings them back: everything else sees display values only.
"""

import numpy as np
import torch
from torch import Tensor

from ..rasterize.backends import kernels_for

DARK, DARK_LIGHT = 0.04045, 0.0031308
"""Where the curve's straight part ends, as display value and as light."""


def to_light(display: Tensor) -> Tensor:
    """Linear light of display values, any shape."""
    power = ((display.clamp(min=DARK) + 0.055) / 1.055) ** 2.4
    return torch.where(display <= DARK, display / 12.92, power)


def to_display(light: Tensor) -> Tensor:
    """Display values of linear light, any shape; the inverse of to_light."""
    power = 1.055 * light.clamp(min=DARK_LIGHT) ** (1 / 2.4) - 0.055
    return torch.where(light <= DARK_LIGHT, 12.92 * light, power)


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


def light_of_bytes() -> np.ndarray:
    """(256,) linear light of 8-bit display values."""
    display = np.arange(256) / 255
    return np.where(display <= DARK, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
