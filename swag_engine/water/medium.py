"""The water between camera and Gaussians: the revised underwater image formation model (Akkaynak and Treibitz 2018).

A Gaussian of colour J at the range r (Euclidean, scene units) in the direction d is seen as

    J exp(-beta_D r) + B(d) (1 - exp(-beta_B r))

and what no Gaussian covers as B(d): the water's colour where it is endless. Blending these equals the integral over the
water between the Gaussians (WaterSplatting's interval form) where the coefficients are constant along a ray.
The formula holds for light, so display values are taken to linear light and back (IEC 61966-2-1) unless a medium says
otherwise; blending works on display values as everywhere.
"""

from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from torch import Tensor

from ..gaussians.sh import sh_basis
from ..kernels.backends import kernels_for
from .light import relit, to_display, to_light

Light = Literal["linear", "srgb"]
MAX_DEGREE = 2
BRIGHTEST = 1.2  # display value


@dataclass
class Medium:
    """Parameters of the water, all tensors of one dtype.

    attenuation, backscatter (3,): raw; the coefficients are softplus(raw) / unit_range per scene unit, so that they
    stay positive and never lose their gradient. veil (9, 3): raw SH of degree 2; B = sigmoid(their sum).
    unit_range: the scene's median range. light: what the formula works on.

    backscatter None: beta_B is beta_D. veil None: water that only attenuates, B = 0.
    """

    attenuation: Tensor
    backscatter: Tensor | None
    veil: Tensor | None
    unit_range: float
    light: Light = "linear"

    @classmethod
    def starting(
        cls,
        unit_range: float,
        light: Light = "linear",
        beta_D: Tensor | None = None,
        beta_B: Tensor | None = None,
        B: Tensor | None = None,
    ) -> "Medium":
        """From coefficients (3,) per scene unit and B (3,) in 0..1 of `light`; METHOD's defaults for what is None."""
        first = [
            torch.tensor(default) if value is None else value.float() * unit_range
            for value, default in ((beta_D, (0.5, 0.25, 0.2)), (beta_B, (0.3, 0.3, 0.3)))
        ]
        veil = torch.zeros((MAX_DEGREE + 1) ** 2, 3)
        constant = sh_basis(torch.tensor([[0.0, 0.0, 1.0]]), 0)[0, 0]
        veil[0] = torch.logit((torch.full((3,), 0.2) if B is None else B.float()).clamp(1e-3, 1 - 1e-3)) / constant
        # The inverse of softplus, log(exp(x) - 1), without its overflow.
        first = [value.clamp(min=1e-3) for value in first]
        attenuation, backscatter = (value + torch.log(-torch.expm1(-value)) for value in first)
        return cls(attenuation, backscatter, veil, unit_range, light)

    def to(self, device: torch.device) -> "Medium":
        """The medium with its tensors on a device."""
        moved = {name: tensor.to(device) for name, tensor in self.parameters().items()}
        return Medium(**moved, unit_range=self.unit_range, light=self.light)

    def settings(self) -> dict[str, Any]:
        """Return what a checkpoint needs beside the tensors."""
        return {name: getattr(self, name) for name in SETTINGS}

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        named = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in SETTINGS}
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    @property
    def beta_D(self) -> Tensor:
        """(3,) attenuation per scene unit."""
        return torch.nn.functional.softplus(self.attenuation) / self.unit_range

    @property
    def beta_B(self) -> Tensor:
        """(3,) growth of the backscatter per scene unit."""
        if self.backscatter is None:
            return self.beta_D
        return torch.nn.functional.softplus(self.backscatter) / self.unit_range

    def to_json(self, metres_per_unit: float = 0.0) -> dict[str, Any]:
        """What a compositor needs: beta_D and beta_B, B_inf in 0..1 of `light`, each (R, G, B).

        The coefficients are per metre where the scene has a scale (metres_per_unit > 0), else per scene unit: `per`.
        B_inf is without the change by direction; veil_sh (9, 3) has its raw SH coefficients, B = sigmoid(their sum).
        """
        scale = metres_per_unit or 1.0
        with torch.no_grad():
            veil = self.veil
            if veil is None:
                veil = self.attenuation.new_zeros((MAX_DEGREE + 1) ** 2, 3)
                veil[0] = NO_VEIL
            constant = (veil[0] * sh_basis(torch.tensor([[0.0, 0.0, 1.0]]).to(veil), 0)[0, 0]).sigmoid()
            return {
                "beta_D": _rounded(self.beta_D / scale),
                "beta_B": _rounded(self.beta_B / scale),
                "B_inf": _rounded(constant),
                "veil_sh": [_rounded(row) for row in veil],
                "light": self.light,
                "per": "metre" if metres_per_unit else "unit",
            }

    def values(self) -> Tensor:
        """(33,) beta_D, beta_B and veil, as the kernels take them; of water that has a veil."""
        assert self.veil is not None
        return torch.cat([self.beta_D, self.beta_B, self.veil.reshape(-1)])


SETTINGS = ("unit_range", "light")
NO_VEIL = -100.0
"""Raw SH of degree 0 whose sigmoid is no light at all."""


def _rounded(values: Tensor) -> list[float]:
    return [round(value, 6) for value in values.tolist()]


def through_water(
    colors: Tensor,
    offsets: Tensor,
    medium: Medium,
    degree: int = MAX_DEGREE,
    amount: float = 1.0,
    backend: str = "auto",
) -> Tensor:
    """Display colours (N, 3) as seen through the water, from those without it; differentiable.

    offsets (N, 3): from the camera to the Gaussians, scene units; detach them to stop the gradient of the range (there
    is none of the direction). degree: SH of B that count, 0 to 2. amount: 0 (no water) to 1, scales coefficients and B.
    """
    linear = medium.light == "linear"
    if medium.veil is None:
        depth = amount * medium.beta_D * offsets.norm(dim=1, keepdim=True)
        return relit(colors, -depth, backend) if linear else colors * torch.exp(-depth)
    values = medium.values()
    kernels = kernels_for(backend, colors)
    if kernels and amount == 1:
        return kernels.through_water(colors, offsets, values, degree, linear)
    ranges = offsets.norm(dim=1, keepdim=True)
    directions = (offsets / ranges.clamp(min=torch.finfo(offsets.dtype).tiny)).detach()
    J = to_light(colors) if linear else colors
    veil = amount * _veil(directions, values, degree)
    light = J * torch.exp(-amount * values[:3] * ranges) - veil * torch.expm1(-amount * values[3:6] * ranges)
    return to_display(light) if linear else light


@torch.no_grad()
def without_water(seen: Tensor, ranges: Tensor, medium: Medium) -> Tensor:
    """Display colours (N, 3) without the water, from those seen at ranges (N,) through it; at most BRIGHTEST.

    The inverse of through_water with B of degree 0, for starting values: what the water has drowned stays dark.
    """
    r = ranges[:, None]
    B = torch.zeros_like(seen[:1]) if medium.veil is None else _veil(torch.zeros_like(seen[:1]), medium.values(), 0)
    light = to_light(seen) if medium.light == "linear" else seen
    J = (light + B * torch.expm1(-medium.beta_B * r)).clamp(min=0) * torch.exp((medium.beta_D * r).clamp(max=80.0))
    return (to_display(J) if medium.light == "linear" else J).clamp(max=BRIGHTEST)


def open_water(
    medium: Medium,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    degree: int = MAX_DEGREE,
    amount: float = 1.0,
    backend: str = "auto",
) -> Tensor:
    """Display colour (height, width, 3) of endless water in each pixel's direction; differentiable in the medium.

    viewmat (4, 4) world to camera, K (3, 3) px; degree and amount as in through_water.
    """
    values, linear = medium.values(), medium.light == "linear"
    kernels = kernels_for(backend, values)
    if kernels and amount == 1:
        return kernels.open_water(values, viewmat, K, width, height, degree, linear)
    x = (torch.arange(width).to(values) + 0.5 - K[0, 2]) / K[0, 0]
    y = (torch.arange(height).to(values) + 0.5 - K[1, 2]) / K[1, 1]
    rays = torch.stack([x.expand(height, -1), y[:, None].expand(-1, width), torch.ones_like(x).expand(height, -1)], -1)
    directions = torch.nn.functional.normalize(rays @ viewmat[:3, :3], dim=-1)
    veil = amount * _veil(directions.reshape(-1, 3), values, degree).reshape(height, width, 3)
    return to_display(veil) if linear else veil


def _veil(directions: Tensor, values: Tensor, degree: int) -> Tensor:
    """B (N, 3) in the medium's light, for unit directions (N, 3)."""
    return (sh_basis(directions, degree) @ values[6:].reshape(-1, 3)[: (degree + 1) ** 2]).sigmoid()
