"""Runs of the engine as objects in a scene: where they are written, shown, and what renders need of them."""

from pathlib import Path
from typing import Any

import bpy

from ..swag_engine.formats.run_folder import RunFolder
from ..swag_engine.splats.splats import Splats
from . import scene_import, splats, water
from .nodes import splat_preview

RUN_KEY = "swag_run"
"""Property of the object with the splats of a run: the run's folder."""


def free_run_folder(folder: Path) -> Path:
    """`folder`, or, when it holds a run already, the first of folder-2, folder-3, ... that does not."""
    name, number = folder.name, 1
    while RunFolder(folder).config.exists():
        number += 1
        folder = folder.with_name(f"{name}-{number}")
    return folder


def remember_training(obj: bpy.types.Object, run: RunFolder, metrics: dict[str, Any]) -> None:
    """Keep with the splats what renders need to look as in training: pixel size and background."""
    root = scene_import.find_root(obj)
    _, settings, _ = run.read_config()
    pixel_size = scene_import.pixel_size(root, settings.width) if root else 0.0
    splat_preview.remember_training(obj, pixel_size, metrics["background"])
    water.remember_water(obj, run.read_water(), settings.metres_per_unit)


def show_splats(scene: bpy.types.Scene, loaded: Splats, run: str, photographs: str) -> bpy.types.Object:
    """Put splats into the scene, in the object that this run has there already if it has one.

    The object hangs from the imported scene of the same photographs; without one it stands as it was trained.
    """
    obj = next((o for o in scene.objects if o.get(RUN_KEY) == run and splats.is_splats(o)), None)
    if obj:
        splats.replace_splats(obj, loaded)
        return obj
    root = next((r for r in scene_import.roots(scene) if r[scene_import.ROOT_KEY] == photographs), None)
    collection = root.users_collection[0] if root else scene.collection
    obj = splats.new_splat_object(f"{Path(photographs).name} Splats", loaded, collection, root)
    obj[RUN_KEY] = run
    return obj
