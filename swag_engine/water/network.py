"""The water of SWAGSplatting as written: a network of direction and range in place of coefficients.

A Gaussian of display color J, seen at the range r in the direction d, is seen as J T(d, r) + B(d, r), with the
transmission T and the backscatter B, each (R, G, B) in 0..1, from one network. Nothing makes T fall with range, or B
increase, but the loss that `range_consistency` computes. water/medium.py has the model that does.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

LAYERS = (70, 128, 64, 32, 16, 8)
"""Inputs and widths of the hidden layers, as published."""
HEADS = 6
"""Outputs: logits of the transmission and of the backscatter, three each."""
DIRECTION_FREQUENCIES = 10
"""Frequencies of the direction's encoding: 3 + 3 x 2 x 10 = 63 inputs."""
RANGE_FREQUENCIES = 3
"""Frequencies of the range's encoding: 1 + 2 x 3 = 7 inputs."""
SIZES = [*zip(LAYERS[:-1], LAYERS[1:], strict=True), (LAYERS[-1], HEADS)]
"""Inputs and outputs of every layer."""
INITIAL_T = 0.9
"""Initial transmission in all directions and at all ranges: a little water everywhere."""
INITIAL_B = 0.05
"""Initial backscatter in all directions and at all ranges, display value."""
INITIAL_BETA_D = (0.5, 0.25, 0.2)
"""Initial beta_D times the median range, (R, G, B); as in water/medium.py."""
INITIAL_BETA_B = (0.3, 0.3, 0.3)
"""Initial beta_B times the median range, (R, G, B); as in water/medium.py."""
PRELU_SLOPE = 0.25
"""Initial slope of the PReLU for negative inputs: the default of He et al. (arXiv 1502.01852)."""


@dataclass
class WaterNetwork:
    """Parameters of the water, all tensors of one dtype.

    Attributes:
        weights: (P,) of every layer its matrix (out, in), bias (out,) and PReLU slope, which the heads have not, one
            after the other.
        attenuation: (3,) raw; the beta_D that `range_consistency` compares with is softplus(raw) / unit_range, per
            scene unit.
        backscatter: (3,) raw, the same for beta_B.
        unit_range: Median range of the scene, scene units.
    """

    weights: Tensor
    attenuation: Tensor
    backscatter: Tensor
    unit_range: float

    @classmethod
    def starting(cls, unit_range: float, seed: int) -> "WaterNetwork":
        """Make a network with initial weights after He et al. (arXiv 1502.01852): a little water everywhere.

        Args:
            unit_range: Median range of the scene, scene units.
            seed: Seed of the random weights.

        Returns:
            The network.
        """
        random = torch.Generator().manual_seed(seed)
        parts = []
        for inputs, outputs in SIZES[:-1]:
            matrix = torch.randn(outputs, inputs, generator=random) * math.sqrt(2 / ((1 + PRELU_SLOPE**2) * inputs))
            parts += [matrix.reshape(-1), torch.zeros(outputs), torch.tensor([PRELU_SLOPE])]
        heads = 0.1 * torch.randn(HEADS, LAYERS[-1], generator=random) / math.sqrt(LAYERS[-1])
        parts += [heads.reshape(-1), torch.logit(torch.tensor([INITIAL_T] * 3 + [INITIAL_B] * 3))]
        coefficients = torch.tensor([INITIAL_BETA_D, INITIAL_BETA_B])
        attenuation, backscatter = torch.log(torch.expm1(coefficients))
        return cls(torch.cat(parts), attenuation, backscatter, unit_range)

    def to(self, device: torch.device) -> "WaterNetwork":
        """Return the network with its tensors on a device."""
        moved = {name: tensor.to(device) for name, tensor in self.parameters().items()}
        return WaterNetwork(**moved, unit_range=self.unit_range)

    def settings(self) -> dict[str, float]:
        """Return what a checkpoint needs beside the tensors."""
        return {"unit_range": self.unit_range}

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        return {"weights": self.weights, "attenuation": self.attenuation, "backscatter": self.backscatter}

    @property
    def beta_D(self) -> Tensor:
        """Attenuation (3,), 1 / scene unit."""
        return functional.softplus(self.attenuation) / self.unit_range

    @property
    def beta_B(self) -> Tensor:
        """Increase of the backscatter (3,), 1 / scene unit."""
        return functional.softplus(self.backscatter) / self.unit_range

    def logits(self, offsets: Tensor) -> Tensor:
        """Evaluate the network.

        Args:
            offsets: (N, 3) from the camera, scene units; there is a gradient by their length, the range, and none by
                their direction. Detach them to stop it.

        Returns:
            (N, 6) logits of transmission and backscatter.
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
        """Return the transmission (N, 3), in 0..1, at offsets (N, 3) from the camera, scene units."""
        return self.logits(offsets)[:, :3].sigmoid()

    def through(self, colors: Tensor, offsets: Tensor, amount: float = 1.0) -> Tensor:
        """Show colors through the water: J T^amount + amount B.

        Args:
            colors: (N, 3) display values without the water.
            offsets: (N, 3) from the camera, scene units, as in `logits`.
            amount: 0 (no water) to 1.

        Returns:
            (N, 3) display values, differentiable.
        """
        transmission, backscatter = self.logits(offsets).split(3, dim=1)
        # T = sigmoid(x) is exp(-softplus(-x)): no power of 0, whose gradient is not finite.
        return colors * torch.exp(-amount * functional.softplus(-transmission)) + amount * backscatter.sigmoid()

    def range_consistency(self, offsets: Tensor) -> Tensor:
        """Compute L_ca of SWAGSplatting: how far the ranges that T and B imply are from the true ranges r.

        mean |-log T / beta_D - r| + mean |-log(1 - B) / beta_B - r|, over Gaussians and channels.

        Args:
            offsets: (N, 3) from the camera to the Gaussians, scene units.

        Returns:
            The loss in median ranges, a scalar, differentiable.
        """
        transmission, backscatter = self.logits(offsets).split(3, dim=1)
        ranges = offsets.norm(dim=1, keepdim=True)
        range_by_T = functional.softplus(-transmission) / self.beta_D - ranges
        range_by_B = functional.softplus(backscatter) / self.beta_B - ranges
        return (range_by_T.abs().mean() + range_by_B.abs().mean()) / self.unit_range

    def to_json(self, metres_per_unit: float = 0.0) -> dict[str, Any]:
        """Return what a compositor can use, for water.json.

        Args:
            metres_per_unit: Scale of the scene; 0 where it has none.

        Returns:
            transmission and backscatter of display values at `ranges`, means over all directions; beta_D and beta_B,
            which `range_consistency` compares with and which are approximate. Lengths are in metres where the scene
            has a scale and in scene units otherwise: `per`.
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
    """Encode values by their frequencies: themselves, and sine and cosine of 2^k pi times them (NeRF).

    Args:
        values: (N, C) values.
        frequencies: Number of frequencies, k = 0, 1, ...

    Returns:
        (N, C + 2 C frequencies).
    """
    angles = torch.cat([values * (math.pi * 2**k) for k in range(frequencies)], dim=1)
    return torch.cat([values, angles.sin(), angles.cos()], dim=1)


def _rounded(values: Tensor) -> list[float]:
    return [round(value, 6) for value in values.tolist()]
