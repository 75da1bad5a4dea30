"""Least and largest size of Gaussians.

Thinner ones than any training image could show look like needles from nearer. Huge ones under a surface are drawn over
it in other views: Gaussians are sorted by the depth of their centres, which says little of one that is as large as the
view.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..scene.cameras import Camera
from .cloud import GaussianCloud

LEAST_VARIANCE = 0.1
"""Least variance of a Gaussian along each axis, squared pixels of the training image that samples it most finely: half
that of the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, arXiv 2311.16493), which costs quality at the training
width (benchmarks/zoom.py)."""
LARGEST, LARGEST_HIDDEN = 0.05, 0.5
"""Largest standard deviation of a Gaussian along each axis, as fractions of its distance from the nearest camera: where
all of its light reaches that camera, and where none does. Far places in murky water have so little contrast that only
large Gaussians cover them (benchmarks/largest_size.py)."""
COVERING = 4.0
"""Mean distances between the Gaussians of an image, as a standard deviation, that are never too large: few Gaussians
must be large to cover a surface."""
MARGIN = 0.15
"""Fraction of an image's size beyond its edges in which a Gaussian still counts as seen (Mip-Splatting)."""
NEAREST = 0.01
"""Least depth that counts as in front of a camera, and least distance from cameras, median ranges."""


@torch.no_grad()
def sampling(means: Tensor, cameras: Sequence[Camera], median_range: float) -> tuple[Tensor, Tensor]:
    """Compute how finely images and Gaussians sample the scene at each Gaussian.

    Args:
        means: (N, 3) centres, scene units.
        cameras: Cameras of the training images.
        median_range: Median range of the scene, scene units.

    Returns:
        (N,) the highest number of pixels per scene unit over the images that see the Gaussian, occluded or not; and
        (N,) the mean distance between the Gaussians of that image, scene units. Both are 0 where no image sees it.
    """
    rates, spacings = means.new_zeros(len(means)), means.new_zeros(len(means))
    for camera in cameras:
        pose = torch.from_numpy(camera.world_to_camera).to(means)
        x, y, z = torch.addmm(pose[:3, 3], means, pose[:3, :3].T).unbind(-1)
        depth = torch.ones_like(z) if camera.kind == "orthographic" else z
        focal = max(camera.fx, camera.fy)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        seen = z > NEAREST * median_range
        for position, size in ((u, camera.width), (v, camera.height)):
            seen &= (position > -MARGIN * size) & (position < (1 + MARGIN) * size)
        rate = torch.where(seen, focal / depth, 0.0)
        finer = rate > rates
        area = (1 + 2 * MARGIN) ** 2 * camera.width * camera.height
        pixels = (area / seen.sum().clamp(min=1)).sqrt()
        spacings = torch.where(finer, pixels / rate, spacings)
        rates = torch.where(finer, rate, rates)
    return rates, spacings


@torch.no_grad()
def nearest_offsets(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Compute the offset (N, 3) of each centre (N, 3) from the nearest of one or more cameras, scene units."""
    nearest, least = torch.zeros_like(means), means.new_full((len(means),), math.inf)
    for camera in cameras:
        offsets = means - torch.from_numpy(camera.centre).to(means)
        distances = offsets.norm(dim=1)
        nearest = torch.where((distances < least)[:, None], offsets, nearest)
        least = torch.minimum(least, distances)
    return nearest


@torch.no_grad()
def size_limits(
    means: Tensor, cameras: Sequence[Camera], median_range: float, visibility: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """Compute the least and the largest standard deviation (N,) that Gaussians may have, scene units.

    Args:
        means: (N, 3) centres, scene units.
        cameras: Cameras of the training images.
        median_range: Median range of the scene, scene units.
        visibility: Computes the fraction (N,) of the light that reaches a camera from offsets (N, 3) from it.

    Returns:
        The least, 0 where no image sees the centre, and the largest.
    """
    rates, spacings = sampling(means, cameras, median_range)
    least = torch.where(rates > 0, math.sqrt(LEAST_VARIANCE) / rates, 0.0)
    offsets = nearest_offsets(means, cameras)
    fraction = LARGEST_HIDDEN * (LARGEST / LARGEST_HIDDEN) ** visibility(offsets).square()
    largest = fraction * offsets.norm(dim=1).clamp(min=NEAREST * median_range)
    return least, torch.maximum(largest, COVERING * spacings)


@torch.no_grad()
def enforce_sizes(
    cloud: GaussianCloud, cameras: Sequence[Camera], median_range: float, visibility: Callable[[Tensor], Tensor]
) -> None:
    """Enlarge axes that are thinner than `size_limits` allows, and reduce those that are larger.

    Args:
        cloud: The Gaussians; their `log_scales` are changed in place.
        cameras: Cameras of the training images.
        median_range: Median range of the scene, scene units.
        visibility: Computes the fraction (N,) of the light that reaches a camera from offsets (N, 3) from it.
    """
    least, largest = (limit.log()[:, None] for limit in size_limits(cloud.means, cameras, median_range, visibility))
    cloud.log_scales.copy_(torch.maximum(torch.minimum(cloud.log_scales, largest), least))
