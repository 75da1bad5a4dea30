"""The space that a scene takes, and 3D viewports that show all of it."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from . import splats
from .blender_types import present

INNER_PERCENTILES = 5.0, 95.0
"""Percentiles of points that the box of a scene holds: sparse points and splats far away are often wrong."""
LEAST_COMMON_DIRECTION = 0.5
"""Length of the mean of unit vectors above which they are about the same direction: within 60 degrees of it."""
VIEWPORT_SENSOR = 72.0
"""Width in mm of the sensor that a 3D viewport's focal length is for: Blender's 36 mm, at its zoom of 2."""


def robust_box(points: np.ndarray, cameras: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,) of the box around all `cameras` (C, 3) and most `points` (P, 3).

    Without any, the box is a cube of 2 units about the origin.
    """
    inner = np.percentile(points, INNER_PERCENTILES, axis=0) if len(points) else np.zeros((0, 3))
    corners = np.concatenate([inner, cameras.reshape(-1, 3)])
    if not len(corners):
        return np.full(3, -1.0), np.full(3, 1.0)
    return corners.min(axis=0), corners.max(axis=0)


def frame(
    box: tuple[np.ndarray, np.ndarray], lens: float, width: float, height: float
) -> tuple[tuple[float, float, float], float]:
    """Place that a viewport turns about and its distance from there, so that it shows a whole box from any direction.

    Args:
        box: lowest and highest corner (3,) of the box.
        lens: focal length of the viewport, mm.
        width: width of its region, pixels.
        height: height of its region, pixels.
    """
    low, high = box
    radius = float(np.linalg.norm(high - low)) / 2 or 1.0
    # The focal length is for the longer side.
    half_angle = math.atan(VIEWPORT_SENSOR / (2 * lens) * min(width, height) / max(width, height, 1))
    x, y, z = (low + high) / 2
    return (float(x), float(y), float(z)), radius / math.sin(half_angle)


def world_box(objects: Iterable[bpy.types.Object]) -> tuple[np.ndarray, np.ndarray]:
    """The `robust_box` of the cameras and the point clouds among objects, in Blender's world."""
    points, cameras = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for obj in objects:
        if isinstance(obj.data, bpy.types.Camera):
            cameras.append(np.array(obj.matrix_world.translation)[None])
        elif isinstance(obj.data, bpy.types.PointCloud):
            own = np.empty(3 * len(obj.data.points), np.float32)
            attributes: Any = obj.data.attributes
            attributes["position"].data.foreach_get("vector", own)
            matrix = np.array(obj.matrix_world)
            points.append(own.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3])
    return robust_box(np.concatenate(points), np.concatenate(cameras))


def viewing_direction(directions: np.ndarray) -> np.ndarray | None:
    """The direction (3,) that cameras look in, as a unit vector; None without cameras.

    Splats look right from where photos were taken. It is the mean where the cameras look in about the same direction,
    and that of the first where they look inwards from around a place.

    Args:
        directions: (C, 3) unit vectors.
    """
    if not len(directions):
        return None
    mean = directions.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > LEAST_COMMON_DIRECTION else directions[0]


def frame_viewports(window: bpy.types.Window, objects: Iterable[bpy.types.Object]) -> None:
    """Move the 3D viewports of a window so that they show all of these objects, from the side of their cameras.

    Orthographic views, and all views where there are no cameras, keep their direction. Clipping distances are widened
    where they would cut the objects.
    """
    window.view_layer.update()  # world matrices of new objects
    objects = list(objects)
    box = world_box(objects)
    backwards = [np.array(obj.matrix_world)[:3, 2] for obj in objects if isinstance(obj.data, bpy.types.Camera)]
    direction = viewing_direction(-np.array(backwards).reshape(-1, 3))
    for area in window.screen.areas:
        space = area.spaces.active
        if not isinstance(space, bpy.types.SpaceView3D):
            continue
        for region in area.regions:
            view: Any = region.data
            if isinstance(view, bpy.types.RegionView3D):
                if direction is not None and view.view_perspective != "ORTHO":
                    view.view_perspective = "PERSP"
                    view.view_rotation = Vector((-direction).tolist()).to_track_quat("Z", "Y")
                view.view_location, view.view_distance = frame(box, space.lens, region.width, region.height)
                space.clip_end = max(space.clip_end, 10 * view.view_distance)
                space.clip_start = min(space.clip_start, view.view_distance / 1000)
        area.tag_redraw()


def frame_first_splats(context: bpy.types.Context, opened: Sequence[bpy.types.Object]) -> None:
    """Show all of the splats that were opened, unless the scene has others, which the user has arranged."""
    others = any(splats.is_splats(obj) and obj not in opened for obj in present(context.scene).objects)
    if context.window is not None and not bpy.app.background and not others:
        frame_viewports(context.window, opened)
