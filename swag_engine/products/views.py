"""Where the photos of a run see places of a map, and how exactly they determine the heights there."""

from collections.abc import Sequence

import cv2
import numpy as np

from ..scene.cameras import Camera
from .grid import MapGrid
from .map_frame import MapScene
from .tiles import Tile

BLOCK = 8
"""Edge of the blocks of pixels that the error is found for, pixels: it changes little from pixel to pixel."""

SINGULAR = 1e-9
"""Determinant of an information matrix, relative to its trace^3, below which rays are taken as one line."""
STEPS = 64
"""Places along a line at which the surface may hide it."""


def camera_centre(camera: Camera, scene: MapScene) -> np.ndarray:
    """Place (3,) of a camera in the frame of a map."""
    return scene.matrix[:3, :3] @ camera.centre + scene.matrix[:3, 3]


def project(camera: Camera, scene: MapScene, places: np.ndarray) -> np.ndarray:
    """Project places (N, 3) in the frame of a map to pixels (N, 2) of a photo; NaN for those outside of it."""
    to_camera = camera.world_to_camera @ np.linalg.inv(scene.matrix)
    seen = places @ to_camera[:3, :3].T + to_camera[:3, 3]
    depth = np.where(seen[:, 2] > 0, seen[:, 2], np.nan)
    u, v = camera.fx * seen[:, 0] / depth + camera.cx, camera.fy * seen[:, 1] / depth + camera.cy
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return np.where(inside[:, None], np.stack([u, v], axis=1), np.nan)


def visible(viewpoint: np.ndarray, grid: MapGrid, heights: np.ndarray) -> np.ndarray:
    """Find the pixels of a map from which the surface hides nothing of the straight line to a viewpoint.

    The surface is taken a pixel wider than it is: what may be hidden is.

    Args:
        viewpoint: (3,) in the frame of the map, above the surface.
        grid: The pixels.
        heights: (H, W), NaN where nothing was seen.

    Returns:
        (H, W) bool; false where nothing was seen.
    """
    rows, columns = np.nonzero(np.isfinite(heights))
    places = grid.places(heights)[rows, columns]
    towards = viewpoint - places
    highest = float(places[:, 2].max(initial=-np.inf))
    # The part of each line that is below the highest place.
    part = np.clip((highest - places[:, 2]) / np.maximum(towards[:, 2], 1e-12), 0, 1)
    wider = cv2.dilate(np.where(np.isfinite(heights), heights, -np.inf), np.ones((3, 3)))
    free = np.ones(len(places), bool)
    for step in range(1, STEPS + 1):
        at = places + (part * step / STEPS)[:, None] * towards
        column = np.floor((at[:, 0] - grid.left) / grid.pixel).astype(np.int64)
        row = np.floor((grid.top - at[:, 1]) / grid.pixel).astype(np.int64)
        there = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
        there &= np.maximum(np.abs(column - columns), np.abs(row - rows)) > 1  # not the place itself
        free &= ~(there & (wider[row.clip(0, grid.height - 1), column.clip(0, grid.width - 1)] > at[:, 2]))
    found = np.zeros(heights.shape, bool)
    found[rows, columns] = free
    return found


def height_errors(
    cameras: Sequence[Camera], scene: MapScene, grid: MapGrid, tile: Tile, heights: np.ndarray
) -> np.ndarray:
    """Predict the errors of heights from the number, distance and directions of the photos that see a place.

    A place is where rays of photos meet. A ray in the direction r, whose error is the angle of one pixel 1/f, adds
    (f / range)^2 (I - r r^T) to the information of the place, whose inverse is the covariance (Förstner and Wrobel
    2016, Photogrammetric Computer Vision). A photo adds as many rays as it has pixels on the place, a level pixel of
    the map: those of a photo from afar or at a low angle are few. What hides a place is not considered.

    Args:
        cameras: Cameras in the scene's coordinates.
        scene: The map's scene.
        grid: The pixels.
        tile: A part of them.
        heights: (height, width) heights of the tile, NaN where nothing was seen.

    Returns:
        (height, width) float32 standard deviations of the height for independent errors of one pixel, length units of
        the map; infinite where fewer than two photos see a place. Constant within blocks.
    """
    rows, columns = (np.arange(0, size, BLOCK) for size in (tile.height, tile.width))
    x = grid.left + grid.pixel * (tile.column + np.minimum(columns + BLOCK / 2, tile.width - 0.5))
    y = grid.top - grid.pixel * (tile.row + np.minimum(rows + BLOCK / 2, tile.height - 0.5))
    places = np.stack([*np.meshgrid(x, y), _block_means(heights)], axis=2).reshape(-1, 3)
    information, counts = np.zeros((len(places), 3, 3)), np.zeros(len(places), np.int64)
    for camera in cameras:
        inside = np.isfinite(project(camera, scene, places)[:, 0])
        rays = places[inside] - camera_centre(camera, scene)
        squares = (rays * rays).sum(axis=1)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :] / squares[:, None, None]
        pixels = grid.pixel**2 * camera.fx**2 * np.abs(rays[:, 2]) / squares**1.5
        information[inside] += across * (pixels * camera.fx**2 / squares)[:, None, None]
        counts += inside
    # The element zz of the inverse; rays along one line leave the place on it undetermined.
    minor = information[:, 0, 0] * information[:, 1, 1] - information[:, 0, 1] ** 2
    determinant = np.linalg.det(information)
    enough = (counts >= 2) & (determinant > SINGULAR * np.trace(information, axis1=1, axis2=2) ** 3)
    errors = np.sqrt(np.divide(minor, determinant, out=np.full(len(places), np.inf), where=enough))
    blocks = errors.reshape(len(rows), len(columns)).astype(np.float32)
    return blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[: tile.height, : tile.width]


def _block_means(heights: np.ndarray) -> np.ndarray:
    """Means of heights (H, W) in blocks; 0 where nothing was seen."""
    edges = [(0, -size % BLOCK) for size in heights.shape]
    known = np.pad(np.isfinite(heights), edges)
    values = np.where(known, np.pad(heights, edges), 0.0)
    rows, columns = (size // BLOCK for size in values.shape)
    sums, counts = (part.reshape(rows, BLOCK, columns, BLOCK).sum(axis=(1, 3)) for part in (values, known))
    return sums / np.maximum(counts, 1)
