"""Transfer functions between display values and linear light: the sRGB curve of IEC 61966-2-1, in numpy."""

import numpy as np

DISPLAY_TOE = 0.04045
"""Display value below which the curve is a straight line."""
LINEAR_TOE = 0.0031308
"""Linear light at the same place."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Luminance of linear red, green and blue (Rec. 709)."""


def srgb_to_linear(display: np.ndarray) -> np.ndarray:
    """Convert display values to linear light.

    Args:
        display: Display values, nominally 0..1, of any shape.

    Returns:
        Linear light of the same shape.
    """
    power = ((np.maximum(display, DISPLAY_TOE) + 0.055) / 1.055) ** 2.4
    return np.where(display <= DISPLAY_TOE, display / 12.92, power)


def linear_to_srgb(light: np.ndarray) -> np.ndarray:
    """Convert linear light to display values; the inverse of `srgb_to_linear`.

    Args:
        light: Linear light, nominally 0..1, of any shape.

    Returns:
        Display values of the same shape.
    """
    return np.where(light <= LINEAR_TOE, 12.92 * light, 1.055 * np.maximum(light, LINEAR_TOE) ** (1 / 2.4) - 0.055)


def linear_of_bytes() -> np.ndarray:
    """Return the linear light (256,) of all 8-bit display values."""
    return srgb_to_linear(np.arange(256) / 255)
