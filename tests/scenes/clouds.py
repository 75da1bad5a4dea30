"""Random clouds of Gaussians."""

import torch

from swag_engine.gaussians.cloud import GaussianCloud


def make_cloud(n: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> GaussianCloud:
    """Return n Gaussians of all shapes and opacities some 5 units in front of the origin, along +z; SH of degree 1."""
    draw = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=draw) * torch.tensor([1.0, 1.0, 0.3]) + torch.tensor([0.0, 0.0, 5.0])
    return GaussianCloud(
        means=means.to(dtype),
        quats=torch.randn(n, 4, generator=draw).to(dtype),
        log_scales=(torch.rand(n, 3, generator=draw) * 1.5 - 3).to(dtype),
        opacity_logits=torch.randn(n, generator=draw).to(dtype),
        sh0=torch.randn(n, 1, 3, generator=draw).to(dtype),
        shN=0.1 * torch.randn(n, 3, 3, generator=draw).to(dtype),
        background=torch.zeros(3, dtype=dtype),
    )
