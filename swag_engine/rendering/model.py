"""A scene model: the Gaussians and the effects that together make images."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud

CLOUD = "cloud."
"""Prefix of the Gaussians' tensors in a checkpoint."""


@dataclass
class SceneModel:
    """Gaussians and effects of a scene.

    Attributes:
        cloud: The Gaussians, without water.
        effects: Water, lamp, exposure and other effects.
    """

    cloud: GaussianCloud
    effects: SceneEffects

    @classmethod
    def from_checkpoint(cls, tensors: dict[str, Tensor], stored: dict[str, Any]) -> "SceneModel":
        """Read the model of a checkpoint.

        Args:
            tensors: Tensors by name.
            stored: The checkpoint's JSON document.

        Returns:
            The model, which shares no memory with the arguments.
        """
        return cls(cloud_from_checkpoint(tensors), SceneEffects.from_checkpoint(tensors, stored))

    def to(self, device: torch.device) -> "SceneModel":
        """Return the model with its tensors on a device."""
        return SceneModel(self.cloud.to(device), self.effects.to(device))


def cloud_from_checkpoint(tensors: dict[str, Tensor]) -> GaussianCloud:
    """Read the Gaussians of a checkpoint's tensors; they share no memory with them."""
    return GaussianCloud(
        **{name.removeprefix(CLOUD): t.clone() for name, t in tensors.items() if name.startswith(CLOUD)}
    )
