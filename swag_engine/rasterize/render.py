"""A picture of a cloud of Gaussians through a camera."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..scene.cameras import Camera
from ..water.medium import MAX_DEGREE, Medium, open_water, through_water
from .api import Rendering, rasterize


@dataclass
class Picture:
    """color (H, W, 3) display values; alpha (H, W) in 0..1; range (H, W) Euclidean distance to the camera in scene
    units, alpha-weighted and normalised, 0 where alpha is 0 (None unless asked for); rendering: what made it."""

    color: Tensor
    alpha: Tensor
    range: Tensor | None
    rendering: Rendering


def render(
    cloud: GaussianCloud,
    camera: Camera,
    sh_degree: int = 3,
    medium: Medium | None = None,
    water_degree: int = MAX_DEGREE,
    amount: float = 1.0,
    with_range: bool = False,
    backend: str = "auto",
) -> Picture:
    """Rasterise `cloud` as `camera` sees it, in the cloud's dtype; differentiable.

    medium: the water in front of the cloud, and behind it in place of the cloud's background; water_degree and amount
    as in water.medium.through_water. No gradient flows from colour to position through the range: it would push
    Gaussians along rays to correct their colours.
    """
    centre, viewmat, intrinsics = (
        torch.from_numpy(array).to(cloud.means) for array in (camera.centre, camera.world_to_camera, camera.K)
    )
    channels = cloud.colors(centre, sh_degree, backend)
    background = cloud.background.sigmoid()
    if medium is not None:
        offsets = cloud.means.detach() - centre
        channels = through_water(channels, offsets, medium, water_degree, amount, backend)
        background = torch.zeros_like(background)
    if with_range:
        channels = torch.cat([channels, (cloud.means - centre).norm(dim=-1, keepdim=True)], dim=-1)
        background = torch.cat([background, background.new_zeros(1)])
    rendering = rasterize(
        cloud.means,
        cloud.quats,
        cloud.scales,
        cloud.opacities,
        channels,
        viewmat,
        intrinsics,
        camera.width,
        camera.height,
        background,
        backend,
    )
    color, seen = rendering.channels[..., :3], None
    if medium is not None and amount > 0:
        behind = open_water(medium, viewmat, intrinsics, camera.width, camera.height, water_degree, amount, backend)
        color = color + (1 - rendering.alpha[..., None]) * behind
    if with_range:
        # The denominator is chosen before dividing: 0/0 behind a mask is NaN in the backward pass.
        covered = torch.where(rendering.alpha > 0, rendering.alpha, torch.ones_like(rendering.alpha))
        seen = rendering.channels[..., 3] / covered
    return Picture(color, rendering.alpha, seen, rendering)
