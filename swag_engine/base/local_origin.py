"""The origin near which a scene is computed. numpy only, Blender imports it."""

import numpy as np

FAR = 100.0
"""Distance of a scene from its origin, as a multiple of its size, beyond which float32 coordinates are too coarse."""


def local_origin(positions: np.ndarray) -> np.ndarray:
    """Return what is to be subtracted from coordinates before they are rounded to float32.

    Args:
        positions: (P, 3) float64, at least one, such as coordinates in UTM or geocentric ones.

    Returns:
        (3,) float64: zero unless the positions are far from their origin, as seen against their size. It is a multiple
        of a power of two near that size, so that subtracting it is exact, and that a few more points rarely change it.
    """
    middle = np.median(positions, axis=0)
    size = float(np.percentile(np.abs(positions - middle).max(axis=1), 90))
    if not size or not np.isfinite(size) or np.abs(middle).max() <= FAR * size:
        return np.zeros(3)
    step = 2.0 ** (np.ceil(np.log2(size)) + 4)
    return np.round(middle / step) * step + 0.0  # no -0
