"""Seams between the blocks of a survey: which pixels show them."""

from collections.abc import Sequence

import numpy as np
import torch

from ..effects.scene_effects import SceneEffects
from ..formats.survey_folder import Block, Ground
from ..gaussians.cloud import GaussianCloud
from ..rendering.render import render
from ..scene.cameras import Camera

COVERED = 0.5
"""Least alpha of a pixel that shows a surface."""


def distance_to_seams(on_ground: np.ndarray, blocks: Sequence[Block]) -> np.ndarray:
    """Return the distances of places to the nearest border between two blocks.

    Args:
        on_ground: (N, 2 or 3) places on the ground.
        blocks: All blocks.

    Returns:
        (N,) scene units; infinite for a survey of one block.
    """
    nearest = np.full(len(on_ground), np.inf)
    for block in blocks:
        left, bottom, right, top = block.core
        x, y = on_ground[:, 0], on_ground[:, 1]
        beyond_x = np.maximum(np.maximum(left - x, x - right), 0)
        beyond_y = np.maximum(np.maximum(bottom - y, y - top), 0)
        outside = np.hypot(beyond_x, beyond_y)
        inside = np.min([x - left, right - x, y - bottom, top - y], axis=0)
        # Edges of the survey are infinitely far away.
        nearest = np.minimum(nearest, np.where(outside > 0, outside, inside))
    return nearest


@torch.no_grad()
def seam_distances(
    cloud: GaussianCloud, effects: SceneEffects, camera: Camera, ground: Ground, blocks: Sequence[Block]
) -> np.ndarray:
    """Return how far from a border between blocks the surface in each pixel of a view is.

    Args:
        cloud: The Gaussians.
        effects: Effects of the survey.
        camera: The camera.
        ground: Ground of the survey.
        blocks: All blocks.

    Returns:
        (H, W) scene units, NaN where a pixel shows no surface.
    """
    picture = render(cloud, camera, 0, effects.medium, with_range=True)
    assert picture.range is not None
    ranges, alpha = picture.range.cpu().numpy(), picture.alpha.cpu().numpy()
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ camera.world_to_camera[:3, :3]
    surface = (camera.centre + ranges[..., None] * rays).reshape(-1, 3)
    distance = distance_to_seams(ground.on_ground(surface), blocks).reshape(ranges.shape)
    return np.where(alpha > COVERED, distance, np.nan)
