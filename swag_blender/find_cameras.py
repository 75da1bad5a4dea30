"""Photos or a video: whether they have cameras, the folder of a new scene, the buttons of the panel Photos."""

from pathlib import Path
from typing import Annotated, Any, cast

import bpy
from bpy.props import BoolProperty, StringProperty

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.files import require_parent
from ..swag_engine.scene.cameras import CAMERA_PAGE
from ..swag_engine.scene.model_folders import scene_with_model
from . import scene_import
from .blender_types import OperatorResult, present, set_button, with_properties
from .job import ImportJob
from .properties import status_of, swag_of
from .sidebar import draw_job, draw_outcome, draw_wrapped
from .web_page import open_page

JOB = "Find Cameras"
JOBS = ("Import", "Check", JOB)
"""Jobs whose progress and outcome the panel Photos shows."""


@with_properties
class PhotosJob(ImportJob):
    """Job about photos or a video that the user chooses in the file browser."""

    filepath: Annotated[
        str,
        StringProperty(
            name="Photos or Video",
            description="Folder of photos, one of its photos, or a video",
            subtype="FILE_PATH",
            options={"SKIP_SAVE"},
        ),
    ]
    filter_folder: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]
    filter_image: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]
    filter_movie: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]
    scene_folder: Annotated[
        str,
        StringProperty(
            name="Scene Folder",
            description="New folder for copies of the photos and their cameras; empty: beside the photos or video",
            options={"SKIP_SAVE"},
        ),
    ]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for photos or a video where none are given."""
        if self.filepath:
            return self.execute(context)
        if chosen := swag_of(context.scene).scene_path:
            self.filepath = f"{chosen}/"  # where the file browser begins
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def question(self) -> dict[str, Any]:
        """The request to find the cameras."""
        return make_request(self.filepath, self.scene_folder)


def scene_of_photos(chosen: str) -> Path | None:
    """The scene folder with cameras that a chosen folder or one of its photos belongs to; None where there is none."""
    folder = _folder_or_video(chosen)
    try:
        return scene_with_model(folder) if chosen and folder.is_dir() else None
    except OSError:  # the engine says why the folder cannot be read
        return None


def make_request(chosen: str, scene_folder: str) -> dict[str, Any]:
    """The engine's request without its arrays.

    Args:
        chosen: a folder of photos, one of its photos, or a video.
        scene_folder: folder of the new scene; "" for a free one beside the photos or the video.

    Raises:
        InputError: nothing was chosen, or the folder that the new scene lies in does not exist.
    """
    if not chosen:
        raise InputError("Choose the folder of the photos, or a video.")
    source = _folder_or_video(chosen)
    out = Path(bpy.path.abspath(scene_folder)).absolute() if scene_folder else free_scene_folder(source)
    return {"request": "sfm", "photos": str(source), "out": str(require_parent(out))}


def _folder_or_video(chosen: str) -> Path:
    """Absolute path of a folder of photos or of a video; of one of its photos, its folder."""
    source = Path(bpy.path.abspath(chosen)).absolute()
    photo_suffixes = cast(Any, bpy.path).extensions_image  # the stubs lack it
    return source.parent if source.suffix.lower() in photo_suffixes and not source.is_dir() else source


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
            f"The chosen photos have no {CAMERA_PAGE}: Photos or Video writes it where it finds the cameras."
        )
    open_page(page)


def draw_camera_page(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button that opens the page about the cameras; nothing where there is none."""
    if camera_page(context):
        layout.operator("swag.open_camera_page", icon="URL")


def draw_photos(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button that asks for photos or a video, what was found in them, or the job that runs.

    Where the chosen photos could not be imported, another button finds their cameras.
    """
    swag, width = swag_of(context.scene), present(context.region).width
    if draw_job(layout, context, *JOBS):
        return
    row = layout.row()
    row.scale_y = 1.4
    row.operator("swag.open_photos", icon="IMAGE_DATA")
    if swag.scene_folder:
        layout.label(text=Path(swag.scene_path).name, icon="FILE_FOLDER", translate=False)
    ended = status_of(context).ended(*JOBS)
    if ended is not None and ended.failed:
        draw_outcome(layout, context, *JOBS)
        if ended.name != JOB:
            chosen = swag.scene_path
            button = layout.operator(
                "swag.find_cameras",
                text="Find Cameras of These Photos" if chosen else "Find Cameras",
                icon="OUTLINER_OB_CAMERA",
            )
            set_button(button, filepath=chosen)
    elif swag.scene_folder:
        for number, line in enumerate(swag.found.splitlines()):
            draw_wrapped(layout, line, width, icon="ERROR" if number else "NONE")
        draw_camera_page(layout, context)
    else:
        draw_wrapped(layout, "Choose a folder of photos or a video, or open a run in Result.", width, icon="INFO")


def draw_shown(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the switches that show the cameras and the sparse points of the scene; nothing where there are none."""
    root = scene_import.active_root(context)
    if root is None:
        return
    row = layout.row(align=True)
    if cameras := scene_import.layer_of_cameras(root, present(context.view_layer)):
        row.prop(cameras, "hide_viewport", text="Cameras", icon="OUTLINER_OB_CAMERA", toggle=True, invert_checkbox=True)
    if points := scene_import.sparse_points(root):
        row.prop(
            points,
            "hide_viewport",
            text="Sparse Points",
            icon="OUTLINER_OB_POINTCLOUD",
            toggle=True,
            invert_checkbox=True,
        )
