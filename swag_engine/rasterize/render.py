"""A picture of a cloud of Gaussians through a camera."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..scene.cameras import Camera
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
    cloud: GaussianCloud, camera: Camera, sh_degree: int = 3, with_range: bool = False, backend: str = "auto"
) -> Picture:
    """Rasterise `cloud` as `camera` sees it, in the cloud's dtype; differentiable."""
    centre, viewmat, intrinsics = (
        torch.from_numpy(array).to(cloud.means) for array in (camera.centre, camera.world_to_camera, camera.K)
    )
    channels = cloud.colors(centre, sh_degree)
    background = cloud.background.sigmoid()
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
    seen = None
    if with_range:
        # The denominator is chosen before dividing: 0/0 behind a mask is NaN in the backward pass.
        covered = torch.where(rendering.alpha > 0, rendering.alpha, torch.ones_like(rendering.alpha))
        seen = rendering.channels[..., 3] / covered
    return Picture(rendering.channels[..., :3], rendering.alpha, seen, rendering)
