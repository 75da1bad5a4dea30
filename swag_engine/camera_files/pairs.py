"""Pairs of photos that may show the same place, from their poses."""

import numpy as np
from scipy.spatial import cKDTree

_ALL_PAIRS_UP_TO = 25
"""Photos of which all pairs are matched."""
_NEAREST = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40)
"""Ranks of the neighbours that a photo is matched with: near ones overlap most, far ones give larger angles."""
_LARGEST_ANGLE = 70.0
"""Angle in degrees between two viewing directions above which features do not match."""


def pairs_from_poses(world_to_camera: np.ndarray) -> list[tuple[int, int]]:
    """Choose the pairs to match, in number proportional to the photos.

    Args:
        world_to_camera: Poses (V, 4, 4).

    Returns:
        Pairs of indices, the smaller first, sorted.
    """
    rotations = world_to_camera[:, :3, :3]
    centres = -np.einsum("vji,vj->vi", rotations, world_to_camera[:, :3, 3])
    directions = rotations[:, 2]
    count = len(centres)
    alike = np.cos(np.radians(_LARGEST_ANGLE))
    if count <= _ALL_PAIRS_UP_TO:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    # Neighbours that look elsewhere are passed over, so more are asked for than are taken.
    neighbours = cKDTree(centres).query(centres, min(count, 4 * _NEAREST[-1]))[1]
    found: set[tuple[int, int]] = set()
    for i, row in enumerate(neighbours):
        others = row[row != i]
        others = others[directions[others] @ directions[i] > alike]
        for rank in _NEAREST:
            if rank <= len(others):
                j = int(others[rank - 1])
                found.add((min(i, j), max(i, j)))
    return sorted(found)
