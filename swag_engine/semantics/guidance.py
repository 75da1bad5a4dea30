"""What labels can do to a training: L_s moves only features (METHOD.md section 5), these move pictures."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from .regions import SceneRegions
from .saliency import OPEN_WATER


def label_mask(regions: SceneRegions, name: str, label: str = OPEN_WATER) -> np.ndarray:
    """(H, W) bool: where the photograph `name` shows `label`; nowhere where the scene has no such label."""
    number = regions.labels.index(label) + 1 if label in regions.labels else -1
    return np.asarray(regions.maps[name] == number)


def open_water_loss(alpha: Tensor, water: Tensor) -> Tensor:
    """Mean opacity, 0..1, where a photograph shows open water, 0 where it shows none; differentiable in alpha (H, W).

    Open water is the tail behind all Gaussians: whatever covers it is a floater. water (H, W) bool.
    """
    return torch.where(water, alpha, torch.zeros_like(alpha)).sum() / water.sum().clamp(min=1)


def pixel_weights(regions: SceneRegions, name: str, weights: Mapping[str, float]) -> np.ndarray:
    """(H, W) float32: the photometric weight of each pixel of a photograph by its label; 1 for labels without one."""
    table = np.ones(len(regions.labels) + 1, np.float32)
    for number, label in enumerate(regions.labels, start=1):
        table[number] = weights.get(label, 1.0)
    return table[regions.maps[name]]


def gaussian_weights(regions: SceneRegions, labels: Tensor, weights: Mapping[str, float]) -> Tensor:
    """(N,) float32: a factor on the scores of growth and reallocation by the label of each Gaussian, labels (N,) int64;
    1 without a label or a weight."""
    table = torch.ones(len(regions.labels) + 1, device=labels.device)
    for number, label in enumerate(regions.labels, start=1):
        table[number] = weights.get(label, 1.0)
    return table[labels]


def kept(regions: SceneRegions, labels: Tensor, agreement: Tensor, dropped: tuple[str, ...]) -> Tensor:
    """(N,) bool: False for Gaussians of a dropped class, such as fish or open water, that their photographs agree on.

    labels and agreement (N,) as in assign.Assignment; half of the votes is too little to delete something.
    """
    numbers = [number for number, label in enumerate(regions.labels, start=1) if label in dropped]
    of_class = torch.isin(labels, torch.tensor(numbers, dtype=labels.dtype, device=labels.device))
    return ~(of_class & (agreement > 0.7))
