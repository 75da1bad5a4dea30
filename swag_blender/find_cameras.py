"""Cameras of photos or of a video: which files, the folder of the new scene, the buttons of the panel Cameras."""

from pathlib import Path
from typing import Any, cast

import bpy

from ..swag_engine.base.errors import InputError
from ..swag_engine.scene.cameras import CAMERA_PAGE
from . import scene_import
from .blender_types import set_button
from .properties import status_of, swag_of
from .sidebar import draw_job, draw_outcome
from .web_page import open_page

JOB = "Find Cameras"


def make_request(chosen: str, scene_folder: str) -> dict[str, Any]:
    """The engine's request without its arrays.

    Args:
        chosen: a folder of photos, one of its photos, or a video.
        scene_folder: folder of the new scene; "" for a free one beside the photos or the video.

    Raises:
        InputError: nothing was chosen.
    """
    if not chosen:
        raise InputError("Choose the folder of the photos, or a video.")
    source = Path(bpy.path.abspath(chosen)).absolute()
    photo_suffixes = cast(Any, bpy.path).extensions_image  # the stubs lack it
    if source.suffix.lower() in photo_suffixes and not source.is_dir():
        source = source.parent
    out = Path(bpy.path.abspath(scene_folder)).absolute() if scene_folder else free_scene_folder(source)
    return {"request": "sfm", "photos": str(source), "out": str(out)}


def free_scene_folder(source: Path) -> Path:
    """The folder NAME_scene beside photos or a video, else the first of NAME_scene-2, NAME_scene-3, ... not there."""
    name = f"{source.name if source.is_dir() else source.stem}_scene"
    folder, number = source.with_name(name), 1
    while folder.exists():
        number += 1
        folder = source.with_name(f"{name}-{number}")
    return folder


def camera_page(context: bpy.types.Context) -> Path | None:
    """The page about the cameras of the chosen photos, None where there is none."""
    folder = swag_of(context.scene).scene_path
    page = Path(folder, CAMERA_PAGE)
    return page if folder and page.is_file() else None


def open_camera_page(context: bpy.types.Context) -> None:
    """Open the page about the cameras of the chosen photos in the web browser.

    Raises:
        InputError: there is no page, or no browser.
    """
    page = camera_page(context)
    if page is None:
        raise InputError(
            f"The chosen photos have no {CAMERA_PAGE}: Find Cameras writes it, and `inspect SCENE --page FILE` on the "
            "command line for cameras from elsewhere."
        )
    open_page(page)


def draw_camera_page(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button that opens the page about the cameras; nothing where there is none."""
    if camera_page(context):
        layout.operator("swag.open_camera_page", icon="URL")


def draw_find_cameras(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button, or the search that runs, and how it failed; what was found is `swag.found`.

    Where the chosen photos could not be imported, the button is for them; else it asks for photos or a video.
    """
    swag, status = swag_of(context.scene), status_of(context)
    if status.job == JOB:
        draw_job(layout, context)
        return
    refused = bool(swag.scene_folder) and status.failed and status.last_job in ("Import", "Check")
    button = layout.operator(
        "swag.find_cameras",
        text="Find Cameras of These Photos" if refused else "Find Cameras",
        icon="OUTLINER_OB_CAMERA",
    )
    set_button(button, filepath=swag.scene_path if refused else "")
    if status.failed and status.last_job == JOB:
        draw_outcome(layout, context)


def draw_sparse_points(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the switch that shows the sparse points of the scene; nothing where there are none."""
    root = scene_import.active_root(context)
    if root and (points := scene_import.sparse_points(root)):
        layout.prop(points, "hide_viewport", text="Sparse Points", invert_checkbox=True)
