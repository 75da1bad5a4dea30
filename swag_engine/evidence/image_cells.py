"""Cells of images that hold sparse points, and cells that show open water."""

from collections.abc import Sequence

import cv2
import numpy as np

from ..base.transfer import srgb_to_linear
from ..scene.colmap import Scene
from ..scene.images import TrainingImage

CELLS = 16
"""Cells along each side of an image."""
FLAT = 1.5
"""Mean contrast of a cell without structure, in 8-bit values."""
LEAST_CELLS_OF_WATER = 0.01
"""Fraction of all cells from which their color is that of open water."""


def points_in_cells(images: Sequence[TrainingImage], scene: Scene) -> np.ndarray:
    """Count the sparse points in each cell of each image.

    Args:
        images: V images.
        scene: The scene with its sparse points.

    Returns:
        (V, CELLS, CELLS) counts.
    """
    seen = {view.name: view.point_indices for view in scene.views}
    counts = []
    for image in images:
        camera = image.camera
        places = scene.points.positions[seen[camera.name]] @ camera.world_to_camera[:3, :3].T
        places = (places + camera.world_to_camera[:3, 3]) @ camera.K.T
        x, y = (places[places[:, 2] > 0, :2] / places[places[:, 2] > 0, 2:]).T
        box = [[0, camera.height], [0, camera.width]]
        counts.append(np.histogram2d(y, x, bins=CELLS, range=box)[0])
    return np.stack(counts)


def open_water_cells(images: Sequence[TrainingImage], scene: Scene) -> np.ndarray:
    """Find the cells without contrast that have no sparse point in or beside them.

    Args:
        images: V images.
        scene: The scene with its sparse points.

    Returns:
        (V, CELLS, CELLS) bool.
    """
    counts = points_in_cells(images, scene)
    flat = []
    for image in images:
        grey = cv2.GaussianBlur(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)
        rough = cv2.absdiff(grey, cv2.GaussianBlur(grey, (0, 0), 4))
        flat.append(cv2.resize(rough, (CELLS, CELLS), interpolation=cv2.INTER_AREA) < FLAT)
    beside = np.stack([cv2.dilate(count, np.ones((3, 3))) for count in counts])
    return (beside == 0) & np.stack(flat)


def open_water_light(images: Sequence[TrainingImage], scene: Scene) -> np.ndarray | None:
    """Estimate the light of open water.

    Args:
        images: Images of the scene.
        scene: The scene with its sparse points.

    Returns:
        (3,) median linear light of the open water cells, None where they are fewer than LEAST_CELLS_OF_WATER.
    """
    empty = open_water_cells(images, scene)
    if empty.mean() < LEAST_CELLS_OF_WATER:
        return None
    colors = np.concatenate(
        [
            cv2.resize(image.pixels, (CELLS, CELLS), interpolation=cv2.INTER_AREA)[cells]
            for image, cells in zip(images, empty, strict=True)
        ]
    )
    return srgb_to_linear(np.median(colors, axis=0) / 255)
