"""What the images of a survey see: points, groups that share points, and a few images that cover all."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def connected_groups(seen: Sequence[np.ndarray], points: int) -> list[np.ndarray]:
    """Find the groups of images that are connected by common points.

    Args:
        seen: Rows of the sparse points that each of the V images sees, each once.
        points: Number of points.

    Returns:
        Rows of the images of each group, ascending; the largest group first. An image without points is in none.
    """
    # An image is linked to the first image that sees each of its points, and through these to all others.
    first = np.full(points, -1, np.int32)
    links = []
    for image, rows in enumerate(seen):
        known = first[rows]
        first[rows[known < 0]] = image
        others = np.unique(known[known >= 0])
        links.append(np.stack([np.full(len(others), image), others]))
    rows, columns = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(len(seen), len(seen)))
    _, group = connected_components(graph, directed=False)
    with_points = np.array([len(rows) > 0 for rows in seen])
    groups = [np.flatnonzero((group == number) & with_points) for number in np.unique(group[with_points])]
    return sorted(groups, key=len, reverse=True)


def covering_images(centres: np.ndarray, directions: np.ndarray, distance: float, count: int) -> np.ndarray:
    """Choose images that cover a survey: each is the one farthest from those before it, in place and direction.

    Args:
        centres: Positions of the cameras (V, 3), scene units.
        directions: Unit vectors (V, 3) of their viewing directions.
        distance: Distance that counts as much as a turn by one radian: the range at which images see, scene units.
        count: Number of images to choose.

    Returns:
        Rows (min(count, V),) in the order of choice.
    """
    places = np.concatenate([centres / distance, directions], axis=1)
    nearest = np.full(len(places), np.inf)
    chosen = [int(np.argmin(np.linalg.norm(places - np.median(places, axis=0), axis=1)))]
    while len(chosen) < min(count, len(places)):
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
        nearest[chosen[-1]] = -1.0
        chosen.append(int(np.argmax(nearest)))
    return np.array(chosen)
