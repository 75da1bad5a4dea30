"""Maps that are made from heights: hillshade, slope and rugosity."""

import cv2
import numpy as np

from .heights import gradients, surface_factor

SUN_AZIMUTH = 315.0
"""Direction of the light of a hillshade, degrees from the top of the map, clockwise: the custom of maps."""
SUN_HEIGHT = 45.0
"""Height of that light above the horizon, degrees."""


def hillshade(heights: np.ndarray, pixel: float) -> np.ndarray:
    """Shade heights (H, W) as a matt surface in parallel light, 0 to 1, NaN where nothing was seen."""
    down, right = gradients(heights, pixel)
    azimuth, elevation = np.radians(SUN_AZIMUTH), np.radians(SUN_HEIGHT)
    light = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)
    # The normal is (-dz/dx, -dz/dy, 1) and y goes up where rows go down.
    shade = (-right * light[0] + down * light[1] + light[2]) / np.sqrt(1 + right * right + down * down)
    return np.clip(shade, 0, 1)


def slope(heights: np.ndarray, pixel: float) -> np.ndarray:
    """Return the steepness of heights (H, W) in degrees, NaN where nothing was seen."""
    down, right = gradients(heights, pixel)
    return np.degrees(np.arctan(np.hypot(down, right)))


def rugosity(heights: np.ndarray, pixel: float, window: int, step: int = 1) -> np.ndarray:
    """Return surface over planar area in a window around each pixel, NaN where nothing was seen.

    Args:
        heights: (H, W), NaN where nothing was seen.
        pixel: Edge of a pixel.
        window: Edge of the window, an odd number of pixels.
        step: As `surface_step` returns it.
    """
    factor = surface_factor(heights, pixel, step)
    known = np.isfinite(factor)
    size = window, window
    sums = cv2.boxFilter(
        np.where(known, factor, 0.0), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    counts = cv2.boxFilter(known.astype(np.float64), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.where(known, sums / np.maximum(counts, 1), np.nan)
