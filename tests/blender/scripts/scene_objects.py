"""A scene's cameras, images and points as Blender objects."""

import json
import time
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import scene_import
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

scene = bpy.context.scene


def import_result(path):
    """Root object of the `inspect` result in a file, and the result."""
    result = json.loads(Path(path).read_text())
    root = scene_import.import_scene(result, scene)
    bpy.context.view_layer.update()
    return root, result


def projection_errors(path):
    """Largest difference in pixels (and depth) of Blender's projection from the pinhole's, per camera."""
    root, result = import_result(path)
    worst = {}
    for camera in result["cameras"]:
        obj = bpy.data.objects[camera["name"]]
        scene_import.look_through(scene, obj)
        bpy.context.view_layer.update()
        assert (scene.render.resolution_x, scene.render.resolution_y) == (camera["width"], camera["height"])
        assert scene.camera == obj
        pose = np.array(camera["world_to_camera"])
        errors = []
        for point in np.load(result["points"]["positions"]):
            x, y, z = pose[:3, :3] @ point + pose[:3, 3]
            expected = np.array([camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"], z])
            seen = world_to_camera_view(scene, obj, root.matrix_world @ Vector(point))
            found = np.array([seen.x * camera["width"], (1 - seen.y) * camera["height"], seen.z])
            errors.append(float(abs(found - expected).max()))
        worst[camera["name"]] = max(errors)
    return worst


def root_matrices(ups, points):
    """Root matrices for up directions and the points of a file."""
    points = np.load(points)
    return [np.array(scene_import.colmap_to_blender(np.array(up), points)).tolist() for up in ups]


def describe(path):
    """Everything that an import of one camera makes."""
    root, _ = import_result(path)
    camera, cloud = bpy.data.objects["first.png"], bpy.data.objects["reef Points"]
    background = camera.data.background_images[0]
    return {
        "root": root.name,
        "folder": root[scene_import.ROOT_KEY],
        "found": scene_import.find_root(camera) == root,
        "parents": [camera.parent == root, cloud.parent == root],
        "collections": [collection.name for collection in bpy.data.collections],
        "image": background.image.filepath,
        "alpha": background.alpha,
        "shown": camera.data.show_background_images,
        "size": list(background.image.size),
        "count": len(cloud.data.points),
        "color": list(cloud.data.attributes["swag:color"].data[7].color_srgb),
        "radius": cloud.data.attributes["radius"].data[0].value,
        "material": cloud.data.materials[0].name,
        "position": list(cloud.matrix_world @ cloud.data.points[3].co),
        "expected position": list(root.matrix_world @ cloud.data.points[3].co),
        "pixel size": scene_import.pixel_size(root, 320),
        "scenes": len(bpy.data.scenes),
        "meshes": len(bpy.data.meshes),
        "up": list(scene_import.up_of(root)),
    }


def up_direction(path):
    return list(scene_import.up_of(import_result(path)[0]))


def import_seconds(path):
    start = time.perf_counter()
    root, result = import_result(path)
    seconds = time.perf_counter() - start
    assert len(bpy.data.cameras) == len(result["cameras"]) and len(bpy.data.pointclouds) == 1
    return seconds
