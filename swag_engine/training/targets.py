"""Images at the size that is trained at, which rendered images are compared with."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..scene.cameras import Camera
from ..scene.images import TrainingImage

LEAST_SIDE = 32
"""Pixels below which no side of an image is reduced."""
ALL_VALID = 0.999
"""Fraction of valid pixels under a reduced pixel from which it is valid, allowing for rounding."""


@dataclass
class Target:
    """One training image at one size.

    Attributes:
        camera: Its camera at that size.
        pixels: (H, W, 3) uint8.
        valid: (H, W) bool.
        inverse_range: (H, W) depth prior per scene unit, not finite where it is unknown; None without one.
        weight: Factor on its loss; below 1 for interpolated frames, from which only colors are learned.
        emphasis: (H, W) weight of each pixel, 0..1; None where all count the same.
    """

    camera: Camera
    pixels: Tensor
    valid: Tensor
    inverse_range: Tensor | None = None
    weight: float = 1.0
    emphasis: Tensor | None = None

    @property
    def color(self) -> Tensor:
        """(H, W, 3) display values in 0..1."""
        return self.pixels.float() / 255

    @property
    def interpolated(self) -> bool:
        """Whether it is a frame made between two images."""
        return self.weight != 1

    @classmethod
    def shrunk(
        cls,
        image: TrainingImage,
        factor: int,
        device: torch.device,
        inverse_range: np.ndarray | None = None,
        weight: float = 1.0,
    ) -> "Target":
        """Reduce an image to 1/factor of its size, but no side below LEAST_SIDE pixels.

        Args:
            image: The image.
            factor: A power of two.
            device: Where the tensors go.
            inverse_range: Depth prior (H, W) of the image.
            weight: Factor on its loss.

        Returns:
            The target; a pixel is valid where all pixels that it averages are.
        """
        camera, pixels, valid = image.camera, image.pixels, image.valid
        while factor > 1 and min(valid.shape) < LEAST_SIDE * factor:
            factor //= 2
        if factor > 1:
            camera = camera.resized(camera.width // factor)
            size = (camera.width, camera.height)
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            valid = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > ALL_VALID
            if inverse_range is not None:
                inverse_range = cv2.resize(inverse_range, size, interpolation=cv2.INTER_NEAREST)
        prior = None if inverse_range is None else torch.from_numpy(inverse_range).to(device)
        return cls(camera, torch.from_numpy(pixels).to(device), torch.from_numpy(valid).to(device), prior, weight)
