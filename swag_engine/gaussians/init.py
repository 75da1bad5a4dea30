"""Initial Gaussians from the sparse points of structure from motion."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from ..base.errors import InputError
from ..kernels.reference.harmonics import C0
from ..scene.colmap import Points
from .cloud import GaussianCloud

INITIAL_OPACITY = 0.3
"""Opacity of all Gaussians at the start of a run."""
NEIGHBOURS = 3
"""Nearest points whose mean distance is the width of a Gaussian, as in 3DGS."""
LEAST_WIDTH = 0.05
"""Least width as a factor of the median width: points may coincide."""
MOST_WIDTH = 5
"""Largest width as a factor of the median width: a stray point far from all others would cover the image."""


def gaussians_from_points(
    points: Points, most: int, sh_degree: int, seed: int, background: np.ndarray
) -> GaussianCloud:
    """Make one round Gaussian per point, as wide as the mean distance to its nearest neighbours.

    Points that are not finite in float32 are ignored.

    Args:
        points: The sparse points.
        most: Largest number of Gaussians; of more points a seeded random subset is taken.
        sh_degree: SH degree of the colors, 0..3.
        seed: Seed of that subset.
        background: (3,) initial display value, in 0..1, where no Gaussian is.

    Returns:
        The Gaussians, float32.

    Raises:
        InputError: No point is finite.
    """
    colors = points.colors
    with np.errstate(over="ignore"):
        positions = points.positions.astype(np.float32).astype(np.float64)
    keep = np.flatnonzero(np.isfinite(positions).all(axis=1))
    if not len(keep):
        raise InputError("No point of the scene's model has finite coordinates.")
    if len(keep) > most:
        keep = np.sort(np.random.default_rng(seed).choice(keep, most, replace=False))
    positions, colors = positions[keep], colors[keep]
    neighbours = min(NEIGHBOURS + 1, len(positions))
    distances = cKDTree(positions).query(positions, k=neighbours)[0].reshape(len(positions), neighbours)
    nearest = distances[:, 1:].mean(axis=1) if neighbours > 1 else np.full(len(positions), np.nan)
    typical = np.nanmedian(nearest[nearest > 0]) if (nearest > 0).any() else 1.0
    width = np.clip(np.nan_to_num(nearest, nan=typical), LEAST_WIDTH * typical, MOST_WIDTH * typical)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32)

    n = len(positions)
    inside = np.clip(background, 0.02, 0.98)
    return GaussianCloud(
        means=tensor(positions),
        quats=tensor(np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))),
        log_scales=tensor(np.log(np.repeat(width[:, None], 3, axis=1))),
        opacity_logits=torch.full((n,), float(np.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)))),
        sh0=tensor((colors[:, None, :] / 255.0 - 0.5) / C0),
        shN=torch.zeros(n, (sh_degree + 1) ** 2 - 1, 3),
        background=tensor(np.log(inside / (1 - inside))),
    )
