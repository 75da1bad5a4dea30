"""The brightness of each photograph: exposure and white balance that a camera changes by itself.

A gain multiplies the linear light of a whole photograph, water included. Only ratios of gains mean anything, so the
mean of their logarithms is always 0. A held-out photograph has none of its own: nothing of it may be looked at.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..water.light import relit


@dataclass
class Exposure:
    """raw (V, 1) log gains of V photographs, or (V, 3) where the white balance changes too; names: theirs, sorted."""

    raw: Tensor
    names: Sequence[str]

    @classmethod
    def starting(cls, log_gains: dict[str, float], channels: int = 1) -> "Exposure":
        """From log gains by the photographs' names."""
        names = sorted(log_gains)
        raw = torch.tensor([log_gains[name] for name in names], dtype=torch.float32)
        return cls(raw[:, None].repeat(1, channels), names)

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor of what is learned."""
        return {"raw": self.raw}

    @property
    def log_gains(self) -> Tensor:
        """(V, 1 or 3), mean 0 over the photographs."""
        return self.raw - self.raw.mean(0)

    def of(self, name: str) -> Tensor:
        """Log gain (1 or 3,) of a photograph, and where none was learned for it what its neighbours let expect.

        Neighbours by name: a film's exposure changes slowly, that of single photographs by chance. So their mean counts
        as far as such means have predicted the photographs that are known (regression through 0).
        """
        gains = self.log_gains
        if name in self.names:
            return gains[self.names.index(name)]
        if len(self.names) < LEAST_KNOWN:
            return torch.zeros_like(gains[0])
        gains = gains.detach()
        expected = (gains[2:] + gains[:-2]) / 2
        trust = ((expected * gains[1:-1]).sum() / expected.square().sum().clamp(min=1e-12)).clamp(0, 1)
        place = sum(known < name for known in self.names)
        return trust * gains[max(place - 1, 0) : place + 1].mean(0)


LEAST_KNOWN = 5
"""Photographs, below which neighbours say nothing of one another."""


def exposed(picture: Tensor, exposure: Exposure, name: str) -> Tensor:
    """A picture (H, W, 3) of display values as the photograph of this name shows it; differentiable."""
    return relit(picture, exposure.of(name))
