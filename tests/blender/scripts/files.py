"""Splat files through the operators, for scripts that import and export."""

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import scene_import, splats


def import_splats(path, **options):
    """The object of an imported file."""
    assert bpy.ops.swag.import_splats(filepath=str(path), **options) == {"FINISHED"}
    return bpy.context.active_object


def export_splats(path, **options):
    assert bpy.ops.swag.export_splats(filepath=str(path), **options) == {"FINISHED"}


def refusal(operator, **options):
    """The message with which an operator refuses."""
    try:
        operator(**options)
    except RuntimeError as error:
        assert "Traceback" not in str(error), error
        return str(error).removeprefix("Error: ").strip()
    raise AssertionError(f"{operator} raised no error")


def add_imported_scene(cameras=()):
    """The root of a scene whose up direction is no axis, with cameras as `inspect` gives them."""
    root = bpy.data.objects.new("reef", None)
    root[scene_import.ROOT_KEY] = "/data/reef"
    root.matrix_world = scene_import.colmap_to_blender(np.array([0.48, -0.8, 0.36]), np.array([[1.0, 2.0, 3.0]]))
    bpy.context.scene.collection.objects.link(root)
    for camera in cameras:
        scene_import.camera_object(camera, root, bpy.context.scene.collection)
    bpy.context.view_layer.update()
    return root


def matrix_in_file_frame(matrix):
    """A matrix of Blender's world as it acts on positions of an upright PLY, as nested lists."""
    return [list(row) for row in splats.FILE_FRAME.inverted() @ matrix]
