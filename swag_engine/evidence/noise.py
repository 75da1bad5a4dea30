"""Estimate the noise of images: its variance in linear light, which rises with the light."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import nnls

from ..base.transfer import linear_of_bytes
from ..scene.images import TrainingImage

KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
"""Second difference along both axes, 0 on planes and along straight edges (Immerkaer 1996)."""
KERNEL_GAIN = 6.0
"""Standard deviation of white noise after the kernel: the root of the sum of its squares."""
MAD_TO_SD = 1.4826
"""Standard deviation of normal values over their median absolute value."""
BLUR = 3.0
"""Standard deviation of the blur, pixels, before slopes are taken: these must not depend on the noise measured."""
FLAT = 0.25
"""Fraction of the pixels of one brightness, those of the smallest slope, that noise is measured on."""
BINS = 12
"""Bins of brightness, of equally many pixels."""
LEAST_PIXELS = 100
"""Flat pixels of a bin from which it counts."""
MOST_IMAGES = 12
"""Images that are examined, evenly spaced: all are of one camera."""
DARK, BRIGHT = 2, 253
"""8-bit values between which no noise is clipped."""
LEAST_OFFSET = (1 / 12.92 / 255) ** 2
"""Variance of one 8-bit step at black: images in 8 bits tell nothing finer, and JPEG hides noise below it."""
LEAST_SLOPE = (2.4 / 1.055 / 255) ** 2
"""Variance of one 8-bit step per linear light, nearly a constant."""


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel in linear light, offset + slope * light.

    Attributes:
        offset: (3,) variance at black.
        slope: (3,) increase of the variance with light.
    """

    offset: np.ndarray
    slope: np.ndarray


def estimate_noise(images: Sequence[TrainingImage]) -> Noise:
    """Estimate the noise in the flat parts of images, at the size they have.

    Args:
        images: Images of one camera.

    Returns:
        The noise, nowhere below one 8-bit step.
    """
    samples = [_flat_pixels(image) for image in images[:: max(1, -(-len(images) // MOST_IMAGES))]]
    offsets, slopes = [LEAST_OFFSET] * 3, [LEAST_SLOPE] * 3
    for channel, parts in enumerate(zip(*samples, strict=True)):
        light, deviation = np.concatenate(parts, axis=1)
        groups = np.array_split(np.argsort(light), BINS)
        bins = [(light[group].mean(), (MAD_TO_SD * np.median(deviation[group])) ** 2)
                for group in groups if len(group) >= LEAST_PIXELS]  # fmt: skip
        if len(bins) > 1:
            at, variance = np.array(bins).T
            # Errors are in proportion to the variance: each bin counts by its own, so that dark ones are not drowned.
            weight = 1 / (variance + LEAST_OFFSET + LEAST_SLOPE * at)
            (offset, slope), _ = nnls(np.stack([weight, weight * at], 1), weight * variance)
            offsets[channel], slopes[channel] = max(offset, LEAST_OFFSET), max(slope, LEAST_SLOPE)
    return Noise(np.array(offsets), np.array(slopes))


def _flat_pixels(image: TrainingImage) -> list[np.ndarray]:
    """For each channel (2, P): blurred light and absolute filtered light over KERNEL_GAIN, of the flattest pixels."""
    light = linear_of_bytes().astype(np.float32)[image.pixels]
    blurred = cv2.GaussianBlur(light, (0, 0), BLUR)
    filtered = np.abs(cv2.filter2D(light, -1, KERNEL)) / KERNEL_GAIN
    steepness = np.hypot(cv2.Sobel(blurred, -1, 1, 0), cv2.Sobel(blurred, -1, 0, 1))
    # The kernel reaches one pixel beyond: its neighbours must be valid and not clipped either.
    usable = image.valid[..., None] & (image.pixels >= DARK) & (image.pixels <= BRIGHT)
    inside = cv2.erode(usable.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    chosen = []
    for channel in range(3):
        flat = inside[..., channel]
        values = blurred[..., channel][flat], filtered[..., channel][flat], steepness[..., channel][flat]
        order = np.argsort(values[0])
        kept = [group[np.argsort(values[2][group])[: int(FLAT * len(group))]] for group in np.array_split(order, BINS)]
        index = np.concatenate(kept)
        chosen.append(np.stack([values[0][index], values[1][index]]))
    return chosen
