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


def relit(display: Tensor, log_factor: Tensor) -> Tensor:
    """to_display(to_light(display) exp(log_factor)) of shapes that broadcast; differentiable in both.

    Above the curve's straight part the exponents cancel: with s = exp(log_factor / 2.4), s (display + .055) - .055. So
    the curve itself is only followed where a value is, or ends, in the straight part.
    """
    curved = (log_factor / 2.4).exp() * (display + 0.055) - 0.055
    with torch.no_grad():
        crossing = (display <= DARK) | (curved <= DARK)
        somewhere = bool(crossing.any())
    if not somewhere:
        return curved
    place = crossing.nonzero(as_tuple=True)
    factor = log_factor.expand_as(curved)[place].exp()
    return curved.index_put(place, to_display(to_light(display.expand_as(curved)[place]) * factor))


def light_of_bytes() -> np.ndarray:
    """(256,) linear light of 8-bit display values."""
    display = np.arange(256) / 255
    return np.where(display <= DARK, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
