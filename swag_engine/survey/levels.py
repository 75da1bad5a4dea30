"""Levels of detail: a group of splats becomes one that has the mass, the mean and the covariance of the group.

Splats near each other in position and color form groups of four. The one that stands for a group has the weighted
moments of the group's mixture of Gaussians, as in Hierarchical 3D Gaussian Splatting (Kerbl et al. 2024, section 4.1);
weights are opacity times area.
"""

import numpy as np

from ..splats.splats import Splats
from ..splats.transform import C0, covariances, quaternions

GROUP = 4
"""Splats of a level that become one of the next: a surface has a quarter of the detail at twice the size."""
MOST_OPACITY = 0.999
"""Largest opacity of a merged splat."""
COLOR_WEIGHT = 0.5
"""Distance in position, in units of the typical spacing of splats, that counts as much as a change of color by 1."""
LEAST_WEIGHT = 1e-200
"""Weight of splats without opacity or area, so that a group of them has a mean."""


def areas(scales: np.ndarray) -> np.ndarray:
    """Return the area that Gaussians cover, seen from anywhere: the root mean square over directions.

    A Gaussian projects to one whose covariance has the determinant d' adj(Sigma) d for a direction d.

    Args:
        scales: (N, 3) standard deviations, scene units.

    Returns:
        (N,) float64, scene units squared, of the ellipse of one standard deviation without the factor pi.
    """
    x, y, z = np.square(scales.astype(np.float64)).T
    return np.sqrt((x * y + y * z + z * x) / 3)


def coarser(splats: Splats) -> Splats:
    """Make the splats of the next level of detail, a quarter as many.

    Args:
        splats: At least one splat.

    Returns:
        The merged splats; each lies among those that it stands for.
    """
    return merged(splats, group(splats, -(-len(splats) // GROUP)))


def group(splats: Splats, count: int) -> np.ndarray:
    """Divide splats into groups of like size, near each other in position and color.

    Splats are halved at the median of the axis along which they extend most, again and again: x, y, z, and the three
    channels of the constant color.

    Args:
        splats: N splats.
        count: Number of groups, at most N.

    Returns:
        Group of each splat (N,) int64, 0 to count - 1.
    """
    positions = splats.positions.astype(np.float64)
    spacing = float(np.median(np.sqrt(areas(splats.scales))))
    features = np.hstack([positions, splats.sh[:, 0].astype(np.float64) * (C0 * spacing / COLOR_WEIGHT)])
    order = np.arange(len(splats))
    starts, groups = np.array([0]), np.array([count])  # of nodes: first place in `order`, groups to be made of it
    while (groups > 1).any():
        sizes = np.diff(np.append(starts, len(order)))
        ordered = features[order]
        extents = np.maximum.reduceat(ordered, starts) - np.minimum.reduceat(ordered, starts)
        node = np.repeat(np.arange(len(starts)), sizes)
        keys = ordered[np.arange(len(order)), extents.argmax(axis=1)[node]]
        order = order[np.lexsort([order, keys, node])]
        lower = groups // 2
        parts = np.stack([np.full(len(starts), True), groups > 1], axis=1)
        starts = np.stack([starts, starts + sizes * lower // groups], axis=1)[parts]
        groups = np.stack([np.maximum(lower, 1), groups - lower], axis=1)[parts]
    result = np.empty(len(order), np.int64)
    result[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    return result


def merged(splats: Splats, groups: np.ndarray) -> Splats:
    """Replace each group of splats by one of the same mass, mean, covariance and color.

    The mass of a splat is its opacity times its area. Spherical harmonics and extras of real numbers are weighted
    means, integers such as labels those of the largest weight. A group of one stays as it is.

    Args:
        splats: N splats.
        groups: Group of each splat (N,), 0 to M - 1, none of them empty.

    Returns:
        M splats.
    """
    order = np.argsort(groups, kind="stable")
    groups = groups[order]
    splats = splats.subset(order)
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    sizes = np.diff(np.append(starts, len(groups)))
    masses = splats.opacities * areas(splats.scales)
    weights = np.maximum(masses, LEAST_WEIGHT)
    weights /= np.add.reduceat(weights, starts)[groups]

    def mean(values: np.ndarray) -> np.ndarray:
        columns = values.reshape(len(values), -1).T  # one after the other, to save memory
        means = [np.add.reduceat(column * weights, starts) for column in columns]
        return np.stack(means, axis=1).reshape(-1, *values.shape[1:])

    low, high = (limit.reduceat(splats.positions, starts) for limit in (np.minimum, np.maximum))
    positions = mean(splats.positions).clip(low, high)
    offsets = splats.positions - positions[groups]
    variances, axes = np.linalg.eigh(mean(covariances(splats) + offsets[:, :, None] * offsets[:, None, :]))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(np.maximum(variances, 0))
    mass, area = np.add.reduceat(masses, starts), areas(scales)
    opacities = np.minimum(np.divide(mass, area, out=np.zeros_like(mass), where=area > 0), MOST_OPACITY)
    extras = {
        name: mean(values).astype(values.dtype) if values.dtype.kind == "f" else _majority(values, groups, weights)
        for name, values in splats.extras.items()
    }
    result = Splats(
        positions.astype(np.float32),
        quaternions(axes).astype(np.float32),
        scales.astype(np.float32),
        opacities.astype(np.float32),
        mean(splats.sh).astype(np.float32),
        extras,
        splats.placement,
        splats.development,
    )
    alone = sizes == 1
    for name in ("positions", "rotations", "scales", "opacities", "sh"):
        getattr(result, name)[alone] = getattr(splats, name)[starts[alone]]
    return result


def _majority(values: np.ndarray, groups: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the value of the largest weight in each group, the least of equal ones; `groups` are sorted."""
    order = np.lexsort([values, groups])
    values, groups = values[order], groups[order]
    starts = np.flatnonzero((np.diff(groups, prepend=-1) != 0) | np.append(True, values[1:] != values[:-1]))
    votes = np.add.reduceat(weights[order], starts)
    ranked = np.lexsort([values[starts], -votes, groups[starts]])
    first = np.flatnonzero(np.diff(groups[starts][ranked], prepend=-1))
    return values[starts][ranked][first]
