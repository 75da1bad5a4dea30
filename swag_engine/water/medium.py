"""The water between camera and Gaussians: the revised underwater image formation model (Akkaynak and Treibitz 2018).

A Gaussian of color J at the range r (Euclidean, scene units) in the direction d is seen as

    J exp(-beta_D r) + B(d) (1 - exp(-beta_B r))

and a pixel where no Gaussian is shows B(d), the background light of open water. Blending these equals the integral over
the water between the Gaussians (WaterSplatting's interval form, arXiv 2408.08206) where the coefficients are constant
along a ray. The formula holds for light, so display values are converted to linear light and back (IEC 61966-2-1)
unless a medium says otherwise; blending works on display values as everywhere. docs/method.md, section 1.
"""

from copy import copy
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from torch import Tensor

from ..formats.water import NO_BACKGROUND_LIGHT
from ..kernels.backends import kernels_for
from ..kernels.reference.harmonics import C0
from ..kernels.reference.kernels import background_light
from ..kernels.reference.transfer import to_display, to_light
from .light import apply_gain

Light = Literal["linear", "srgb"]
"""What the formula works on: linear light or display values."""
MAX_DEGREE = 2
"""Highest SH degree of the background light."""
SH_COUNT = (MAX_DEGREE + 1) ** 2
"""SH coefficients of the background light per color channel."""
INITIAL_BETA_D = (0.5, 0.25, 0.2)
"""Initial beta_D times the median range, (R, G, B): red is absorbed first, as in clear natural water."""
INITIAL_BETA_B = (0.3, 0.3, 0.3)
"""Initial beta_B times the median range, (R, G, B)."""
INITIAL_B = 0.2
"""Initial background light of each channel, in 0..1 of the medium's light."""
BRIGHTEST = 1.2
"""Largest display value of a color without water: exp(beta_D r) multiplies noise in far colors."""
SETTINGS = ("unit_range", "light")
"""Fields of a medium that are not learned."""


@dataclass
class Medium:
    """Parameters of the water, all tensors of one dtype.

    Attributes:
        attenuation: (3,) raw; beta_D = softplus(attenuation) / unit_range per scene unit, so that it stays positive
            and never loses its gradient.
        backscatter: (3,) raw, the same for beta_B; None where beta_B is beta_D.
        background_sh: (9, 3) raw SH coefficients of degree 2 of the background light, B = sigmoid(their sum); None for
            water that only attenuates, B = 0.
        unit_range: Median range of the scene, scene units.
        light: What the formula works on.
    """

    attenuation: Tensor
    backscatter: Tensor | None
    background_sh: Tensor | None
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
        """Make a medium of known coefficients, with initial values for those that are None.

        Args:
            unit_range: Median range of the scene, scene units.
            light: What the formula works on.
            beta_D: (3,) attenuation, 1 / scene unit.
            beta_B: (3,) increase of the backscatter, 1 / scene unit.
            B: (3,) background light in 0..1 of `light`, the same in all directions.

        Returns:
            The medium.
        """
        scaled = [
            torch.tensor(default) if value is None else value.float() * unit_range
            for value, default in ((beta_D, INITIAL_BETA_D), (beta_B, INITIAL_BETA_B))
        ]
        background_sh = torch.zeros(SH_COUNT, 3)
        background_sh[0] = (
            torch.logit((torch.full((3,), INITIAL_B) if B is None else B.float()).clamp(1e-3, 1 - 1e-3)) / C0
        )
        # The inverse of softplus, log(exp(x) - 1), without its overflow.
        scaled = [value.clamp(min=1e-3) for value in scaled]
        attenuation, backscatter = (value + torch.log(-torch.expm1(-value)) for value in scaled)
        return cls(attenuation, backscatter, background_sh, unit_range, light)

    def to(self, device: torch.device) -> "Medium":
        """Return the medium with its tensors on a device."""
        moved = copy(self)
        for name, tensor in self.parameters().items():
            setattr(moved, name, tensor.to(device))
        return moved

    def settings(self) -> dict[str, Any]:
        """Return what a checkpoint needs beside the tensors."""
        return {name: getattr(self, name) for name in SETTINGS}

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        named = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in SETTINGS}
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    @property
    def beta_D(self) -> Tensor:
        """Attenuation (3,), 1 / scene unit."""
        return torch.nn.functional.softplus(self.attenuation) / self.unit_range

    @property
    def beta_B(self) -> Tensor:
        """Increase of the backscatter (3,), 1 / scene unit."""
        if self.backscatter is None:
            return self.beta_D
        return torch.nn.functional.softplus(self.backscatter) / self.unit_range

    def to_json(self, metres_per_unit: float = 0.0) -> dict[str, Any]:
        """Return what a compositor needs, for water.json.

        Args:
            metres_per_unit: Scale of the scene; 0 where it has none.

        Returns:
            beta_D and beta_B, `per` metre where the scene has a scale and per scene unit otherwise; B_inf in 0..1 of
            `light`, without its change by direction; each (R, G, B). background_sh (9, 3): raw SH coefficients of the
            background light, B = sigmoid(their sum).
        """
        scale = metres_per_unit or 1.0
        with torch.no_grad():
            background_sh = self._raw_background_light
            return {
                "beta_D": _rounded(self.beta_D / scale),
                "beta_B": _rounded(self.beta_B / scale),
                "B_inf": _rounded((background_sh[0] * C0).sigmoid()),
                "background_sh": [_rounded(row) for row in background_sh],
                "light": self.light,
                "per": "metre" if metres_per_unit else "unit",
            }

    def coefficients(self) -> Tensor:
        """Return beta_D, beta_B and the raw SH of the background light, (33,)."""
        return torch.cat([self.beta_D, self.beta_B, self._raw_background_light.reshape(-1)])

    def background_light(self, directions: Tensor, degree: int = MAX_DEGREE) -> Tensor:
        """Return the background light (N, 3) of unit vectors (N, 3), in 0..1 of `light`; 0 without any."""
        return background_light(directions, self.coefficients(), degree)

    @property
    def _raw_background_light(self) -> Tensor:
        """`background_sh`, or values (9, 3) whose background light is 0."""
        if self.background_sh is not None:
            return self.background_sh
        none = self.attenuation.new_zeros(SH_COUNT, 3)
        none[0] = NO_BACKGROUND_LIGHT
        return none


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
    """Show colors through the water.

    Args:
        colors: (N, 3) display values without the water.
        offsets: (N, 3) from the camera to the Gaussians, scene units; there is a gradient by their length, the range,
            and none by their direction. Detach them to stop it.
        medium: The water.
        degree: SH degree of the background light that is used, 0..2.
        amount: Factor of the coefficients and of the background light, 0 (no water) to 1.
        backend: What computes, as in `kernels_for`.

    Returns:
        (N, 3) display values, differentiable.
    """
    linear = medium.light == "linear"
    if medium.background_sh is None:
        depth = amount * medium.beta_D * offsets.norm(dim=1, keepdim=True)
        return apply_gain(colors, -depth, backend) if linear else colors * torch.exp(-depth)
    kernels = kernels_for(backend, colors)
    return kernels.through_water(colors, offsets, medium.coefficients(), degree, linear, amount)


@torch.no_grad()
def without_water(seen: Tensor, ranges: Tensor, medium: Medium) -> Tensor:
    """Remove the water from colors, for initial values: the inverse of `through_water` with B of degree 0.

    Colors that the water has absorbed stay dark.

    Args:
        seen: (N, 3) display values through the water.
        ranges: (N,) scene units.
        medium: The water.

    Returns:
        (N, 3) display values, at most BRIGHTEST.
    """
    r = ranges[:, None]
    B = torch.zeros_like(seen[:1])
    if medium.background_sh is not None:
        B = medium.background_light(B, degree=0)
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
    """Render the background light of open water in each pixel's direction.

    Args:
        medium: The water; it has a background light.
        viewmat: (4, 4) world to camera.
        K: (3, 3) intrinsics, pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        degree: SH degree of the background light that is used, 0..2.
        amount: Factor of the background light, 0 (no water) to 1.
        backend: What computes, as in `kernels_for`.

    Returns:
        (height, width, 3) display values, differentiable in the medium.
    """
    coefficients = medium.coefficients()
    kernels = kernels_for(backend, coefficients)
    return kernels.open_water(coefficients, viewmat, K, width, height, degree, medium.light == "linear", amount)
