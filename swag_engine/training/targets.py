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
        surface: (H, W) bool, pixels that show no open water; None where it is not needed.
    """

    camera: Camera
    pixels: Tensor
    valid: Tensor
    inverse_range: Tensor | None = None
    weight: float = 1.0
    emphasis: Tensor | None = None
    surface: Tensor | None = None

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
        while factor > 1 and min(image.valid.shape) < LEAST_SIDE * factor:
            factor //= 2
        if factor > 1:
            image = image.resized(image.camera.width // factor)
            if inverse_range is not None:
                inverse_range = cv2.resize(inverse_range, image.valid.shape[::-1], interpolation=cv2.INTER_NEAREST)
        pixels, valid = (torch.from_numpy(array).to(device) for array in (image.pixels, image.valid))
        prior = None if inverse_range is None else torch.from_numpy(inverse_range).to(device)
        return cls(image.camera, pixels, valid, prior, weight)
