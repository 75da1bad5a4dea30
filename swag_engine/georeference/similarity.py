"""Similarities between corresponding points, and how far each measurement decides the scale."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

SAMPLES = 500
"""Random triples tried for a robust fit: with half of the positions wrong, all fail with a probability of 1e-29."""
OUTLIER = 3.0
"""Standard deviations beyond which a position is left out."""
DOUBTFUL_ROTATION = math.radians(5)
"""Standard error of an axis above which the cameras' up direction says more than the positions."""
UP_ERROR = math.radians(5)
"""Assumed standard error of the up direction that is estimated from cameras and points."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Similarity:
    """target = scale * rotation @ source + translation.

    Attributes:
        scale: Scale.
        rotation: Rotation (3, 3).
        translation: Translation (3,).
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Transform points (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


def fit_similarity(
    source: np.ndarray, target: np.ndarray, up: tuple[np.ndarray, float] | None = None, scale: float = 0.0
) -> Similarity:
    """Fit a similarity by least squares (Umeyama 1991).

    Args:
        source: Points (N, 3), N at least 2.
        target: Where they are (N, 3).
        up: Direction (3,) of the source that shall become z, and its weight as a sum of products of lengths; without
            it the points alone decide the rotation.
        scale: Scale that is known; 0 where the points decide it.

    Returns:
        The similarity.
    """
    from_middle, to_middle = source.mean(0), target.mean(0)
    a, b = source - from_middle, target - to_middle
    products = b.T @ a
    if up:
        direction, weight = up
        products = products + weight * np.outer((0.0, 0.0, 1.0), direction)
    left, _, right = np.linalg.svd(products)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ flip @ right
    scale = scale or max(float((b * (a @ rotation.T)).sum() / max((a * a).sum(), 1e-300)), 1e-12)
    return Similarity(scale, rotation, to_middle - scale * rotation @ from_middle)


def rotation_to_z_up(up: np.ndarray) -> np.ndarray:
    """Make the smallest rotation (3, 3) that takes a unit vector (3,) to z; by 180 degrees around x from -z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])  # of the axis, direction x (0, 0, 1)
    return np.eye(3) + cross + cross @ cross / (1 + z)


def robust_inliers(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Find the correspondences that agree with one similarity, by the least median of squares (Rousseeuw 1984).

    Args:
        source: Points (N, 3).
        target: Where they are (N, 3).

    Returns:
        Mask (N,) bool, all True for fewer than 5 points, which are too few to show which one is wrong.
    """
    count = len(source)
    if count < 5:
        return np.ones(count, bool)
    random = np.random.default_rng(0)
    best, kept = math.inf, np.ones(count, bool)
    rank = (count + 4) // 2 - 1  # more than half, as three always fit
    for _ in range(SAMPLES):
        sample = random.choice(count, 3, replace=False)
        fit = fit_similarity(source[sample], target[sample])
        residuals = np.linalg.norm(fit(source) - target, axis=1)
        if (middle := float(np.partition(residuals, rank)[rank])) < best:
            best = middle
            kept = residuals <= max(2.5 * OUTLIER * middle, 1e-9)  # loose: a fit to three points is noisy
    for _ in range(5):  # with all that agree, the threshold becomes that of the noise
        fit = fit_similarity(source[kept], target[kept])
        residuals = np.linalg.norm(fit(source) - target, axis=1)
        freedom = max(3 * int(kept.sum()) - 7, 1)
        sigma = math.sqrt((residuals[kept] ** 2).sum() / freedom) * (1 + 5 / freedom)  # few may agree by chance
        kept = residuals <= max(OUTLIER * math.sqrt(3) * sigma, 1e-6 * float(np.ptp(target, axis=0).max()))
    return kept


def axis_error(target: np.ndarray, sigma: float) -> float:
    """Return the standard error in radians of the least determined axis of a fit.

    Args:
        target: Positions (N, 3).
        sigma: Standard deviation of their coordinates.
    """
    centred = target - target.mean(0)
    information = np.eye(3) * (centred**2).sum() - centred.T @ centred
    return sigma / math.sqrt(max(float(np.linalg.eigvalsh(information)[0]), 1e-300))


def leave_one_out(items: Sequence[T], estimate: Callable[[Sequence[T]], float]) -> float | None:
    """Return the relative standard error of an estimate from leaving out each item in turn (the jackknife).

    Args:
        items: What the estimate is made from.
        estimate: Makes it from some of the items.

    Returns:
        The error, None for a single item.
    """
    count = len(items)
    if count < 2:
        return None
    values = np.array([estimate([*items[:i], *items[i + 1 :]]) for i in range(count)])
    return float(math.sqrt((count - 1) / count * ((values - values.mean()) ** 2).sum()) / abs(values.mean()))
