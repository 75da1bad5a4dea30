"""Runs of the engine as objects in a scene: their folders, their splats, and what renders need to know."""

from pathlib import Path
from typing import Any

import bpy

from ..swag_engine.formats.run_folder import RunFolder
from ..swag_engine.formats.survey_folder import SurveyFolder
from ..swag_engine.splats.splats import Splats
from . import background, colors, scene_import, splats, water
from .nodes import splat_preview

RUN_KEY = "swag_run"
"""Property of the object with the splats of a run: the run's folder."""
SURVEY_KEY = "swag_survey"
"""Property of the objects with the splats or the map of a survey: the survey's folder."""


def free_run_folder(folder: Path) -> Path:
    """The folder itself if it holds no run, else the first of folder-2, folder-3, ... that holds none."""
    name, number = folder.name, 1
    while RunFolder(folder).config.exists():
        number += 1
        folder = folder.with_name(f"{name}-{number}")
    return folder


def water_run(obj: bpy.types.Object) -> RunFolder | None:
    """The run that the water, lamp and background of splats are from: their own, or the coarse model of their survey.

    None where the splats are from neither.
    """
    if obj.get(RUN_KEY):
        return RunFolder(Path(bpy.path.abspath(obj[RUN_KEY])))
    if obj.get(SURVEY_KEY):
        return SurveyFolder(Path(bpy.path.abspath(obj[SURVEY_KEY]))).coarse
    return None


def remember_training(obj: bpy.types.Object, run: RunFolder, metrics: dict[str, Any]) -> None:
    """Store with the splats what renders need to look as in the engine: pixel size, background, water, development.

    Args:
        obj: the object of the run's splats.
        run: the run's folder.
        metrics: the metrics of its `result` event.
    """
    root = scene_import.find_root(obj)
    _, settings, _ = run.read_config()
    pixel_size = scene_import.pixel_size(root, settings.width) if root else 0.0
    splat_preview.remember_training(obj, pixel_size, metrics["background"])
    water.remember_water(obj, run.read_water(), settings.metres_per_unit)
    colors.remember_developments(obj, run.read_developments())
    background.update_worlds()


def shown_splats(scene: bpy.types.Scene, run: str) -> bpy.types.Object | None:
    """The object of the scene that shows the splats of a run, None where there is none."""
    return next((o for o in scene.objects if o.get(RUN_KEY) == run and splats.is_splats(o)), None)


def show_splats(scene: bpy.types.Scene, loaded: Splats, run: str, images: str) -> bpy.types.Object:
    """Show splats in the scene, in the run's object if there is one; returns the object.

    A new object becomes a child of the imported scene of the same images; without one it has no parent, and its
    coordinates are those of training.

    Args:
        scene: the Blender scene.
        loaded: the splats.
        run: the run's folder.
        images: the folder of the images.
    """
    obj = shown_splats(scene, run)
    if obj:
        splats.replace_splats(obj, loaded)
        return obj
    root = next((r for r in scene_import.roots(scene) if r.get(scene_import.ROOT_KEY) == images), None)
    collection = root.users_collection[0] if root else scene.collection
    obj = splats.new_splat_object(f"{Path(images).name} Splats", loaded, collection, root)
    obj[RUN_KEY] = run
    scene_import.hide_sparse_points(root)
    return obj
