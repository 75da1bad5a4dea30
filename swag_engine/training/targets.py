"""What pictures are compared with: the photographs at one size, and frames made between them."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..scene.cameras import Camera
from ..scene.images import TrainingImage


@dataclass
class Target:
    """One photograph at one size: camera, pixels (H, W, 3) uint8, valid (H, W) bool.

    inverse_range (H, W): the depth prior, per scene unit, not finite where it is unknown; None without one.
    emphasis (H, W): what each pixel counts, 0..1; None for all alike.
    weight: of its loss; below 1 for frames that are made, which nothing but colours is learned from.
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

    @classmethod
    def shrunk(
        cls,
        image: TrainingImage,
        factor: int,
        device: torch.device,
        inverse_range: np.ndarray | None = None,
        weight: float = 1.0,
    ) -> "Target":
        """The photograph at 1/factor of its size, or as small as leaves it 32 pixels (factor a power of two); a pixel
        is valid where all that it averages is."""
        camera, pixels, valid = image.camera, image.pixels, image.valid
        while factor > 1 and min(valid.shape) < 32 * factor:
            factor //= 2
        if factor > 1:
            camera = camera.resized(camera.width // factor)
            size = (camera.width, camera.height)
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            valid = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
            if inverse_range is not None:
                inverse_range = cv2.resize(inverse_range, size, interpolation=cv2.INTER_NEAREST)
        prior = None if inverse_range is None else torch.from_numpy(inverse_range).to(device)
        return cls(camera, torch.from_numpy(pixels).to(device), torch.from_numpy(valid).to(device), prior, weight)
