"""Transfer functions between display values and linear light: the sRGB curve of IEC 61966-2-1, in torch."""

import torch
from torch import Tensor

from ...base.transfer import DISPLAY_TOE, LINEAR_TOE


def to_light(display: Tensor) -> Tensor:
    """Convert display values to linear light.

    Args:
        display: Display values, nominally 0..1, of any shape.

    Returns:
        Linear light of the same shape, differentiable.
    """
    power = ((display.clamp(min=DISPLAY_TOE) + 0.055) / 1.055) ** 2.4
    return torch.where(display <= DISPLAY_TOE, display / 12.92, power)


def to_display(light: Tensor) -> Tensor:
    """Convert linear light to display values; the inverse of `to_light`.

    Args:
        light: Linear light, nominally 0..1, of any shape.

    Returns:
        Display values of the same shape, differentiable.
    """
    power = 1.055 * light.clamp(min=LINEAR_TOE) ** (1 / 2.4) - 0.055
    return torch.where(light <= LINEAR_TOE, 12.92 * light, power)
