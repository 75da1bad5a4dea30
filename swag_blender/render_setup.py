"""Set-up of the scene for renders of its splats."""

import bpy

from . import scene_import, water
from .nodes import splat_preview


def prepare_render(scene: bpy.types.Scene, display_values: bool, engine: str) -> None:
    """Set up render engine, world and image size of a scene, so that renders show its splats as in training.

    Args:
        scene: a scene with splats.
        display_values: whether to blend sRGB values and not linear light (see nodes/splat_preview.py).
        engine: "CYCLES" or "EEVEE".
    """
    splat_preview.prepare_render(scene, display_values, engine)
    water.set_world(scene, display_values)
    if scene.camera and scene.camera.get(scene_import.SIZE_KEY) is not None:
        scene_import.look_through(scene, scene.camera)
