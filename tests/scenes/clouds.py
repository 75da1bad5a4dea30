"""Random clouds of Gaussians."""

from typing import Any

import numpy as np
import torch

from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import Picture, render
from swag_engine.scene.cameras import Camera
from swag_engine.splats.splats import Splats


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


def random_splats(
    count: int, edge: list[float], log_scales: tuple[float, float], degree: int = 3, seed: int = 3
) -> Splats:
    """Return splats of every shape and color around the origin, with labels 0 to 3.

    Args:
        count: N.
        edge: Largest x, y and z.
        log_scales: Logs of the smallest and the largest scale.
        degree: SH degree of their colors.
        seed: Seed of the random numbers.
    """
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    sh = random.normal(size=(count, (degree + 1) ** 2, 3)) * 0.2
    sh[:, 0] = random.uniform(-1.2, 1.5, (count, 3))
    positions, scales = random.uniform(-1, 1, (count, 3)) * edge, np.exp(random.uniform(*log_scales, (count, 3)))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    columns = positions, rotations, scales, random.uniform(0.1, 1, count), sh
    positions, rotations, scales, opacities, sh = (column.astype(np.float32) for column in columns)
    label = random.integers(0, 4, count).astype(np.int32)
    return Splats(positions, rotations, scales, opacities, sh, {"label": label})


def draw_splats(splats: Splats, camera: Camera, **more: Any) -> Picture:
    """Render splats as the engine does; more arguments as of `render`."""
    names = ("positions", "rotations", "scales", "opacities", "sh")
    positions, rotations, scales, opacities, sh = (torch.from_numpy(getattr(splats, name)) for name in names)
    logits = torch.logit(opacities, 1e-6)
    cloud = GaussianCloud(positions, rotations, scales.log(), logits, sh[:, :1], sh[:, 1:], torch.full((3,), -30.0))
    return render(cloud, camera, **more)
