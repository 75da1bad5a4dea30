"""How many photos of a run see each place of a map."""

from collections.abc import Sequence

import numpy as np

from ..base.errors import InputError
from ..formats.run_folder import RunFolder
from ..scene.cameras import Camera
from ..scene.colmap import load_scene
from ..scene.split import split_views
from .grid import MapGrid
from .map_frame import MapScene
from .tiles import Tile

LEAST_VIEWS = 6
"""Least number of training photos for heights to be compared. On trained surveys of generated seabeds the median error
of heights is 0.2 to 1 pixels where 4 or more see a place, 1 to 4 pixels with 3, and 3 to 30 with fewer; with 4 or 5, a
tenth of the places is off by more than 5 pixels (benchmarks/products.py)."""


def training_cameras(scene: MapScene) -> list[Camera]:
    """Return the cameras that a run was trained with; none for a splat file, or where the photos' model is gone."""
    if scene.run is None:
        return []
    try:
        loaded = load_scene(RunFolder(scene.run).read_config()[0])
    except InputError:
        return []
    names = set(split_views([view.camera.name for view in loaded.views]).train)
    return [view.camera for view in loaded.views if view.camera.name in names]


def count_views(
    cameras: Sequence[Camera], scene: MapScene, grid: MapGrid, tile: Tile, heights: np.ndarray
) -> np.ndarray:
    """Count the cameras whose image a place lies in; what hides it is not considered.

    Args:
        cameras: Cameras in the scene's coordinates.
        scene: The map's scene.
        grid: The pixels.
        tile: A part of them.
        heights: (height, width) heights of the tile, NaN where nothing was seen.

    Returns:
        (height, width) int64.
    """
    x = grid.left + grid.pixel * (tile.column + np.arange(tile.width) + 0.5)
    y = grid.top - grid.pixel * (tile.row + np.arange(tile.height) + 0.5)
    places = np.stack([*np.meshgrid(x, y), np.nan_to_num(heights)], axis=2).reshape(-1, 3)
    to_scene = np.linalg.inv(scene.matrix)
    counts = np.zeros(len(places), np.int64)
    for camera in cameras:
        to_camera = camera.world_to_camera @ to_scene
        seen = places @ to_camera[:3, :3].T + to_camera[:3, 3]
        ahead = seen[:, 2] > 0
        depth = np.where(ahead, seen[:, 2], 1.0)
        u, v = camera.fx * seen[:, 0] / depth + camera.cx, camera.fy * seen[:, 1] / depth + camera.cy
        counts += ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return counts.reshape(heights.shape)
