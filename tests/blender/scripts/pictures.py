"""Splats and pictures for scripts that render."""

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import scene_import, splats
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats

FIELDS = ("positions", "rotations", "scales", "opacities", "sh")


def random_splats(count, coefficients, seed=0):
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    return Splats(
        random.normal(size=(count, 3)).astype("f4"),
        rotations.astype("f4"),
        random.uniform(0.01, 0.1, (count, 3)).astype("f4"),
        random.uniform(0, 1, count).astype("f4"),
        random.normal(size=(count, coefficients, 3)).astype("f4"),
        {"label": random.integers(-5, 9, count).astype("i4"), "importance": random.random(count).astype("f4")},
    )


def load_splats(path):
    """Splats of a file that numpy.savez wrote."""
    arrays = np.load(path)
    return Splats(*(arrays[name] for name in FIELDS))


def linked(name, data=None):
    """A new object in the scene's collection."""
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def new_camera():
    camera = linked("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.camera = camera
    return camera


def pinhole_camera(width, height, focal):
    """Set the scene's camera and image size; the principal point is (-3, +2) pixels off the centre.

    Returns:
        The camera's parent at the origin.
    """
    root = linked("root")
    pinhole = {
        "name": "view", "width": width, "height": height, "fx": focal, "fy": focal, "cx": width / 2 - 3,
        "cy": height / 2 + 2, "world_to_camera": np.eye(4).tolist(),
    }  # fmt: skip
    camera = scene_import.camera_object(pinhole, root, bpy.context.scene.collection)
    scene_import.look_through(bpy.context.scene, camera)
    return root


def render_pixel_centres(transparent=True):
    """Render with one sample at each pixel's centre and no filter, so that pixels equal formulas.

    Returns:
        Linear RGBA (height, width, 4), first row at the top.
    """
    scene = bpy.context.scene
    scene.cycles.samples = scene.eevee.taa_render_samples = 1
    scene.render.filter_size = 0
    scene.render.film_transparent = transparent
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = bpy.app.tempdir + "render.exr"
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    width, height = image.size
    pixels = np.empty(width * height * 4, "f4")
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]


def shown_count():
    """Number of splats that viewports show as shapes or natively, where their nodes are asked for what renders show."""
    graph = bpy.context.evaluated_depsgraph_get()
    graph.update()
    native = [obj for obj in bpy.context.scene.objects if splats.is_splats(obj) and splat_preview.is_native(obj)]
    points = sum(len(obj.evaluated_get(graph).data.points) for obj in native)
    return points + sum(instance.is_instance for instance in graph.object_instances)


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a - b) ** 2), 1e-12))
