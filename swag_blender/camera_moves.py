"""Animated cameras for films: a turntable, and a path through photos. Both are plain keyframes that a user can edit."""

import math
import re
from collections.abc import Sequence
from typing import Any, cast

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..swag_engine.base.errors import InputError
from . import scene_import, splats
from .blender_types import present

FRAMED_PERCENTILE = 90.0
"""Percentage of the points that a turntable keeps in its image: some splats are far from all others."""
MARGIN = 1.1
"""Distance of a turntable's camera, as a multiple of that at which these points just fit."""
LEAST_STEP = 0.1
"""Duration of a step between two photos at least, as a fraction of the mean one: photos may be at one place."""
SELECTED = "swag:selected"
"""Point attribute of selected splats."""


def add_turntable(
    context: bpy.types.Context, objects: Sequence[bpy.types.Object], frames: int, angle: float, elevation: float
) -> bpy.types.Object:
    """Add a camera that goes around objects, and make it the scene's camera; returns the camera.

    It starts on the side of the imported photos. The frame range of the scene becomes that of the animation.

    Args:
        context: its scene gets the camera.
        objects: what is shown; of splat objects the selected splats, all where none is selected.
        frames: number of frames of the animation.
        angle: how far the camera goes, in radians; a full circle repeats without a seam.
        elevation: height of the camera as an angle above the horizon, in radians.

    Raises:
        InputError: the objects have no points.
    """
    scene = present(context.scene)
    points = np.concatenate([_points(obj) for obj in objects]) if objects else np.zeros((0, 3))
    if not len(points):
        raise InputError("There is nothing to go around: select splats or other objects.")
    centre = np.median(points, axis=0)
    radius = max(float(np.percentile(np.linalg.norm(points - centre, axis=1), FRAMED_PERCENTILE)), 1e-6)

    data = bpy.data.cameras.new("Turntable")
    frame = data.view_frame(scene=scene)
    # The frame's corner 0 is its upper right one; its shape is that of the render.
    narrow = min(abs(frame[0].x), abs(frame[0].y)) / abs(frame[0].z)
    distance = MARGIN * radius / math.sin(math.atan(narrow))
    data.clip_start, data.clip_end = distance * 1e-3, distance * 1e3
    axis = bpy.data.objects.new("Turntable Axis", None)
    camera = bpy.data.objects.new("Turntable", data)
    axis.location = Vector(centre)
    axis.empty_display_size = radius / 4
    camera.parent = axis
    camera.location = (distance * math.cos(elevation), 0.0, distance * math.sin(elevation))
    camera.rotation_euler = (math.pi / 2 - elevation, 0.0, math.pi / 2)
    for obj in (axis, camera):
        scene.collection.objects.link(obj)

    full = math.isclose(abs(angle), math.tau, abs_tol=1e-4)
    middle = _side_of_photos(scene, centre)
    start = middle if full else middle - angle / 2
    first = scene.frame_start
    for frame_number, turned in ((first, start), (first + frames - (0 if full else 1), start + angle)):
        axis.rotation_euler.z = turned
        axis.keyframe_insert("rotation_euler", index=2, frame=frame_number)
    for curve in _curves(axis):
        curve.extrapolation = "LINEAR"
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    _film_range(scene, camera, frames)
    return camera


def path_through_photos(
    context: bpy.types.Context, cameras: Sequence[bpy.types.Object], frames: int
) -> bpy.types.Object:
    """Add a camera that passes through other cameras, and make it the scene's camera; returns it.

    At each of them it has their position, rotation, focal length and lens shift; between them Blender interpolates
    keyframes, whose times are proportional to the distances. The frame range of the scene becomes that of the
    animation, and its image size that of the first photo.

    Args:
        context: its scene gets the camera.
        cameras: at least two camera objects, in any order; they are passed in the order of their names.
        frames: number of frames of the animation.

    Raises:
        InputError: fewer than two cameras.
    """
    if len(cameras) < 2:
        raise InputError("Select two or more cameras that the path passes through.")
    scene = present(context.scene)
    stops = sorted(cameras, key=by_name)
    roots = {scene_import.find_root(obj) for obj in stops}
    root = roots.pop() if len(roots) == 1 else None
    lenses = [cast(bpy.types.Camera, obj.data) for obj in stops]
    data = present(lenses[0].copy())
    data.name = "Photo Path"
    data.background_images.clear()
    camera = bpy.data.objects.new("Photo Path", data)
    camera.parent = root
    camera.rotation_mode = "QUATERNION"
    (root.users_collection[0] if root else scene.collection).objects.link(camera)

    into_root = root.matrix_world.inverted() if root else Matrix.Identity(4)
    poses = [(into_root @ obj.matrix_world).normalized() for obj in stops]
    times = _times(np.array([pose.translation for pose in poses]), scene.frame_start, frames)
    previous = None
    for pose, lens, time in zip(poses, lenses, times, strict=True):
        rotation = pose.to_quaternion()
        if previous is not None:
            rotation.make_compatible(previous)
        previous = rotation
        camera.location, camera.rotation_quaternion = pose.translation, rotation
        data.lens = lens.lens * data.sensor_width / lens.sensor_width
        data.shift_x, data.shift_y = lens.shift_x, lens.shift_y
        for name in ("location", "rotation_quaternion"):
            camera.keyframe_insert(name, frame=time)
        for name in ("lens", "shift_x", "shift_y"):
            data.keyframe_insert(name, frame=time)
    for owner in (camera, data):
        for curve in _curves(owner):
            for key in curve.keyframe_points:
                key.interpolation = "BEZIER"
                key.handle_left_type = key.handle_right_type = "AUTO"
            curve.update()
    if stops[0].get(scene_import.SIZE_KEY) is not None:
        scene_import.look_through(scene, stops[0])
    _film_range(scene, camera, frames)
    return camera


def _points(obj: bpy.types.Object) -> np.ndarray:
    """World positions (P, 3) of an object's selected splats, of all where none is selected, or of its bounding box."""
    matrix = np.array(obj.matrix_world, np.float64)
    if splats.is_splats(obj):
        cloud = splats.pointcloud_of(obj)
        points = np.empty((len(cloud.points), 3), np.float32)
        cast(Any, cloud.attributes["position"]).data.foreach_get("vector", points.ravel())
        selected = np.zeros(len(points), bool)
        if (attribute := cloud.attributes.get(SELECTED)) is not None:
            cast(Any, attribute).data.foreach_get("value", selected)
        points = points[selected] if selected.any() else points
    else:
        points = np.array(obj.bound_box)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _side_of_photos(scene: bpy.types.Scene, centre: np.ndarray) -> float:
    """Direction from a point to the middle of the imported cameras, as an angle about z in radians."""
    places = [
        np.array(obj.matrix_world.translation) for obj in scene.objects if obj.get(scene_import.SIZE_KEY) is not None
    ]
    x, y, _ = np.mean(places, axis=0) - centre if places else (0.0, -1.0, 0.0)
    return math.atan2(y, x)


def _times(places: np.ndarray, start: int, frames: int) -> np.ndarray:
    """Frame of each of the positions (P, 3): proportional to the way, none at the same time."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    steps = np.maximum(steps, LEAST_STEP * steps.mean()) if steps.any() else np.ones(len(steps))
    passed = np.concatenate([[0.0], np.cumsum(steps)])
    return start + (frames - 1) * passed / passed[-1]


def by_name(obj: bpy.types.Object) -> list[tuple[int, str]]:
    """Key that sorts names as the Outliner does: view 2 before view 10."""
    # Every second part is a number.
    parts = re.split(r"(\d+)", obj.name.lower())
    return [(int(part), "") if place % 2 else (-1, part) for place, part in enumerate(parts)]


def _curves(owner: Any) -> list[Any]:
    """The animation curves of an object or of its data, which were made by keyframe_insert."""
    animation = present(owner.animation_data)
    return list(animation.action.layers[0].strips[0].channelbag(animation.action_slot).fcurves)


def _film_range(scene: bpy.types.Scene, camera: bpy.types.Object, frames: int) -> None:
    scene.camera = camera
    scene.frame_end = scene.frame_start + frames - 1
    scene.frame_set(scene.frame_start)
