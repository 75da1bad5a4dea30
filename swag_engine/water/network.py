"""The water of SWAGSplatting as written: a network of direction and range in place of coefficients.

A Gaussian of display colour J, seen at the range r in the direction d, is seen as J T(d, r) + B(d, r), with the
transmission T and the backscatter B, each (R, G, B) in 0..1, from one network. Nothing makes T fall with range, or B
grow, but the loss that range_consistency() is. water/medium.py has the model that does.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

LAYERS = (70, 128, 64, 32, 16, 8)
HEADS = 6  # logits of the transmission and of the backscatter, three each
DIRECTION_FREQUENCIES = 10  # 3 + 3 x 2 x 10 = 63 values
RANGE_FREQUENCIES = 3  # 1 + 2 x 3 = 7 values
SIZES = [*zip(LAYERS[:-1], LAYERS[1:], strict=True), (LAYERS[-1], HEADS)]
STARTING_T, STARTING_B = 0.9, 0.05


@dataclass
class WaterNetwork:
    """Parameters of the water, all tensors of one dtype.

    weights (P,): of every layer its matrix (out, in), bias (out,) and PReLU slope, which the heads have not, one
    after the other. attenuation, backscatter (3,): raw; the coefficients that range_consistency() compares with are
    softplus(raw) / unit_range per scene unit. unit_range: the scene's median range.
    """

    weights: Tensor
    attenuation: Tensor
    backscatter: Tensor
    unit_range: float

    @classmethod
    def starting(cls, unit_range: float, seed: int) -> "WaterNetwork":
        """Weights after He et al. (arXiv 1502.01852), seeded; heads that begin as a little water everywhere."""
        random = torch.Generator().manual_seed(seed)
        parts = []
        for inputs, outputs in SIZES[:-1]:
            matrix = torch.randn(outputs, inputs, generator=random) * math.sqrt(2 / ((1 + 0.25**2) * inputs))
            parts += [matrix.reshape(-1), torch.zeros(outputs), torch.tensor([0.25])]
        heads = 0.1 * torch.randn(HEADS, LAYERS[-1], generator=random) / math.sqrt(LAYERS[-1])
        parts += [heads.reshape(-1), torch.logit(torch.tensor([STARTING_T] * 3 + [STARTING_B] * 3))]
        coefficients = torch.tensor([[0.5, 0.25, 0.2], [0.3, 0.3, 0.3]])
        attenuation, backscatter = torch.log(torch.expm1(coefficients))
        return cls(torch.cat(parts), attenuation, backscatter, unit_range)

    def to(self, device: torch.device) -> "WaterNetwork":
        """The network with its tensors on a device."""
        moved = {name: tensor.to(device) for name, tensor in self.parameters().items()}
        return WaterNetwork(**moved, unit_range=self.unit_range)

    def settings(self) -> dict[str, float]:
        """Return what a checkpoint needs beside the tensors."""
        return {"unit_range": self.unit_range}

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor of what is learned."""
        return {"weights": self.weights, "attenuation": self.attenuation, "backscatter": self.backscatter}

    @property
    def beta_D(self) -> Tensor:
        """(3,) attenuation per scene unit."""
        return functional.softplus(self.attenuation) / self.unit_range

    @property
    def beta_B(self) -> Tensor:
        """(3,) growth of the backscatter per scene unit."""
        return functional.softplus(self.backscatter) / self.unit_range

    def logits(self, offsets: Tensor) -> Tensor:
        """(N, 6) logits of transmission and backscatter at offsets (N, 3) from the camera, in scene units.

        There is a gradient of the range, and none of the direction; detach the offsets to stop the former.
        """
        ranges = offsets.norm(dim=1, keepdim=True)
        directions = (offsets / ranges.clamp(min=torch.finfo(offsets.dtype).tiny)).detach()
        x = torch.cat(
            [encoded(directions, DIRECTION_FREQUENCIES), encoded(ranges / self.unit_range, RANGE_FREQUENCIES)], dim=1
        )
        start = 0
        for inputs, outputs in SIZES:
            end = start + outputs * inputs
            x = functional.linear(x, self.weights[start:end].view(outputs, inputs), self.weights[end : end + outputs])
            start = end + outputs
            if outputs != HEADS:
                x = functional.prelu(x, self.weights[start : start + 1])
                start += 1
        return x

    def transmission(self, offsets: Tensor) -> Tensor:
        """(N, 3) in 0..1 at offsets (N, 3) from the camera."""
        return self.logits(offsets)[:, :3].sigmoid()

    def through(self, colors: Tensor, offsets: Tensor, amount: float = 1.0) -> Tensor:
        """Display colours (N, 3) as seen through the water, from those without it; differentiable.

        offsets as in logits(). amount: 0 (no water) to 1: J T^amount + amount B.
        """
        transmission, backscatter = self.logits(offsets).split(3, dim=1)
        # T = sigmoid(x) is exp(-softplus(-x)): no power of 0, whose gradient is not finite.
        return colors * torch.exp(-amount * functional.softplus(-transmission)) + amount * backscatter.sigmoid()

    def range_consistency(self, offsets: Tensor) -> Tensor:
        """L_ca: how far the ranges that T and B imply are from the true ones, in median ranges; differentiable.

        mean |-log T / beta_D - r| + mean |-log(1 - B) / beta_B - r|, over Gaussians at offsets (N, 3) and channels.
        """
        transmission, backscatter = self.logits(offsets).split(3, dim=1)
        ranges = offsets.norm(dim=1, keepdim=True)
        by_loss = functional.softplus(-transmission) / self.beta_D - ranges
        by_gain = functional.softplus(backscatter) / self.beta_B - ranges
        return (by_loss.abs().mean() + by_gain.abs().mean()) / self.unit_range

    def to_json(self, metres_per_unit: float = 0.0) -> dict[str, Any]:
        """What a compositor can use: T and B of display values by range, means over all directions.

        Lengths are in metres where the scene has a scale (metres_per_unit > 0), else in scene units: `per`. beta_D and
        beta_B are what range_consistency() compares with, and approximate.
        """
        scale = metres_per_unit or 1.0
        with torch.no_grad():
            ranges = self.unit_range * torch.arange(0, 3.25, 0.25).to(self.weights)
            random = torch.Generator().manual_seed(0)
            directions = functional.normalize(torch.randn(512, 3, generator=random), dim=1).to(self.weights)
            seen = torch.stack([self.logits(r * directions).sigmoid().mean(dim=0) for r in ranges])
            return {
                "beta_D": _rounded(self.beta_D / scale),
                "beta_B": _rounded(self.beta_B / scale),
                "ranges": _rounded(ranges * scale),
                "transmission": [_rounded(row) for row in seen[:, :3]],
                "backscatter": [_rounded(row) for row in seen[:, 3:]],
                "light": "srgb",
                "per": "metre" if metres_per_unit else "unit",
            }


def encoded(values: Tensor, frequencies: int) -> Tensor:
    """(N, C + 2 C frequencies) of values (N, C): themselves, and sine and cosine of 2^k pi times them (NeRF)."""
    angles = torch.cat([values * (math.pi * 2**k) for k in range(frequencies)], dim=1)
    return torch.cat([values, angles.sin(), angles.cos()], dim=1)


def _rounded(values: Tensor) -> list[float]:
    return [round(value, 6) for value in values.tolist()]
