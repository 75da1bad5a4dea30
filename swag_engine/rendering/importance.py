"""Importance and error of each Gaussian over all training views, which relocation sorts by."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from ..effects.lamp import Lamp, lit
from ..gaussians.cloud import GaussianCloud
from ..rasterize.api import contributions
from ..scene.cameras import Camera
from ..water.medium import MAX_DEGREE, Medium, through_water
from ..water.network import WaterNetwork
from .render import render

ENDLESS = 1e6
"""Factor on ranges from which nothing but water is seen."""


def scores(
    cloud: GaussianCloud,
    views: Iterable[tuple[Camera, Callable[[Tensor], Tensor]]],
    sh_degree: int = 3,
    medium: Medium | WaterNetwork | None = None,
    water_degree: int = MAX_DEGREE,
    backend: str = "auto",
    lamp: Lamp | None = None,
) -> tuple[Tensor, Tensor]:
    """Sum importance and error of each Gaussian over views (docs/method.md section 6).

    With a medium each view's sums are divided by `visibility` squared, so that dimmed structure is not lost first.

    Args:
        cloud: The Gaussians.
        views: Cameras, each with the loss (a scalar) of an image (H, W, 3) seen through it.
        sh_degree: Degree of the Gaussians' colors, 0..3.
        medium: The water, None without.
        water_degree: Degree of the background light, 0..2.
        backend: What renders.
        lamp: A lamp at the camera.

    Returns:
        Importance S (N,) and error E (N,), sums of rasterize.api.Contributions.
    """
    S, E = torch.zeros_like(cloud.opacity_logits), torch.zeros_like(cloud.opacity_logits)
    for camera, loss in views:
        with torch.no_grad():
            color = render(cloud, camera, sh_degree, medium, water_degree, backend=backend, lamp=lamp).color
        gradient = torch.autograd.grad(loss(color.requires_grad_()), color)[0]
        with torch.no_grad():
            centre, viewmat, K = (
                torch.from_numpy(array).to(cloud.means) for array in (camera.centre, camera.world_to_camera, camera.K)
            )
            offsets = cloud.means - centre
            colors, background = cloud.colors(centre, sh_degree, backend), cloud.background.sigmoid()
            if lamp is not None:
                colors = lit(colors, offsets.norm(dim=1), lamp)
            if isinstance(medium, Medium) and medium.background_sh is None:
                colors = through_water(colors, offsets, medium, water_degree, 1.0, backend)
            elif isinstance(medium, Medium):
                # The color of open water is nearly constant over one Gaussian: subtracted from both sides of the
                # formula, the colors are differences from it and nothing is behind.
                water = through_water(torch.zeros_like(colors), ENDLESS * offsets, medium, water_degree, 1.0, backend)
                colors = through_water(colors, offsets, medium, water_degree, 1.0, backend) - water
                background = torch.zeros_like(background)
            elif medium is not None:
                colors = medium.through(colors, offsets)
            seen = contributions(
                cloud.means,
                cloud.quats,
                cloud.scales,
                cloud.opacities,
                colors,
                viewmat,
                K,
                camera.width,
                camera.height,
                background,
                image_gradient=gradient,
                backend=backend,
            )
            dimmed = visibility(medium, offsets).square() if medium is not None else 1.0
            S += seen.importance / dimmed
            E += seen.error / dimmed
    return S, E


def visibility(medium: Medium | WaterNetwork, offsets: Tensor) -> Tensor:
    """Return the fraction of light that water lets through, by which far structure contributes less to an image.

    Args:
        medium: The water.
        offsets: (N, 3) from the camera to the Gaussians, scene units.

    Returns:
        (N,) mean transmission of the channels, at least .1.
    """
    if isinstance(medium, Medium):
        transmission = torch.exp(-medium.beta_D * offsets.norm(dim=1, keepdim=True))
    else:
        transmission = medium.transmission(offsets)
    return transmission.mean(dim=1).clamp(0.1, 1.0)
