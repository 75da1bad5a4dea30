"""The parameters that are optimised, and their activations."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from math import isqrt

import numpy as np
import torch
from torch import Tensor

from ..splats.splats import Splats
from .sh import evaluate_sh

LOG_SCALE_LIMITS = (-20.0, 10.0)
"""Logarithms of the least and largest standard deviation, in scene units: keeps the exponential finite and above 0."""


@dataclass
class GaussianCloud:
    """N Gaussians and the color behind them, all float tensors of one dtype.

    Attributes:
        means: (N, 3) centres, scene units.
        quats: (N, 4) rotations wxyz, of any length.
        log_scales: (N, 3) logarithms of the standard deviations in scene units.
        opacity_logits: (N,) logits of the opacities.
        sh0: (N, 1, 3) raw spherical harmonics of degree 0 as in 3DGS (arXiv 2308.04079).
        shN: (N, K - 1, 3) those of higher degrees.
        background: (3,) logits of the display values seen where no Gaussian is.
        features: (N, 32) semantic features, which are not drawn; (N, 0) where the run learns none.
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

    @classmethod
    def from_splats(cls, splats: Splats, background: Sequence[float]) -> "GaussianCloud":
        """Convert splats of a file or of Blender.

        Args:
            splats: The splats.
            background: (3,) display values 0..1 seen where no Gaussian is.

        Returns:
            The Gaussians, float32.
        """
        sh = torch.from_numpy(splats.sh)
        return cls(
            means=torch.from_numpy(splats.positions),
            quats=torch.from_numpy(splats.rotations),
            log_scales=torch.from_numpy(splats.scales).log(),
            opacity_logits=torch.from_numpy(splats.opacities).logit(),
            sh0=sh[:, :1].contiguous(),
            shN=sh[:, 1:].contiguous(),
            background=torch.tensor(background, dtype=torch.float32).logit(),
        )

    def __len__(self) -> int:
        return self.means.shape[0]

    def parameters(self) -> dict[str, Tensor]:
        """Return all tensors by name, in the order of the fields."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def rows(self, chosen: slice | Tensor) -> "GaussianCloud":
        """Return some of the Gaussians, by a slice (views of the tensors), a mask (N,) or indices (M,)."""
        rows = {name: tensor[chosen] for name, tensor in self.parameters().items() if name != "background"}
        return GaussianCloud(**rows, background=self.background)

    def followed_by(self, last: "GaussianCloud") -> "GaussianCloud":
        """Return the Gaussians and others after them, with the background of these."""
        more = last.parameters()
        rows = {name: torch.cat([rows, more[name]]) for name, rows in self.parameters().items() if name != "background"}
        return GaussianCloud(**rows, background=self.background)

    def to(self, device: torch.device) -> "GaussianCloud":
        """Return the cloud with its tensors on a device."""
        return GaussianCloud(**{name: tensor.to(device) for name, tensor in self.parameters().items()})

    @property
    def scales(self) -> Tensor:
        """Standard deviations (N, 3), scene units."""
        return self.log_scales.clamp(*LOG_SCALE_LIMITS).exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities (N,) in 0..1."""
        return self.opacity_logits.sigmoid()

    def colors(self, camera_centre: Tensor, degree: int, backend: str = "auto") -> Tensor:
        """Evaluate the colors seen from a camera.

        No gradient flows from color to position through the direction: it is small, and would cost a pass.

        Args:
            camera_centre: (3,) world coordinates, scene units.
            degree: SH degree that is used, where the cloud has as many.
            backend: What computes, as in `kernels_for`.

        Returns:
            (N, 3) display values.
        """
        directions = torch.nn.functional.normalize(self.means.detach() - camera_centre, dim=-1)
        return self.colors_along(directions, degree, backend)

    def colors_along(self, directions: Tensor, degree: int, backend: str = "auto") -> Tensor:
        """Evaluate the colors seen in given directions.

        Args:
            directions: (N, 3) unit vectors from the camera to the Gaussians.
            degree: SH degree that is used, where the cloud has as many.
            backend: What computes, as in `kernels_for`.

        Returns:
            (N, 3) display values.
        """
        degree = min(degree, isqrt(1 + self.shN.shape[1]) - 1)
        return evaluate_sh(self.sh0, self.shN, directions, degree, backend)

    def to_splats(self, sh_degree: int | None = None) -> Splats:
        """Convert the Gaussians to numpy arrays for files and Blender.

        Args:
            sh_degree: Highest SH degree that is kept; all by default.

        Returns:
            The Gaussians, float32.
        """
        with torch.no_grad():
            higher = self.shN if sh_degree is None else self.shN[:, : (sh_degree + 1) ** 2 - 1]
            sh = torch.cat([self.sh0, higher], dim=1)
            quats = torch.nn.functional.normalize(self.quats, dim=-1)
            return Splats(
                to_numpy(self.means), to_numpy(quats), to_numpy(self.scales), to_numpy(self.opacities), to_numpy(sh)
            )


def to_numpy(tensor: Tensor) -> np.ndarray:
    """Return a float32 copy on the CPU."""
    return tensor.detach().float().cpu().numpy().copy()
