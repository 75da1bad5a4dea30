"""Levels of detail: a group of splats becomes one that has the mass, the mean and the covariance of the group.

Splats nearest to each other in position and color form groups of four on average. The one that stands for a group has
the weighted moments of the group's mixture of Gaussians, as in Hierarchical 3D Gaussian Splatting (Kerbl et al. 2024,
section 4.1); weights are opacity times area.
"""

import numpy as np

from ..splats.splats import Splats
from ..splats.transform import C0, covariances, quaternions

GROUP = 4
"""Splats of a level that become one of the next: a surface has a quarter of the detail at twice the size."""
MOST_OPACITY = 0.999
"""Largest opacity of a merged splat; mass is lost where a group would need more: larger splats are worse."""
COLOR_WEIGHT = 8.0
"""Distance in units of the typical size of splats that counts as much as a change of the display color by 1."""
WINDOW = 8
"""Splats after each one on a space-filling curve among which its nearest is looked for."""
SHIFTS = (0.0, 1 / 3, 2 / 3)
"""Offsets of the curves that are looked along, as fractions of the extent: neighbors that one separates are near each
other on another."""
CHEAPEST = 2 / 3
"""Fraction of the pairs found at once that are joined: the others may find nearer ones in the next round."""
CURVE_BITS = 21
"""Bits of a position along each axis of a space-filling curve: three axes fit into 64 bits."""
SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two zeros after each of CURVE_BITS bits."""
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
    """Divide splats into groups near each other in position and color.

    Pairs of which each is the nearest of the other are joined, the nearest ones first, until there are few enough. It
    is the agglomerative clustering of centroids with approximate neighbors.

    Args:
        splats: N splats.
        count: Number of groups, 1 to N.

    Returns:
        Group of each splat (N,) int64, 0 to count - 1.
    """
    extents = areas(splats.scales)
    size = max(float(np.median(np.sqrt(extents))), 1e-12)
    features = np.hstack([splats.positions / size, splats.sh[:, 0] * (C0 * COLOR_WEIGHT)])
    # Of splats at the same place each must have one that is nearest.
    features += np.random.default_rng(0).uniform(-1e-4, 1e-4, features.shape)
    weights = np.maximum(splats.opacities * extents, LEAST_WEIGHT)
    groups = np.arange(len(splats))
    while len(features) > count:
        first, second = _nearest_pairs(features, len(features) - count)
        target = np.arange(len(features))
        target[second] = first
        target = np.unique(target, return_inverse=True)[1]
        together = np.bincount(target, weights)
        columns = [np.bincount(target, weights * column) / together for column in features.T]
        features, weights, groups = np.stack(columns, axis=1), together, target[groups]
    return groups


def _nearest_pairs(features: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return indices (M,) and (M,) of points (N, 6) that are nearest to each other, at least one and at most `most`."""
    count = len(features)
    distances, nearest = np.full(count, np.inf), np.zeros(count, np.int64)
    for shift in SHIFTS:
        order = np.argsort(_along_curve(features[:, :3], shift), kind="stable")
        for step in range(1, min(WINDOW, count - 1) + 1):
            one, other = order[:-step], order[step:]
            between = np.square(features[one] - features[other]).sum(axis=1)
            for here, there in ((one, other), (other, one)):
                nearer = between < distances[here]
                distances[here[nearer]], nearest[here[nearer]] = between[nearer], there[nearer]
    first = np.flatnonzero((nearest[nearest] == np.arange(count)) & (np.arange(count) < nearest))
    by_distance = first[np.argsort(distances[first], kind="stable")]
    first = by_distance[: min(most, max(1, int(CHEAPEST * len(by_distance))))]
    return first, nearest[first]


def _along_curve(positions: np.ndarray, shift: float) -> np.ndarray:
    """Return the places (N,) of positions (N, 3) on a Morton curve, which is offset by a fraction of their extent."""
    low = positions.min(axis=0)
    extent = max(float(np.ptp(positions, axis=0).max()), 1e-12)
    cells = (((positions - low) / extent + shift) / 2 * (2**CURVE_BITS - 1)).astype(np.uint64)
    for bits, mask in SPREAD:
        cells = (cells | (cells << np.uint64(bits))) & np.uint64(mask)
    return cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2))


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
        splats.origin,
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
