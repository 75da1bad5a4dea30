"""Cameras of another program: which files, the folder of the new scene, the fields and the button of the panel."""

from pathlib import Path
from typing import Any

import bpy

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.files import require_parent
from .blender_types import set_button
from .find_cameras import free_scene_folder
from .properties import swag_of
from .sidebar import draw_job, draw_outcome

JOB = "Import Cameras"
FILES = "*.xml;*.json;*.csv;*.xmp;*.out;images.bin;images.txt"
"""File names that the file browser shows: Metashape, nerfstudio and others, RealityScan (2), Bundler, COLMAP (2)."""


def make_request(chosen: str, photos: str, points: str, scene_folder: str) -> dict[str, Any]:
    """The engine's request without its arrays.

    Args:
        chosen: the file of the cameras.
        photos: folder of the photos; "" for that of the file.
        points: PLY file of points; "" without one.
        scene_folder: folder of the new scene; "" for a free one beside the file.

    Raises:
        InputError: no file was chosen, or the folder that the new scene lies in does not exist.
    """
    if not chosen:
        raise InputError("Choose the file with the cameras, such as the XML of Metashape.")
    file = _absolute(chosen)
    out = _absolute(scene_folder) if scene_folder else free_scene_folder(file)
    request = {"request": "import_cameras", "file": str(file), "out": str(require_parent(out))}
    for name, path in (("photos", photos), ("points", points)):
        if path:
            request[name] = str(_absolute(path))
    return request


def draw_import_cameras(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the files and the button, or the import that runs, and how it failed."""
    swag = swag_of(context.scene)
    if draw_job(layout, context, JOB):
        return
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(swag, "cameras_file")
    column.prop(swag, "cameras_photos")
    column.prop(swag, "cameras_points")
    button = layout.operator("swag.import_cameras", icon="IMPORT")
    set_button(button, filepath=swag.cameras_file, photos_folder=swag.cameras_photos, points_file=swag.cameras_points)
    draw_outcome(layout, context, JOB, only_failed=True)


def _absolute(path: str) -> Path:
    return Path(bpy.path.abspath(path)).absolute()
