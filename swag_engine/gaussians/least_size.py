"""Least size of Gaussians: what no training image could show is not kept, so that nearer views show no thin needles."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..scene.cameras import Camera
from .cloud import GaussianCloud

LEAST_VARIANCE = 0.1
"""Least variance of a Gaussian along each axis, squared pixels of the training image that samples it most finely: half
that of the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, arXiv 2311.16493), which costs quality at the training
width (benchmarks/zoom.py)."""
MARGIN = 0.15
"""Fraction of an image's size beyond its edges in which a Gaussian still counts as seen (Mip-Splatting)."""
NEAREST = 0.01
"""Least depth that counts as in front of a camera, median ranges."""


@torch.no_grad()
def sampling_rates(means: Tensor, cameras: Sequence[Camera], median_range: float) -> Tensor:
    """Compute how finely the images sample the scene at each Gaussian.

    Args:
        means: (N, 3) centres, scene units.
        cameras: Cameras of the training images.
        median_range: Median range of the scene, scene units.

    Returns:
        (N,) the highest number of pixels per scene unit over the images that see the Gaussian, occluded or not; 0 where
        none does.
    """
    rates = means.new_zeros(len(means))
    for camera in cameras:
        pose = torch.from_numpy(camera.world_to_camera).to(means)
        x, y, z = torch.addmm(pose[:3, 3], means, pose[:3, :3].T).unbind(-1)
        depth = torch.ones_like(z) if camera.kind == "orthographic" else z
        focal = max(camera.fx, camera.fy)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        seen = z > NEAREST * median_range
        for position, size in ((u, camera.width), (v, camera.height)):
            seen &= (position > -MARGIN * size) & (position < (1 + MARGIN) * size)
        rates = torch.maximum(rates, torch.where(seen, focal / depth, 0.0))
    return rates


@torch.no_grad()
def enforce_least_size(cloud: GaussianCloud, cameras: Sequence[Camera], median_range: float) -> None:
    """Enlarge the axes of Gaussians that are thinner than LEAST_VARIANCE allows.

    Args:
        cloud: The Gaussians; their `log_scales` are changed in place.
        cameras: Cameras of the training images.
        median_range: Median range of the scene, scene units.
    """
    rates = sampling_rates(cloud.means, cameras, median_range)
    least = 0.5 * torch.log(torch.full_like(rates, LEAST_VARIANCE)) - rates.log()
    seen = rates > 0
    enlarged = torch.maximum(cloud.log_scales, least[:, None])
    cloud.log_scales.copy_(torch.where(seen[:, None], enlarged, cloud.log_scales))
