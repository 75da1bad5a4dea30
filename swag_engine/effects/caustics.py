"""Light that flickers on the ground, which no two photographs share.

A coarse field of light for each photograph multiplies what is rendered, and keeps the flicker out of the colours of the
place (benchmarks/caustics.py compares it with a weight that trusts patches of other brightness less).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..water.medium import to_display, to_light

FIELD_SIDE = 32
"""Cells of the field along a photograph's width."""


@dataclass
class Illumination:
    """log_light (V, rows, columns): log of the light in a coarse grid over each of V photographs."""

    log_light: Tensor

    @classmethod
    def starting(cls, views: int, width: int, height: int) -> "Illumination":
        """Even light over photographs of width x height pixels."""
        return cls(torch.zeros(views, max(1, round(FIELD_SIDE * height / width)), FIELD_SIDE))

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor of what is learned."""
        return {"log_light": self.log_light}


def illuminated(picture: Tensor, illumination: Illumination, view: int) -> Tensor:
    """A picture (H, W, 3) of display values in the light of photograph number `view`; differentiable.

    The mean over a photograph of the field's logarithm is 0: its brightness as a whole belongs to the exposure.
    """
    field = illumination.log_light[view]
    field = torch.nn.functional.interpolate(
        (field - field.mean())[None, None], size=picture.shape[:2], mode="bilinear", align_corners=False
    )[0, 0]
    return to_display(to_light(picture) * field.exp()[..., None])
