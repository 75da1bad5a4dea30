"""A lamp at the camera: the light on a surface falls off with the range.

J is lit by L(r) = (tau + r_bar^2) / (tau + r^2) in linear light, 1 at the scene's median range r_bar. A large tau is
daylight; between the two it stands for a mixture of both.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..water.light import relit


@dataclass
class Lamp:
    """log_tau (): log of tau over the squared median range; unit_range: the scene's median range, scene units."""

    log_tau: Tensor
    unit_range: float

    @classmethod
    def starting(cls, unit_range: float, tau: float) -> "Lamp":
        """From tau in squared scene units."""
        return cls(torch.tensor(tau / unit_range**2).log(), unit_range)

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor of what is learned."""
        return {"log_tau": self.log_tau}

    @property
    def tau(self) -> float:
        """In squared scene units."""
        return float(self.log_tau.detach().exp()) * self.unit_range**2

    def light(self, ranges: Tensor) -> Tensor:
        """The factor on linear light at ranges of any shape, scene units; differentiable in both."""
        tau = self.log_tau.clamp(-12.0, 12.0).exp()
        return (tau + 1) / (tau + (ranges / self.unit_range).square())


def lit(colors: Tensor, ranges: Tensor, lamp: Lamp, amount: float = 1.0) -> Tensor:
    """Display colours (N, 3) of Gaussians at ranges (N,) in the lamp's light, from those at the median range.

    amount: 0 (even light) to 1, the exponent of the fall-off.
    """
    return relit(colors, amount * lamp.light(ranges).log()[:, None])
