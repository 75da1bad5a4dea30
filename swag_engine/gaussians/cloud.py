"""The parameters that are optimised, and their activations."""

from dataclasses import dataclass, field, fields
from math import isqrt

import numpy as np
import torch
from torch import Tensor

from ..splats.splats import Splats
from .sh import evaluate_sh


@dataclass
class GaussianCloud:
    """N Gaussians and the colour behind them, all float tensors of one dtype.

    means (N, 3) in scene units; quats (N, 4) wxyz, any length; log_scales (N, 3) log of the standard deviation;
    opacity_logits (N,); sh0 (N, 1, 3) and shN (N, K - 1, 3) raw spherical harmonics as in 3DGS (arXiv 2308.04079);
    background (3,) logit of the colour seen where no Gaussian is; features (N, 32) say what the Gaussian is part of
    and are not drawn, (N, 0) where the run learns none.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh0: Tensor
    shN: Tensor
    background: Tensor
    features: Tensor = field(default_factory=lambda: torch.empty(0, 0))

    def __post_init__(self) -> None:
        if not self.features.numel():
            self.features = self.means.new_zeros(len(self), self.features.shape[1])

    def __len__(self) -> int:
        return self.means.shape[0]

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor, in the order of the fields."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def to(self, device: torch.device) -> "GaussianCloud":
        """The cloud with its tensors on a device."""
        return GaussianCloud(**{name: tensor.to(device) for name, tensor in self.parameters().items()})

    @property
    def scales(self) -> Tensor:
        """(N, 3) standard deviations in scene units."""
        return self.log_scales.clamp(-20.0, 10.0).exp()

    @property
    def opacities(self) -> Tensor:
        """(N,) in 0..1."""
        return self.opacity_logits.sigmoid()

    def colors(self, camera_centre: Tensor, degree: int, backend: str = "auto") -> Tensor:
        """(N, 3) display colours seen from `camera_centre` (3,), with SH up to `degree`.

        No gradient flows from colour to position through the direction: it is small, and would cost a pass.
        """
        directions = torch.nn.functional.normalize(self.means.detach() - camera_centre, dim=-1)
        degree = min(degree, isqrt(1 + self.shN.shape[1]) - 1)
        return evaluate_sh(self.sh0, self.shN, directions, degree, backend)

    def to_splats(self, sh_degree: int | None = None) -> Splats:
        """The Gaussians as numpy arrays for files and Blender; SH up to `sh_degree` (all by default)."""
        with torch.no_grad():
            higher = self.shN if sh_degree is None else self.shN[:, : (sh_degree + 1) ** 2 - 1]
            sh = torch.cat([self.sh0, higher], dim=1)
            quats = torch.nn.functional.normalize(self.quats, dim=-1)
            return Splats(
                to_numpy(self.means), to_numpy(quats), to_numpy(self.scales), to_numpy(self.opacities), to_numpy(sh)
            )


def to_numpy(tensor: Tensor) -> np.ndarray:
    """A float32 copy on the CPU."""
    return tensor.detach().float().cpu().numpy().copy()
