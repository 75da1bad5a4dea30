"""Which tiles of a merged survey a view needs. numpy only, Blender imports it."""

from collections.abc import Sequence

import numpy as np

from ..scene.cameras import Camera
from .survey_tiles import Tile, Tiles

LINEARISATION = 1.3
"""How much larger than in space a Gaussian can be drawn beside the view: the renderer holds the projection's derivative
at 1.3 times the field of view (GUARD in kernels/reference/projection.py)."""
BLUR = 2.0
"""Pixels by which Gaussians reach further in the image: the renderer's low-pass filter of 0.3 pixel^2."""


def tiles_in_view(tiles: Tiles, camera: Camera, level: int) -> list[Tile]:
    """Find the tiles of a level that have splats in a view.

    Args:
        tiles: The survey.
        camera: Camera in the scene's coordinates.
        level: The level.

    Returns:
        Tiles whose boxes, enlarged by the reach of their splats, meet the view frustum: all that it shows and some
        beside it.

    Raises:
        InputError: If there is no such level.
    """
    return _in_view(tiles.of_level(level), camera)


def _in_view(tiles: Sequence[Tile], camera: Camera) -> list[Tile]:
    if not tiles:
        return []
    low, high = np.array([tile.low for tile in tiles]), np.array([tile.high for tile in tiles])
    reach = LINEARISATION * np.array([tile.reach for tile in tiles])
    middles, halves = (high + low) / 2, (high - low) / 2
    visible = np.full(len(tiles), True)
    for normal, offset, reaches in _frustum(camera):
        nearest = middles @ normal + offset + halves @ np.abs(normal)
        visible &= nearest + reaches * reach >= 0
    return [tile for tile, seen in zip(tiles, visible, strict=True) if seen]


def _frustum(camera: Camera) -> list[tuple[np.ndarray, float, bool]]:
    """Return the planes of a view frustum.

    Returns:
        Of each plane its normal (3,), of length 1 and pointing inwards, and its offset: a point p is inside where
        normal . p + offset >= 0. The third value is whether splats outside can reach in; those behind the camera are
        not drawn.
    """
    left, right = (-BLUR - camera.cx) / camera.fx, (camera.width + BLUR - camera.cx) / camera.fx
    top, bottom = (-BLUR - camera.cy) / camera.fy, (camera.height + BLUR - camera.cy) / camera.fy
    if camera.kind == "orthographic":
        planes = [
            ((1.0, 0.0, 0.0), -left),
            ((-1.0, 0.0, 0.0), right),
            ((0.0, 1.0, 0.0), -top),
            ((0.0, -1.0, 0.0), bottom),
        ]
    else:
        planes = [((1, 0, -left), 0.0), ((-1, 0, right), 0.0), ((0, 1, -top), 0.0), ((0, -1, bottom), 0.0)]
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    result = []
    for direction, distance, reaches in [*((*plane, True) for plane in planes), ((0, 0, 1), 0.0, False)]:
        length = float(np.linalg.norm(direction))
        normal = np.array(direction) / length
        result.append((rotation.T @ normal, float(normal @ translation) + distance / length, reaches))
    return result
