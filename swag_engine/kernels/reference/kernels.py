"""The backend in plain torch: slow, for any floating dtype and device, differentiable as often as torch is."""

from typing import Any

import torch
from torch import Tensor

from ...base.camera_kind import CameraKind
from ..protocol import Projection
from .blending import blend, contributions
from .harmonics import sh_basis
from .projection import project
from .similarity import ssim_map
from .transfer import to_display, to_light


class TorchKernels:
    """The backend "torch": the definition of every operation, and the last resort where no native one can run."""

    def unavailable_reason(self) -> str | None:
        """Return None: torch is always there."""
        return None

    def can_run(self, *tensors: Tensor) -> bool:
        """Return True: torch takes every tensor."""
        return True

    def device(self) -> torch.device:
        """Return torch's accelerator where there is one, the CPU otherwise."""
        if torch.accelerator.is_available():
            return torch.accelerator.current_accelerator() or torch.device("cpu")
        return torch.device("cpu")

    def details(self) -> dict[str, Any]:
        """Return the device that a run uses."""
        return {"device": str(self.device())}

    def project(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        channels: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        kind: CameraKind = "perspective",
    ) -> Projection:
        """See `Kernels.project`."""
        return project(means, quats, scales, opacities, channels, viewmat, K, width, height, kind)

    def blend(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """See `Kernels.blend`."""
        return blend(projected, opacities, channels, background, width, height)

    def contributions(
        self,
        projected: Projection,
        opacities: Tensor,
        channels: Tensor,
        background: Tensor,
        width: int,
        height: int,
        weights: Tensor,
        image_gradient: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `Kernels.contributions`; any number of channels."""
        return contributions(projected, opacities, channels, background, width, height, weights, image_gradient)

    def sh_colors(self, sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
        """See `Kernels.sh_colors`; differentiable in the directions, too."""
        basis = sh_basis(directions, degree)
        sh = torch.cat([sh0, shN[:, : basis.shape[1] - 1]], 1)
        return (0.5 + (basis[:, :, None] * sh).sum(1)).clamp(min=0)

    def apply_gain(self, display: Tensor, log_gain: Tensor) -> Tensor:
        """See `Kernels.apply_gain`."""
        return to_display(to_light(display) * log_gain.exp())

    def through_water(
        self, colors: Tensor, offsets: Tensor, coefficients: Tensor, degree: int, linear: bool, amount: float
    ) -> Tensor:
        """See `Kernels.through_water`."""
        ranges = offsets.norm(dim=1, keepdim=True)
        directions = (offsets / ranges.clamp(min=torch.finfo(offsets.dtype).tiny)).detach()
        J = to_light(colors) if linear else colors
        B = amount * background_light(directions, coefficients, degree)
        light = J * torch.exp(-amount * coefficients[:3] * ranges) - B * torch.expm1(
            -amount * coefficients[3:6] * ranges
        )
        return to_display(light) if linear else light

    def open_water(
        self,
        coefficients: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        degree: int,
        linear: bool,
        amount: float,
    ) -> Tensor:
        """See `Kernels.open_water`."""
        x = (torch.arange(width).to(coefficients) + 0.5 - K[0, 2]) / K[0, 0]
        y = (torch.arange(height).to(coefficients) + 0.5 - K[1, 2]) / K[1, 1]
        ones = torch.ones_like(x).expand(height, -1)
        rays = torch.stack([x.expand(height, -1), y[:, None].expand(-1, width), ones], -1)
        directions = torch.nn.functional.normalize(rays @ viewmat[:3, :3], dim=-1)
        B = amount * background_light(directions.reshape(-1, 3), coefficients, degree).reshape(height, width, 3)
        return to_display(B) if linear else B

    def l1_ssim(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """See `Kernels.l1_ssim`."""
        return (image - target).abs().mean(), ssim_map(image, target).mean()

    def adam_step(
        self,
        parameter: Tensor,
        gradient: Tensor,
        exp_avg: Tensor,
        exp_avg_sq: Tensor,
        rate: float,
        beta1: float,
        beta2: float,
        eps: float,
        step: int,
    ) -> None:
        """See `Kernels.adam_step`."""
        exp_avg.lerp_(gradient, 1 - beta1)
        exp_avg_sq.lerp_(gradient * gradient, 1 - beta2)
        root = (exp_avg_sq / (1 - beta2**step)).sqrt() + eps
        parameter.sub_(rate / (1 - beta1**step) * exp_avg / root)


REFERENCE = TorchKernels()
"""Computes what a native backend cannot: gradients by the camera or by directions, and part of the water."""


def background_light(directions: Tensor, coefficients: Tensor, degree: int) -> Tensor:
    """Evaluate the background light of a medium.

    Args:
        directions: (N, 3) unit vectors.
        coefficients: (33,) as in `Kernels.through_water`.
        degree: SH degree that is used, 0..2.

    Returns:
        (N, 3) values in 0..1 of what the medium's formula works on.
    """
    return (sh_basis(directions, degree) @ coefficients[6:].reshape(-1, 3)[: (degree + 1) ** 2]).sigmoid()
