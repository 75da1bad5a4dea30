"""Estimate the noise of images: that of the camera, whose variance rises with the light, and that of compression."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from ..base.transfer import linear_of_bytes
from ..scene.colmap import View
from ..scene.compression import compression_variance
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
LEAST_OFFSET = (1 / 12.92 / 255) ** 2 / 12
"""Variance of rounding to 8 bits at black: images in 8 bits tell nothing finer."""
LEAST_SLOPE = (2.4 / 1.055 / 255) ** 2 / 12
"""Variance of rounding to 8 bits per linear light, nearly a constant."""
YCC_TO_RGB = np.array([[1, 0, 1.402], [1, -0.344136, -0.714136], [1, 1.772, 0]])
"""Display values of red, green and blue from brightness Y and the colors Cb and Cr of JPEG files (ITU-T T.871)."""


@dataclass(frozen=True)
class Noise:
    """Noise of a pixel.

    Attributes:
        offset: (3,) variance of linear light at black, without compression.
        slope: (3,) increase of that variance with light.
        compression: (3,) variance of Y, Cb and Cr by compression, display values, in details.
    """

    offset: np.ndarray
    slope: np.ndarray
    compression: np.ndarray

    def variance(self, light: Tensor) -> Tensor:
        """Return the variance (..., 3) of linear light (..., 3) of red, green and blue."""
        offset, slope, compression = self._tensors(light)
        return offset + slope * light + compression.diagonal() * _light_by_display(light).square()

    def covariance(self, light: Tensor) -> Tensor:
        """Return the covariance (..., 3, 3) of linear light (..., 3) of red, green and blue."""
        offset, slope, compression = self._tensors(light)
        change = _light_by_display(light)
        return torch.diag_embed(offset + slope * light) + change[..., :, None] * compression * change[..., None, :]

    def _tensors(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Offset, slope and the covariance (3, 3) of display values by compression, as tensors."""
        covariance = YCC_TO_RGB * self.compression @ YCC_TO_RGB.T
        offset, slope, compression = (torch.from_numpy(part).to(like) for part in (self.offset, self.slope, covariance))
        return offset, slope, compression

    def to_json(self) -> dict[str, list[float]]:
        """Return a plain dict that `from_json` reads."""
        return {entry.name: getattr(self, entry.name).tolist() for entry in fields(self)}

    @classmethod
    def from_json(cls, document: Mapping[str, list[float]]) -> "Noise":
        """Read what `to_json` returned."""
        return cls(*(np.array(document[entry.name]) for entry in fields(cls)))


def _light_by_display(light: Tensor) -> Tensor:
    """The derivative of linear light by display values (sRGB)."""
    return (2.4 / 1.055 * light.clamp(min=0) ** (1.4 / 2.4)).clamp(min=1 / 12.92)


def estimate_noise(images: Sequence[TrainingImage], views: Iterable[View]) -> Noise:
    """Estimate the noise in the flat parts of images, and that of compression in details, at the size they have.

    Args:
        images: Images of one camera.
        views: Views of their scene, which have the files of the photos.

    Returns:
        The noise, nowhere below that of rounding to 8 bits.
    """
    examined = images[:: max(1, -(-len(images) // MOST_IMAGES))]
    samples = [_flat_pixels(image) for image in examined]
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
    widths = {image.camera.name: image.camera.width for image in examined}
    compression = [compression_variance(view.path, widths[view.name]) for view in views if view.name in widths]
    return Noise(np.array(offsets), np.array(slopes), np.mean(compression or [np.zeros(3)], axis=0))


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
