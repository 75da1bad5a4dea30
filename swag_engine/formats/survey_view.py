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
    for index, (*normal, offset) in enumerate(camera.view_planes((BLUR, BLUR))):
        inside = middles @ normal + offset + halves @ np.abs(normal)
        # Splats behind the camera are not drawn, even where they reach beyond its plane.
        visible &= inside + (reach if index else 0) >= 0
    return [tile for tile, seen in zip(tiles, visible, strict=True) if seen]
