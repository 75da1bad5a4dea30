"""Moving objects that a run masks out of its training images."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ..effects.moving_objects import LEAST_IMAGES, fraction_with_objects, moving_mask, residual, residuals_elsewhere
from ..effects.scene_effects import SceneEffects
from ..evaluation.metrics import render_image
from ..gaussians.cloud import GaussianCloud
from ..scene.images import TrainingImage

SEARCHED_AT = (0.3, 0.6)
"""Fractions of the run after which the next densification searches for moving objects."""
SAMPLE = 60
"""Images that are compared first, spread evenly over all. If a tenth of all showed objects, which is LEAST_IMAGES, no
more than one of 60 would in one search of 70 (binomial distribution)."""
STORED = "moved."
"""Prefix of the masks in a checkpoint."""


@dataclass(frozen=True)
class MotionMasks:
    """Masks of moving objects.

    Attributes:
        masks: By image name, (H, W) bool: pixels that show a moving object.
        searches: How often the run has searched.
    """

    masks: dict[str, np.ndarray] = field(default_factory=dict)
    searches: int = 0

    def search_due(self, fraction: float) -> bool:
        """Return whether to search now, `fraction` (0..1) of the way through the run."""
        return sum(fraction >= at for at in SEARCHED_AT) > self.searches

    def static_pixels(self, image: TrainingImage) -> TrainingImage:
        """Return a training image with the pixels of moving objects invalid."""
        mask = self.masks.get(image.camera.name)
        return image if mask is None else replace(image, valid=image.valid & ~mask)

    @property
    def note(self) -> str:
        """A sentence for the user, empty where nothing moved."""
        if not self.masks:
            return ""
        covered = 100 * np.mean([mask.mean() for mask in self.masks.values()])
        return f"Moving objects on {covered:.1f} % of the pixels of {len(self.masks)} images are masked out."

    def tensors(self) -> dict[str, Tensor]:
        """Return the masks as packed bits for a checkpoint."""
        return {STORED + name: torch.from_numpy(np.packbits(mask)) for name, mask in self.masks.items()}

    @classmethod
    def from_checkpoint(
        cls, tensors: dict[str, Tensor], searches: int, images: Sequence[TrainingImage]
    ) -> "MotionMasks":
        """Read what `tensors` returned; `images` are those of the run, which give the masks' sizes."""
        masks = {}
        for image in images:
            bits = tensors.get(STORED + image.camera.name)
            if bits is not None:
                flat = np.unpackbits(bits.cpu().numpy(), count=image.valid.size)
                masks[image.camera.name] = flat.reshape(image.valid.shape).astype(bool)
        return cls(masks, searches)


def find_motion(
    cloud: GaussianCloud, effects: SceneEffects, images: Sequence[TrainingImage], sh_degree: int, backend: str
) -> dict[str, np.ndarray]:
    """Find what the scene as it is learned now does not explain in single images.

    Args:
        cloud: The Gaussians.
        effects: The scene's effects.
        images: The training images.
        sh_degree: Degree of the spherical harmonics to render with.
        backend: What renders.

    Returns:
        By image name, masks (H, W) bool of moving objects; empty where too few images show any.
    """

    def compared(image: TrainingImage) -> tuple[np.ndarray, np.ndarray]:
        """Its residuals, and its mask as if other images showed none: what they show only makes it smaller."""
        shown = render_image(cloud, image.camera, sh_degree, backend, effects)
        here = residual(image.pixels / np.float32(255), shown.numpy(), image.valid)
        return here, moving_mask(here, np.zeros_like(here), image.valid)

    step = max(1, len(images) // SAMPLE)
    found = {index: compared(images[index]) for index in range(0, len(images), step)}
    if step > 1 and sum(fraction_with_objects([mask]) for _, mask in found.values()) <= 1:
        return {}
    found |= {index: compared(image) for index, image in enumerate(images) if index not in found}
    residuals, masks = (list(values) for values in zip(*(found[index] for index in range(len(images))), strict=True))
    if fraction_with_objects(masks) >= LEAST_IMAGES:
        possible = [index for index, mask in enumerate(masks) if mask.any()]
        elsewhere = residuals_elsewhere(cloud, [image.camera for image in images], residuals, possible, backend)
        for index, others in zip(possible, elsewhere, strict=True):
            masks[index] = moving_mask(residuals[index], others, images[index].valid)
    if fraction_with_objects(masks) < LEAST_IMAGES:
        return {}
    return {image.camera.name: mask for image, mask in zip(images, masks, strict=True) if mask.any()}
