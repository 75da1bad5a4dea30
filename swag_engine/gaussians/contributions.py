"""Sum what each Gaussian adds to a view."""

import torch
from torch import Tensor

from ..rasterize.api import contributions
from ..scene.cameras import Camera
from .cloud import GaussianCloud

SUMMED_AT_ONCE = 16
"""Weight images that one pass takes: limits the memory of its sums."""


@torch.no_grad()
def contribution_sums(cloud: GaussianCloud, camera: Camera, images: Tensor, backend: str = "auto") -> Tensor:
    """Sum T alpha of each Gaussian over the pixels of a view, weighted by images.

    Args:
        cloud: The N Gaussians.
        camera: The view.
        images: (H, W, R) weights of the size of the view.
        backend: What computes, as in `kernels_for`.

    Returns:
        (N, R) sums.
    """
    viewmat, intrinsics = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    parts = [
        contributions(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.means.new_ones(len(cloud), 1), viewmat,
            intrinsics, camera.width, camera.height, cloud.means.new_zeros(1), part.contiguous(), backend=backend,
        ).weighted
        for part in images.split(SUMMED_AT_ONCE, dim=-1)
    ]  # fmt: skip
    return torch.cat(parts, 1)
