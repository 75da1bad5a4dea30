"""Least and largest size of Gaussians.

Thinner ones than any training image could show look like needles from nearer. Huge ones under a surface are drawn over
it in other views: Gaussians are sorted by the depth of their centres, which says little of one that is as large as the
view.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..scene.cameras import Camera
from ..splats.splats import LEAST_VARIANCE
from .cloud import GaussianCloud

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
CAMERAS_AT_ONCE = 8
"""Cameras whose distances from all Gaussians are in memory at a time."""


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
    near = NEAREST * median_range
    rates, spacings = means.new_zeros(len(means)), means.new_zeros(len(means))
    for camera in cameras:
        planes = torch.from_numpy(camera.view_planes((MARGIN * camera.width, MARGIN * camera.height))).to(means)
        planes[0, 3] -= near
        inside = torch.addmm(planes[:, 3:], planes[:, :3], means.T)
        depth = torch.ones_like(inside[0]) if camera.kind == "orthographic" else inside[0] + near
        seen = inside.amin(dim=0) > 0
        rate = torch.where(seen, max(camera.fx, camera.fy) / depth, 0.0)
        finer = rate > rates
        area = (1 + 2 * MARGIN) ** 2 * camera.width * camera.height
        pixels = (area / seen.sum().clamp(min=1)).sqrt()
        spacings = torch.where(finer, pixels / rate, spacings)
        rates = torch.where(finer, rate, rates)
    return rates, spacings


@torch.no_grad()
def nearest_offsets(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Compute the offset (N, 3) of each centre (N, 3) from the nearest of one or more cameras, scene units."""
    centres = torch.from_numpy(np.stack([camera.centre for camera in cameras])).to(means)
    nearest, least = torch.zeros_like(means), means.new_full((len(means),), math.inf)
    for some in centres.split(CAMERAS_AT_ONCE):
        # Products of coordinates would not do: they leave errors as large as small distances.
        distances, index = torch.cdist(means, some, compute_mode="donot_use_mm_for_euclid_dist").min(dim=1)
        nearest = torch.where((distances < least)[:, None], means - some[index], nearest)
        least = torch.minimum(least, distances)
    return nearest


@torch.no_grad()
def size_limits(
    rates: Tensor, spacings: Tensor, distances: Tensor, visibility: Tensor, median_range: float
) -> tuple[Tensor, Tensor]:
    """Compute the least and the largest standard deviation (N,) that Gaussians may have, scene units.

    Args:
        rates: (N,) pixels per scene unit, from `sampling`.
        spacings: (N,) mean distance between Gaussians, from `sampling`.
        distances: (N,) distance from the nearest camera, scene units.
        visibility: (N,) fraction of the light that reaches that camera.
        median_range: Median range of the scene, scene units.

    Returns:
        The least, 0 where no image sees the centre, and the largest.
    """
    least = torch.where(rates > 0, math.sqrt(LEAST_VARIANCE) / rates, 0.0)
    fraction = LARGEST_HIDDEN * (LARGEST / LARGEST_HIDDEN) ** visibility.square()
    largest = fraction * distances.clamp(min=NEAREST * median_range)
    return least, torch.maximum(largest, COVERING * spacings)


@torch.no_grad()
def enforce_sizes(cloud: GaussianCloud, least: Tensor, largest: Tensor) -> None:
    """Enlarge axes that are thinner than `size_limits` allows, and reduce those that are larger.

    Args:
        cloud: The Gaussians; their `log_scales` are changed in place.
        least: (N,) least standard deviation, scene units.
        largest: (N,) largest standard deviation, scene units.
    """
    limited = torch.minimum(cloud.log_scales, largest.log()[:, None])
    cloud.log_scales.copy_(torch.maximum(limited, least.log()[:, None]))
