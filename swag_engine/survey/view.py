"""The splats of a merged survey that a view needs."""

import numpy as np

from ..formats.ply import read_ply
from ..formats.survey_tiles import Tiles
from ..formats.survey_view import tiles_in_view
from ..scene.cameras import Camera
from ..splats.splats import Splats, concatenate


def splats_in_view(tiles: Tiles, camera: Camera, level: int = 0) -> Splats:
    """Read the splats of a survey that a view shows.

    Args:
        tiles: The survey.
        camera: Camera in the scene's coordinates.
        level: Level of detail.

    Returns:
        All splats that the view shows and some beside it, which may be none.

    Raises:
        InputError: If there is no such level, or a tile cannot be read.
    """
    needed = tiles_in_view(tiles, camera, level)
    if not needed:
        return read_ply(tiles.path(tiles.tiles[0])).subset(np.arange(0))
    return concatenate([read_ply(tiles.path(tile)) for tile in needed])
