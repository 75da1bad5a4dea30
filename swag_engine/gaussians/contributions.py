"""Sum what each Gaussian adds to a view."""

import torch
from torch import Tensor

from ..rasterize.api import contributions
from ..scene.cameras import Camera
from .cloud import GaussianCloud

SUMMED_AT_ONCE = 16


@torch.no_grad()
def contribution_sums(cloud: GaussianCloud, camera: Camera, pictures: Tensor, backend: str = "auto") -> Tensor:
    """(N, R): what each Gaussian adds to the view, T alpha, summed over the pixels times each of pictures (H, W, R)."""
    viewmat, intrinsics = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    parts = [
        contributions(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.means.new_ones(len(cloud), 1), viewmat,
            intrinsics, camera.width, camera.height, cloud.means.new_zeros(1), part.contiguous(), backend=backend,
        ).weighted
        for part in pictures.split(SUMMED_AT_ONCE, dim=-1)
    ]  # fmt: skip
    return torch.cat(parts, 1)
