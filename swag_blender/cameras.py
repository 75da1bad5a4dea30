"""Blender's cameras as pinhole cameras of the engine, for export and films."""

from collections.abc import Sequence

import bpy
import numpy as np

from ..swag_engine.scene.cameras import Camera
from . import scene_import
from .blender_types import present


def cameras_of(context: bpy.types.Context, roots: Sequence[bpy.types.Object]) -> list[Camera]:
    """The cameras of the images below the scene roots, in Blender's world; without any, the Blender scene's cameras.

    Of the latter, those that are visible and have perspective, at the size of a render.
    """
    depsgraph = context.evaluated_depsgraph_get()
    imported = [obj for root in roots for obj in root.children_recursive if obj.get(scene_import.SIZE_KEY) is not None]
    if imported:
        sizes = [obj.get(scene_import.SIZE_KEY) for obj in imported]
        return [
            camera_of(obj, depsgraph, int(width), int(height), aspect)
            for obj, (width, height, aspect) in zip(imported, sizes, strict=True)
        ]
    width, height, aspect = render_size(present(context.scene))
    own = [
        obj for obj in context.visible_objects if isinstance(obj.data, bpy.types.Camera) and obj.data.type == "PERSP"
    ]
    return [camera_of(obj, depsgraph, width, height, aspect) for obj in own]


def render_size(scene: bpy.types.Scene) -> tuple[int, int, float]:
    """Width and height of a render in pixels, and the width of a pixel / its height."""
    render = scene.render
    width, height = (side * render.resolution_percentage // 100 for side in (render.resolution_x, render.resolution_y))
    return max(width, 1), max(height, 1), render.pixel_aspect_x / render.pixel_aspect_y


def camera_of(
    obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, width: int, height: int, pixel_aspect: float
) -> Camera:
    """One camera object for an image of width x height pixels, each `pixel_aspect` times as wide as high."""
    x, y = max(pixel_aspect, 1.0), max(1 / pixel_aspect, 1.0)
    projection = np.array(obj.calc_matrix_camera(depsgraph, x=width, y=height, scale_x=x, scale_y=y), np.float64)
    # Parents may scale, the pose of a camera does not.
    pose = obj.evaluated_get(depsgraph).matrix_world.normalized() @ scene_import.OPENCV_TO_BLENDER
    return Camera(
        name=obj.name,
        width=width,
        height=height,
        fx=float(projection[0, 0] * width / 2),
        fy=float(projection[1, 1] * height / 2),
        cx=float(width / 2 * (1 - projection[0, 2])),
        cy=float(height / 2 * (1 + projection[1, 2])),
        world_to_camera=np.linalg.inv(np.array(pose, np.float64)),
    )
