"""Which tiles of a merged survey a view needs. numpy only, Blender imports it."""

import heapq
from collections.abc import Sequence

import numpy as np

from ..scene.cameras import Camera
from .survey_tiles import Cell, Tile, Tiles

LINEARISATION = 1.3
"""How much larger than in space a Gaussian can be drawn beside the view: the renderer holds the projection's derivative
at 1.3 times the field of view (GUARD in kernels/reference/projection.py)."""
BLUR = 2.0
"""Pixels by which Gaussians reach further in the image: the renderer's low-pass filter of 0.3 pixel^2."""
SHARP = 1.0
"""Distance of splats in pixels below which a finer level shows no more."""


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


def tiles_for_view(tiles: Tiles, camera: Camera, budget: int, finest: int = 0) -> list[Tile]:
    """Choose tiles of mixed levels for a view: fine ones near the camera, coarse ones far away.

    It begins with the coarsest level. The tile whose splats are farthest apart in the image is replaced by those of
    the finer level in its cube, as long as the budget allows.

    Args:
        tiles: The survey.
        camera: Camera in the scene's coordinates.
        budget: Largest number of splats. The coarsest level is shown whole even where it has more.
        finest: Finest level that may be used.

    Returns:
        The tiles, coarse ones first. No place is covered twice: a tile is left out where a finer one of its cube is
        shown.
    """
    by_place = {(tile.level, tile.cell): tile for tile in tiles.tiles if tile.level >= finest}
    coarsest = max(tile.level for tile in tiles.tiles)
    visible = {(tile.level, tile.cell) for tile in _in_view(list(by_place.values()), camera)}
    children: dict[tuple[int, Cell], list[Tile]] = {}
    for level in range(finest, coarsest):
        for key in sorted(key for key in visible if key[0] == level):
            x, y, z = key[1]
            parent = level + 1, (x // 2, y // 2, z // 2)
            visible.add(parent)  # its own box is smaller than those of its children together
            children.setdefault(parent, []).append(by_place[key])
    chosen = {key: by_place[key] for key in visible if key[0] == coarsest}
    used = sum(tile.splats for tile in chosen.values())
    waiting = [(-pixels_apart(tile, camera), key) for key, tile in chosen.items()]
    heapq.heapify(waiting)
    while waiting:
        pixels, key = heapq.heappop(waiting)
        finer = children.get(key, [])
        more = sum(tile.splats for tile in finer) - chosen[key].splats
        if key[0] == finest or -pixels <= SHARP or used + more > budget:
            continue
        del chosen[key]
        used += more
        for tile in finer:
            chosen[tile.level, tile.cell] = tile
            heapq.heappush(waiting, (-pixels_apart(tile, camera), (tile.level, tile.cell)))
    return sorted(chosen.values(), key=lambda tile: (-tile.level, tile.cell))


def pixels_apart(tile: Tile, camera: Camera) -> float:
    """Return the typical distance of the splats of a tile in an image, pixels.

    Args:
        tile: The tile, which counts as a surface across its box.
        camera: The camera; the distance is that of the nearest point of the box.
    """
    low, high = np.array(tile.low), np.array(tile.high)
    apart = float(np.linalg.norm(high - low)) / np.sqrt(tile.splats)
    if camera.kind == "orthographic":
        return camera.fx * apart
    distance = float(np.linalg.norm(camera.centre - np.clip(camera.centre, low, high)))
    return camera.fx * apart / max(distance, apart, 1e-12)


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
        planes = [((1, 0, 0), -left), ((-1, 0, 0), right), ((0, 1, 0), -top), ((0, -1, 0), bottom)]
    else:
        planes = [((1, 0, -left), 0.0), ((-1, 0, right), 0.0), ((0, 1, -top), 0.0), ((0, -1, bottom), 0.0)]
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    result = []
    for direction, distance, reaches in [*((*plane, True) for plane in planes), ((0, 0, 1), 0.0, False)]:
        length = float(np.linalg.norm(direction))
        normal = np.array(direction) / length
        result.append((rotation.T @ normal, float(normal @ translation) + distance / length, reaches))
    return result
