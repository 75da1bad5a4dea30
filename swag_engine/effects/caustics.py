"""Light that flickers on the ground, which no two photographs share.

A coarse field of light for each photograph multiplies what is rendered, and keeps the flicker out of the colours of the
place (benchmarks/caustics.py compares it with a weight that trusts patches of other brightness less).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..water.light import relit

FIELD_SIDE = 32
"""Cells of the field along a photograph's width."""


@dataclass
class Illumination:
    """log_light (V, rows, columns): log of the light in a coarse grid over each of V photographs; names: theirs."""

    log_light: Tensor
    names: Sequence[str]

    @classmethod
    def starting(cls, names: Sequence[str], width: int, height: int) -> "Illumination":
        """Even light over photographs of width x height pixels."""
        return cls(torch.zeros(len(names), max(1, round(FIELD_SIDE * height / width)), FIELD_SIDE), list(names))

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor of what is learned."""
        return {"log_light": self.log_light}

    def of(self, name: str, height: int, width: int) -> Tensor | None:
        """Log of the light (height, width, 1) in a photograph, None where none was learned for it: even light.

        The mean over a photograph is 0: its brightness as a whole belongs to the exposure.
        """
        if name not in self.names:
            return None
        field = self.log_light[self.names.index(name)]
        field = (field - field.mean())[None, None]
        return torch.nn.functional.interpolate(field, size=(height, width), mode="bilinear", align_corners=False)[
            0, 0, ..., None
        ]


def illuminated(picture: Tensor, illumination: Illumination, name: str) -> Tensor:
    """A picture (H, W, 3) of display values in the light of the photograph of this name; differentiable."""
    field = illumination.of(name, *picture.shape[:2])
    return picture if field is None else relit(picture, field)
