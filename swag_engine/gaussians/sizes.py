"""Least and largest size of Gaussians.

Thinner ones than any training image could show look like needles from nearer. Huge ones under a surface are drawn over
it in other views: Gaussians are sorted by the depth of their centres, which says little of one that is as large as the
view.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..scene.cameras import Camera
from .cloud import GaussianCloud

LEAST_VARIANCE = 0.1
"""Least variance of a Gaussian along each axis, squared pixels of the training image that samples it most finely: half
that of the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, arXiv 2311.16493), which costs quality at the training
width (benchmarks/zoom.py)."""
LARGEST = 0.5
"""Largest standard deviation of a Gaussian along each axis, as a fraction of its distance from the nearest camera
(benchmarks/largest_size.py)."""
MARGIN = 0.15
"""Fraction of an image's size beyond its edges in which a Gaussian still counts as seen (Mip-Splatting)."""
NEAREST = 0.01
"""Least depth that counts as in front of a camera, and least distance from cameras, median ranges."""


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
def nearest_distances(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Compute the distance (N,) of each centre (N, 3) from the nearest camera, scene units."""
    nearest = means.new_full((len(means),), math.inf)
    for camera in cameras:
        nearest = torch.minimum(nearest, (means - torch.from_numpy(camera.centre).to(means)).norm(dim=1))
    return nearest


@torch.no_grad()
def enforce_sizes(cloud: GaussianCloud, cameras: Sequence[Camera], median_range: float) -> None:
    """Enlarge the axes of Gaussians that are thinner than LEAST_VARIANCE allows, reduce those that exceed LARGEST.

    Args:
        cloud: The Gaussians; their `log_scales` are changed in place.
        cameras: Cameras of the training images.
        median_range: Median range of the scene, scene units.
    """
    distances = nearest_distances(cloud.means, cameras).clamp(min=NEAREST * median_range)
    scales = torch.minimum(cloud.log_scales, (LARGEST * distances).log()[:, None])
    rates = sampling_rates(cloud.means, cameras, median_range)
    least = 0.5 * math.log(LEAST_VARIANCE) - rates.log()
    cloud.log_scales.copy_(torch.where((rates > 0)[:, None], torch.maximum(scales, least[:, None]), scales))
